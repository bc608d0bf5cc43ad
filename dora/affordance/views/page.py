"""The web page, served by viser, of an object, its regions, and the hand at each of its grasps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.contact_maps import mapped
from dora.affordance.maps.voting import NO_CONTACT, vote_over_map
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.palette import PALETTE, colours
from dora.affordance.search.cache import hand_of
from dora.affordance.views.hands import Hands
from dora.affordance.views.pictures import PARTS
from dora.affordance.views.server import address, legend_html, start_server
from dora.affordance.views.surface import Surface
from dora.robot import RobotDescription
from dora.tables import markdown_text

MOST_HANDS = 16
"""Largest number of hands that a page shows at once."""
CONTACT_SIZE = 0.004
"""Diameter of a contact point [m]."""
VIEWPOINT = 1.0
"""Distance of the first view along x and y, in diagonals of the object [1]."""
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
        share: share of the candidates of all classes with the lowest values of `term` that are shown, 0 to 1 [1]; those
            without a value of it are shown with 1 only.
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
            mask = mask & (value <= torch.nanquantile(value, self.share)) if self.share < 1 else mask
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
        away = VIEWPOINT * float(np.linalg.norm(obj.mesh.extents))
        self.server.initial_camera.position = (away, -away, 0.8 * away)
        self.server.initial_camera.look_at = (0.0, 0.0, 0.0)
        self._paint(self.surface.regions())
        if candidates is not None:
            self.hands = Hands(self.server.scene, robot, MOST_HANDS)
            self._add_widgets(candidates)
            self.refresh()
        self._add_legend()

    @property
    def url(self) -> str:
        """Address of the page."""
        return address(self.server)

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
        if shown:
            some = self.candidates.select(shown)
            self.hands.show(some.position, some.quaternion, some.joints)
        else:
            self.hands.hide()
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
