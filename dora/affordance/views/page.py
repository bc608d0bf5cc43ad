"""The web page, served by viser, of an object, its regions, and the hand at each of its grasps."""

from __future__ import annotations

import html
import importlib
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.contact_maps import mapped
from dora.affordance.hand.hand_mesh import HandMesh, face_colours
from dora.affordance.maps.voting import NO_CONTACT, vote_over_map
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.palette import PALETTE, colours
from dora.affordance.search.cache import hand_of
from dora.affordance.views.pictures import PARTS
from dora.affordance.views.surface import Surface, unshared
from dora.errors import InputError, shown
from dora.geometry.rotations import quaternion_from_matrix
from dora.robot import RobotDescription
from dora.tables import markdown_text

LAST_PORT = 65_535
"""Largest number of a TCP port."""
MOST_HANDS = 16
"""Largest number of hands that a page shows at once."""
CONTACT_SIZE = 0.004
"""Diameter of a contact point [m]."""
VIEWPOINT = 1.0
"""Distance of the first view along x and y, in diagonals of the object [1]."""
AMBIENT = 1.5
"""Intensity of the ambient light; with viser's own lights alone dark links are black [1]."""
REGIONS, CONTACTS = "affordance regions", "contact semantic map"
"""Choices of what the colours of the surface mean."""
ANY_VALIDITY, VALID, INVALID = "all", "valid", "not valid"
"""Choices of the filter by validity."""


@dataclass(frozen=True)
class Filter:
    """Conditions on the candidates that are shown.

    Attributes:
        classes: grasp classes that are shown.
        validity: "all", "valid" or "not valid".
        term: energy term to filter by; None for no such filter.
        share: share of the candidates of all classes with the lowest values of `term` that are shown, 0 to 1 [1].
    """

    classes: frozenset[str]
    validity: str = ANY_VALIDITY
    term: str | None = None
    share: float = 1.0

    def rows(self, candidates: GraspCandidates) -> Int[Tensor, " m"]:
        """Indices (m,) of the candidates that pass, ascending."""
        mask: Bool[Tensor, " c"] = candidates.of_class(*self.classes)
        if self.validity != ANY_VALIDITY:
            mask = mask & (candidates.valid == (self.validity == VALID))
        if self.term is not None:
            value = candidates.energy[self.term]
            mask = mask & (value <= torch.quantile(value, self.share))
        return mask.nonzero().squeeze(1)


def describe(candidates: GraspCandidates, row: int) -> str:
    """Markdown about one candidate: class, validity, score, penetration depths, contacts, contact map and energies."""
    names = list(PARTS)
    points = torch.bincount(candidates.contact_map[row].long(), minlength=len(names)).tolist()
    touching = sorted({int(f) for f in candidates.contact_finger[row] if f > 0})
    score = float(candidates.score[row])
    lines = [
        f"**{markdown_text(candidates.grasp_class[row])}** (candidate {row})",
        f"- {'valid' if candidates.valid[row] else 'not valid'}",
        f"- succeeded in {100 * score:.0f} % of its executions" if np.isfinite(score) else "- not ranked",
        f"- {1000 * float(candidates.penetration[row]):.2f} mm into the object",
        f"- {1000 * float(candidates.self_penetration[row]):.2f} mm into itself",
        f"- contacts: {', '.join(names[f] for f in touching) or 'none'}",
        f"- contact map: {', '.join(f'{n} {k}' for n, k in zip(names[1:], points[1:], strict=True) if k) or 'none'}",
        *(f"- {markdown_text(name)}: {float(value[row]):.3g}" for name, value in candidates.energy.items()),
    ]
    return "\n".join(lines)


