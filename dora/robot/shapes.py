"""Collision primitives in the frame of a link: box, sphere, cylinder and capsule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from dora.geometry.rotations import quaternion_apply

MERGE_TOLERANCE = 1e-6
"""Largest difference between a cylinder's end and a sphere at which both form a capsule [m]."""


@dataclass(frozen=True)
class Shape:
    """One collision primitive.

    Attributes:
        kind: which primitive.
        position: centre in the link frame [m].
        quaternion: orientation in the link frame, wxyz.
        size: half sides along x, y, z of a box, radius of a sphere, radius and half length of a cylinder or capsule
            [m]. The axis of the last two is local x, as in PhysX; a capsule's half length excludes its caps.
    """

    kind: Literal["box", "sphere", "cylinder", "capsule"]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    size: tuple[float, ...]

    @property
    def volume(self) -> float:
        """[m^3]."""
        if self.kind == "box":
            return 8 * math.prod(self.size)
        radius = self.size[0]
        ball = 4 / 3 * math.pi * radius**3
        if self.kind == "sphere":
            return ball
        return 2 * math.pi * radius**2 * self.size[1] + (ball if self.kind == "capsule" else 0.0)

    @property
    def segment(self) -> np.ndarray:
        """End points (2, 3) of the axis of a cylinder or capsule in the link frame [m].

        Raises:
            ValueError: the primitive has no axis.
        """
        if len(self.size) != 2:
            raise ValueError(f"a {self.kind} has no axis")
        half = torch.tensor([self.size[1], 0.0, 0.0], dtype=torch.float64)
        reach = quaternion_apply(torch.tensor(self.quaternion, dtype=torch.float64), half).numpy()
        return np.stack([self.position - reach, self.position + reach])


def merge_capsules(shapes: Sequence[Shape]) -> tuple[Shape, ...]:
    """Replace every cylinder with equal spheres at both ends by one capsule; other shapes stay.

    Standard URDF has no capsule, so this is how a capsule is written there.
    """
    spheres = [shape for shape in shapes if shape.kind == "sphere"]
    merged = []
    for shape in shapes:
        ends = shape.segment if shape.kind == "cylinder" else ()
        caps = [cap for end in ends if (cap := _cap(spheres, end, shape.size[0])) is not None]
        if len(caps) == 2:
            merged.append(Shape("capsule", shape.position, shape.quaternion, shape.size))
            spheres = [sphere for sphere in spheres if all(sphere is not cap for cap in caps)]
        elif shape.kind != "sphere":
            merged.append(shape)
    return (*merged, *spheres)


def _cap(spheres: Sequence[Shape], center: np.ndarray, radius: float) -> Shape | None:
    """The sphere with this centre and radius [m], if there is one."""
    for sphere in spheres:
        pairs = zip((*sphere.position, *sphere.size), (*center.tolist(), radius), strict=True)
        if all(abs(a - b) <= MERGE_TOLERANCE for a, b in pairs):
            return sphere
    return None
