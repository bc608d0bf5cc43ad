"""The motion-feasibility filter as a table over an object's place and yaw, for a look-up at every reset of an episode.

An object that rests on the table has a place (x, y) and a yaw. The filter is evaluated once at the nodes of a grid
over these; a reset then costs one look-up. A table is stored under a digest of everything on which it depends.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dora.affordance.candidates import GraspCandidates, hand_digest
from dora.affordance.objects.decomposition import cache_folder
from dora.affordance.reach.approach_paths import OK, REASONS
from dora.affordance.reach.feasibility import Reach
from dora.digests import digest_of
from dora.errors import InputError
from dora.files import read_tensors, stored_or_made, write_tensors
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_yaw,
    quaternion_inverse,
    quaternion_multiply,
    yaw_of,
)
from dora.robot.motion import inverse_kinematics
from dora.robot.shapes import Shape

FORMAT = "dora-reach 1"
"""Format and version of a stored table; the version changes when the filter decides differently."""
CHUNK = 4096
"""Rows (pairs of pose and candidate) that are filtered at once; bounds the memory."""
DIGITS = 6
"""Decimals with which the numbers of a piece, in metres, count in the digest."""
MAX_TILT = 0.1
"""Largest tilt from the resting orientation for which the table holds [rad]."""
MAX_RISE = 0.02
"""Largest distance from the resting height for which the table holds [m]."""


@dataclass(frozen=True)
class Grid:
    """Nodes of the table: a rectangle of places in the world, and all yaws.

    Attributes:
        centre: x, y of the rectangle's centre [m].
        spread: half widths of the rectangle along x and y [m].
        spacing: largest distance of neighbouring nodes along x or y [m].
        yaws: number of nodes on the full turn, the first at yaw 0.

    Raises:
        InputError: a spread is negative, or `spacing` or `yaws` is not positive.
    """

    centre: tuple[float, float]
    spread: tuple[float, float]
    spacing: float = 0.04
    yaws: int = 24

    def __post_init__(self) -> None:
        if not (min(self.spread) >= 0 and self.spacing > 0 and self.yaws > 0):
            raise InputError("a grid of places needs a spread of at least 0, and a spacing and yaws above 0.")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of nodes along x, y and yaw."""
        x, y = (1 + math.ceil(2 * half / self.spacing - 1e-9) for half in self.spread)
        return x, y, self.yaws

    @property
    def steps(self) -> tuple[float, float, float]:
        """Distance of neighbouring nodes along x, y [m] and yaw [rad]; `spacing` where there is a single node."""
        x, y = (2 * half / (n - 1) if n > 1 else self.spacing for half, n in zip(self.spread, self.shape, strict=False))
        return x, y, 2 * math.pi / self.yaws

    @property
    def corner(self) -> tuple[float, float]:
        """x and y of the first node [m]."""
        x, y = (c - half * (n > 1) for c, half, n in zip(self.centre, self.spread, self.shape, strict=False))
        return x, y

    def nodes(self) -> Float[Tensor, "m 3"]:
        """(m, 3) x, y [m] and yaw [rad] of all nodes; yaw varies fastest, then y."""
        starts = (*self.corner, 0.0)
        return torch.cartesian_prod(
            *(start + step * torch.arange(n) for start, step, n in zip(starts, self.steps, self.shape, strict=True))
        )

    def nearest(self, places: Float[Tensor, "b 3"]) -> tuple[Int[Tensor, " b"], Bool[Tensor, " b"]]:
        """Index of the node nearest to x, y [m] and yaw [rad], and whether it is at most half a cell away."""
        steps = places.new_tensor(self.steps)
        low = places.new_tensor(self.corner)
        cell = torch.cat([(places[:, :2] - low), places[:, 2:]], -1) / steps
        index = cell.round().long()
        index[:, 2] %= self.yaws
        size = torch.tensor(self.shape, device=places.device)
        inside = ((index >= 0) & (index < size)).all(-1)
        x, y, yaw = torch.minimum(index.clamp_min(0), size - 1).unbind(-1)
        return (x * self.shape[1] + y) * self.yaws + yaw, inside