class Hands:
    """Up to `MOST_HANDS` posed hands in a scene of viser; links of equal shape form one batch."""

    def __init__(self, scene: Any, robot: RobotDescription) -> None:
        self.mesh = HandMesh(robot)
        groups: dict[bytes, list[str]] = {}
        for name, link in self.mesh.links.items():
            groups.setdefault(link.vertices.tobytes() + face_colours(link).tobytes(), []).append(name)
        self._batches = []
        for names in groups.values():
            link = self.mesh.links[names[0]]
            count = MOST_HANDS * len(names)
            handle = scene.add_batched_meshes_trimesh(
                f"/hands/{names[0]}",
                unshared(link, face_colours(link)),
                batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
                batched_positions=np.zeros((count, 3)),
                batched_scales=np.zeros(count),
                lod="off",
            )
            self._batches.append((names, handle))

    def show(self, candidates: GraspCandidates | None) -> None:
        """Pose the hands at these candidates, `MOST_HANDS` at most; None shows no hand."""
        count = 0 if candidates is None else len(candidates)
        poses = (
            {}
            if candidates is None
            else self.mesh.world_poses(candidates.position, candidates.quaternion, candidates.joints)
        )
        for names, handle in self._batches:
            scales = np.zeros((len(names), MOST_HANDS))
            scales[:, :count] = 1.0
            if poses:
                handle.batched_positions = _filled([poses[name][:, :3, 3] for name in names], (0.0, 0.0, 0.0))
                turns = [quaternion_from_matrix(poses[name][:, :3, :3]) for name in names]
                handle.batched_wxyzs = _filled(turns, (1.0, 0.0, 0.0, 0.0))
            handle.batched_scales = scales.ravel().astype(np.float32)


def _filled(values: list[Float[Tensor, "c d"]], rest: tuple[float, ...]) -> Float[np.ndarray, "n d"]:
    """Rows of every link, padded to `MOST_HANDS` each with `rest`."""
    table = np.tile(np.array(rest, dtype=np.float32), (len(values), MOST_HANDS, 1))
    for link, value in enumerate(values):
        table[link, : len(value)] = value.numpy()
    return table.reshape(-1, len(rest))


def legend_html(title: str, table: Mapping[str, tuple[int, int, int]]) -> str:
    """HTML of a line of names, which may hold any characters, on their colours (red, green, blue, 0 to 255)."""
    boxes = " ".join(
        f'<span style="background: rgb{rgb}; border-radius: 3px; padding: 0 0.5em">{html.escape(name)}</span>'
        for name, rgb in table.items()
    )
    return f'<div style="padding: 0.3em 1em; line-height: 1.8">{html.escape(title)}: {boxes}</div>'


class GraspPage:
    """A running page; callbacks of its widgets change the scene.

    Args:
        obj: the object.
        candidates: its grasps, or None to show the regions only.
        robot: the robot whose hand grasps.
        port: port of the page; a port in use is refused.
        host: address to listen on; with the default the page is reachable from this machine only.

    Attributes:
        server: viser's server; `server.stop()` ends the page.

    Raises:
        InputError: viser is not installed, or the port is in use.
    """

    def __init__(
        self,
        obj: AffordanceObject,
        candidates: GraspCandidates | None,
        robot: RobotDescription,
        port: int = 8080,
        host: str = "127.0.0.1",
    ) -> None:
        self.obj = obj
        self.server = start_server(host, port, f"Dora: {obj.name}")
        self.surface = Surface(obj)
        self.candidates = candidates
        if candidates is not None:
            self.candidates = candidates = mapped(candidates, self.surface.map, hand_of(robot, "cpu"))
            self.voted = vote_over_map(self.surface.map, candidates.contact_map).tolist()
        self.server.scene.set_up_direction("+z")
        self.server.scene.add_light_ambient("/ambient", intensity=AMBIENT)
        away = VIEWPOINT * float(np.linalg.norm(obj.mesh.extents))
        self.server.initial_camera.position = (away, -away, 0.8 * away)
        self.server.initial_camera.look_at = (0.0, 0.0, 0.0)
        self._paint(self.surface.regions())
        if candidates is not None:
            self.hands = Hands(self.server.scene, robot)
            self._add_widgets(candidates)
            self.refresh()
        self._add_legend()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def _add_legend(self) -> None:
        rows = [("Regions", dict(zip(self.obj.labels, PALETTE * len(self.obj.labels), strict=False)))]
        if self.candidates is not None:
            rows.append(("Contact map", PARTS))
        with self.server.gui.add_folder("Colours"):
            for title, table in rows:
                self.server.gui.add_html(legend_html(title, table))

    def _add_widgets(self, candidates: GraspCandidates) -> None:
        gui = self.server.gui
        self.colouring = gui.add_dropdown("surface", (REGIONS, CONTACTS))
        with gui.add_folder("Filter"):
            self.classes = {
                name: gui.add_checkbox(f"{name} ({count})", True) for name, count in candidates.counts().items()
            }
            self.validity = gui.add_dropdown("validity", (ANY_VALIDITY, VALID, INVALID))
            self.term = gui.add_dropdown("energy", ("-", *candidates.energy))
            self.share = gui.add_slider("lowest %", 1, 100, 1, 100)
        with gui.add_folder("Grasp"):
            self.chosen = gui.add_slider("grasp", 1, max(2, len(candidates)), 1, 1)
            self.count = gui.add_slider("hands", 0, MOST_HANDS, 1, 1)
            self.text = gui.add_markdown("")
        widgets = (
            *self.classes.values(),
            self.colouring,
            self.validity,
            self.term,
            self.share,
            self.chosen,
            self.count,
        )
        for widget in widgets:
            widget.on_update(lambda _: self.refresh())

    @property
    def filter(self) -> Filter:
        """The filter that the widgets show."""
        return Filter(
            frozenset(name for name, box in self.classes.items() if box.value),
            self.validity.value,
            None if self.term.value == "-" else self.term.value,
            self.share.value / 100,
        )

    def refresh(self) -> None:
        """Update the scene by the widgets: the chosen grasp among those that pass the filter, and the next ones."""
        assert self.candidates is not None
        rows = self.filter.rows(self.candidates).tolist()
        first = min(self.chosen.value - 1, max(len(rows) - 1, 0))
        shown = rows[first : first + self.count.value]
        if not rows:
            self.text.content = "No grasp passes the filter."
        else:
            row = rows[first]
            label = "nothing" if self.voted[row] == NO_CONTACT else self.obj.labels[self.voted[row]]
            words = f"grasp {first + 1} of {len(rows)}\n\n{describe(self.candidates, row)}"
            self.text.content = f"{words}\n- the map votes for {markdown_text(label)}"
        self.hands.show(self.candidates.select(shown) if shown else None)
        if rows and self.colouring.value == CONTACTS:
            self._paint(self.surface.contacts(self.candidates.contact_map[rows[first]]))
        else:
            self._paint(self.surface.regions())
        self._show_contacts(rows[first] if rows else None)

    def _paint(self, face_colours: np.ndarray) -> None:
        key = face_colours.tobytes()
        if key != getattr(self, "_painted", None):
            self._painted = key
            self.server.scene.add_mesh_trimesh("/object", self.surface.painted(face_colours))

    def _show_contacts(self, row: int | None) -> None:
        assert self.candidates is not None
        points, finger = np.zeros((0, 3)), np.zeros(0, dtype=int)
        if row is not None:
            touching = self.candidates.contact_finger[row] > 0
            points = self.candidates.contacts[row][touching].numpy()
            finger = self.candidates.contact_finger[row][touching].numpy()
        shown = colours(finger, tuple(PARTS.values()))[:, :3]
        self.server.scene.add_point_cloud("/contacts", points, shown, point_size=CONTACT_SIZE, point_shape="circle")


def start_server(host: str, port: int, label: str) -> Any:
    """Start viser's server on exactly this port.

    Raises:
        InputError: viser is not installed, the port is in use or none, or there is no such address.
    """
    if not 1 <= port <= LAST_PORT:
        raise InputError(f"--port is {port} and has to be from 1 to {LAST_PORT}.")
    try:
        socket.getaddrinfo(host, port)
    except (OSError, UnicodeError) as error:
        raise InputError(f"--host is {shown(host)}, which is no address of this machine ({error}).") from error
    try:
        viser = importlib.import_module("viser")
    except ImportError as error:
        raise InputError("The page needs viser, which is not installed: pip install 'dora[view]'.") from error
    server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
    if server.get_port() != port:
        server.stop()
        raise InputError(f"Port {port} is in use: choose another one with --port.")
    return server