@dataclass(frozen=True, eq=False)
class ReachTable:
    """Which of c candidates are feasible at the nodes of a grid.

    Attributes:
        grid: the nodes.
        rest: orientation of the object at yaw 0 in the world, wxyz.
        height: height of the resting object's origin in the world [m].
        reason: (m, c) index into `dora.affordance.reach.approach_paths.REASONS`, rows in the order of `Grid.nodes`.
        digest: digest of everything on which the table depends, see `table_digest`.
    """

    grid: Grid
    rest: tuple[float, float, float, float]
    height: float
    reason: UInt8[Tensor, "m c"]
    digest: str

    @classmethod
    def of(
        cls,
        reach: Reach,
        candidates: GraspCandidates,
        grid: Grid,
        height: float,
        rest: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
        cache: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> ReachTable:
        """Evaluates the filter at every node, or loads the table from the object's folder or the folder `cache`.

        Evaluation takes about half a millisecond per node and candidate, loading a few milliseconds.

        Args:
            reach: the filter.
            candidates: c candidates.
            grid: places and yaws of the object.
            height: height of the resting object's origin in the world [m]; `obj.support` on a table at height 0.
            rest: orientation of the object at yaw 0, wxyz; `obj.rest`.
            cache: folder of stored tables; `cache_folder()` if None.
            progress: called with the number of nodes done and their total.

        Raises:
            InputError: Pinocchio or Coal is needed and not installed.
        """
        digest = table_digest(reach, candidates, grid, height, rest)
        path = (cache or cache_folder()) / file_name(digest)
        bundled = [] if reach.folder is None else [reach.folder / file_name(digest)]

        def load(known: Path) -> ReachTable:
            table = cls.load(known, digest, grid, height, rest)
            if table.reason.shape[1] != len(candidates):
                raise InputError(f"{known} holds a table of another number of candidates; delete it.")
            return table

        def make() -> ReachTable:
            """The table of all nodes of the grid, computed now."""
            nodes, count, found = grid.nodes(), max(1, CHUNK // len(candidates)), []
            for part in nodes.split(count):
                position, quaternion = poses(part, height, rest)
                found.append(reach.filter(candidates, position, quaternion).reason)
                if progress is not None:
                    progress(sum(map(len, found)), len(nodes))
            return cls(grid, rest, height, torch.cat(found).to(torch.uint8), digest)

        for known in bundled:
            if os.path.isfile(known):
                return load(known)
        return stored_or_made(path, load, make, lambda path, table: table.save(path))

    def mask(self, object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]) -> Bool[Tensor, "b c"]:
        """Mask (b, c) of feasible candidates for objects at world poses ([m], wxyz).

        An object off the grid, above the table or tipped over has none: its row is False.
        """
        place, applies = self.places(object_p, object_q)
        index, inside = self.grid.nearest(place)
        return (self.reason[index] == OK) & (inside & applies)[:, None]

    def places(
        self, object_p: Float[Tensor, "b 3"], object_q: Float[Tensor, "b 4"]
    ) -> tuple[Float[Tensor, "b 3"], Bool[Tensor, " b"]]:
        """x, y [m] and yaw [rad] of objects at world poses ([m], wxyz), and whether they rest as the table assumes."""
        rest = object_q.new_tensor(self.rest)
        turn = quaternion_multiply(object_q, quaternion_inverse(rest).expand_as(object_q))
        up = quaternion_apply(turn, turn.new_tensor([0.0, 0.0, 1.0]).expand(len(turn), 3))
        level = (up[:, 2] > math.cos(MAX_TILT)) & ((object_p[:, 2] - self.height).abs() < MAX_RISE)
        return torch.cat([object_p[:, :2], yaw_of(turn)[:, None]], -1), level

    def save(self, path: Path | str) -> None:
        """Write a safetensors file, atomically.

        Raises:
            InputError: it cannot be written.
        """
        write_tensors(Path(path), FORMAT, {"reason": self.reason}, {"digest": self.digest})

    @classmethod
    def load(
        cls, path: Path | str, digest: str, grid: Grid, height: float, rest: tuple[float, float, float, float]
    ) -> ReachTable:
        """Read a file that `save` wrote; grid, height and rest are not stored, the digest stands for them.

        Raises:
            InputError: no such file, damaged, or its digest differs from `digest`.
        """
        tensors, metadata = read_tensors(Path(path), FORMAT)
        if metadata.get("digest") != digest:
            raise InputError(f"{path} was made for other candidates or another robot, object or grid; delete it.")
        reason, nodes = tensors.get("reason"), math.prod(grid.shape)
        if set(tensors) != {"reason"} or reason is None or reason.dtype != torch.uint8 or reason.ndim != 2:
            raise InputError(f"{path} holds no table of reasons; delete it.")
        if len(reason) != nodes or not reason.numel() or int(reason.max()) >= len(REASONS):
            raise InputError(f"{path} holds a table of other places than {nodes}, or unknown reasons; delete it.")
        return cls(grid, rest, height, reason, digest)

    def to(self, device: torch.device | str) -> ReachTable:
        """The same table on another device."""
        return ReachTable(self.grid, self.rest, self.height, self.reason.to(device), self.digest)


def file_name(digest: str) -> str:
    """Name of the file of the table with a digest."""
    return f"reach-{digest[:16]}.safetensors"


def table_digest(
    reach: Reach,
    candidates: GraspCandidates,
    grid: Grid,
    height: float,
    rest: tuple[float, float, float, float],
) -> str:
    """sha256 of everything on which a table depends, numbers of controller and inverse kinematics included."""
    robot = reach.robot
    names = ("position", "quaternion", "approach", "pregrasp", "joints")
    return digest_of(
        {
            "format": FORMAT,
            "filter": reach.settings,
            "kinematics": inverse_kinematics.NUMBERS,
            "base": reach.base,
            "object": reach.digest,
            "pieces": [_described(piece) for piece in reach.pieces],
            "grid": grid,
            "height": height,
            "rest": rest,
            "ignored_pairs": sorted(robot.ignored_pairs),
            "hand": hand_digest(robot),
            "urdf": robot.urdf.read_bytes(),
            "start": reach.start,
            "candidates": {name: getattr(candidates, name).cpu() for name in names},
        }
    )


def _described(piece: Shape | trimesh.Trimesh) -> dict[str, Any]:
    """A convex piece, to a micrometre: sums of floats differ between machines by less."""
    if isinstance(piece, Shape):
        numbers = np.array([*piece.position, *piece.quaternion, *piece.size])
        return {"kind": piece.kind, "numbers": np.round(numbers, DIGITS) + 0.0}
    return {"vertices": np.round(piece.vertices, DIGITS) + 0.0, "faces": np.array(piece.faces, np.int64)}


def poses(
    nodes: Float[Tensor, "m 3"], height: float, rest: tuple[float, float, float, float]
) -> tuple[Float[Tensor, "m 3"], Float[Tensor, "m 4"]]:
    """World poses ([m], wxyz) of an object that rests at the nodes (x, y [m], yaw [rad])."""
    position = torch.cat([nodes[:, :2], torch.full((len(nodes), 1), height)], -1)
    return position, quaternion_multiply(quaternion_from_yaw(nodes[:, 2]), torch.tensor(rest).expand(len(nodes), 4))
