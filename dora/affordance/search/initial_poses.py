"""Initial hand poses: the open palm in front of a surface point, or near the hands of given candidates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.geometry.rotations import matrix_from_quaternion, matrix_from_rotation_vector

SAMPLES = 2048
"""Number of surface points from which initial poses are drawn."""
NEIGHBOURHOOD = 0.03
"""Radius of the neighbourhood in which the long axis of a part is estimated [m]."""
ELONGATED = 1.5
"""Ratio of standard deviations along the two longest principal axes above which a neighbourhood is elongated [1]."""


@dataclass(frozen=True)
class Spread:
    """Random spread of initial poses.

    Attributes:
        gap: range of the distance between palm and surface point, uniform [m].
        tilt: standard deviation, per component, of the palm's normal from the surface's [rad].
        roll: standard deviation of the hand's across axis from the part's long axis [rad].
        abduction: standard deviation of joints whose range has zero in its middle half [rad].
        flexion: mean and standard deviation of all other joints, as shares of their range [1].
    """

    gap: tuple[float, float] = (-0.005, 0.025)
    tilt: float = 0.35
    roll: float = 0.2
    abduction: float = 0.08
    flexion: tuple[float, float] = (0.25, 0.1)


@dataclass(frozen=True)
class Nearness:
    """Random spread of initial poses near given ones.

    Attributes:
        position: standard deviation of the wrist's position, per component [m].
        rotation: standard deviation of its rotation vector, per component [rad].
        joint: standard deviation of each actuated joint [rad].
    """

    position: float = 0.005
    rotation: float = 0.08
    joint: float = 0.05


class InitialPoses:
    """Draws initial poses in front of one region of an object, or all around it.

    Args:
        obj: the object.
        hand: the hand.
        region: label of the region to be held; None starts anywhere on the convex hull.
        spread: random spread of the poses.

    Raises:
        InputError: the object has no such region.
    """

    def __init__(self, obj: AffordanceObject, hand: HandModel, region: str | None, spread: Spread) -> None:
        surface = obj.solid.convex_hull if region is None else obj.region(region)
        points, faces = trimesh.sample.sample_surface_even(surface, SAMPLES, seed=0)[:2]
        self.hand, self.spread = hand, spread
        self.points = torch.as_tensor(np.asarray(points), dtype=hand.dtype, device=hand.device)
        normals = np.asarray(surface.face_normals[faces])
        self.normals = torch.as_tensor(normals, dtype=hand.dtype, device=hand.device)
        self.axes, self.elongated = long_axes(self.points)
        palm = hand.palm_frame
        self.frame = self.points.new_tensor(np.stack((palm.normal, palm.across, palm.along)).copy())
        self.center = self.points.new_tensor(palm.center)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Float[Tensor, "c 4 4"], Float[Tensor, "c a"]]:
        """Wrist poses (c, 4, 4) in the object frame [m] and actuated joints (c, a) [rad]."""
        spread, new = self.spread, self.points

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator).to(new)

        chosen = torch.randint(len(self.points), (count,), generator=generator).to(new.device)
        outward = unit(self.normals[chosen] + spread.tilt * normal(count, 3))
        sign = normal(count, 1).sign()
        random = normal(count, 3)
        along_part = sign * self.axes[chosen] + spread.roll * normal(count, 3)
        across = torch.where(self.elongated[chosen].unsqueeze(1), along_part, random)
        across = unit(across - (across * outward).sum(-1, keepdim=True) * outward)
        facing = torch.stack((-outward, across, torch.linalg.cross(-outward, across)), -1)
        turn = facing @ self.frame
        low, high = spread.gap
        gap = low + (high - low) * torch.rand(count, 1, generator=generator).to(new)
        wrist = torch.eye(4, dtype=new.dtype, device=new.device).repeat(count, 1, 1)
        wrist[:, :3, :3] = turn
        wrist[:, :3, 3] = self.points[chosen] + gap * outward - turn @ self.center
        return wrist, self._joints(count, generator)

    def _joints(self, count: int, generator: torch.Generator) -> Tensor:
        hand, spread = self.hand, self.spread
        noise = torch.randn(count, len(hand.lower), generator=generator).to(hand.lower)
        width = hand.upper - hand.lower
        mean, deviation = spread.flexion
        flexed = hand.lower + width * (mean + deviation * noise)
        zero_share = -hand.lower / width
        spreads = (zero_share > 0.25) & (zero_share < 0.75)
        return torch.clamp(torch.where(spreads, spread.abduction * noise, flexed), hand.lower, hand.upper)


class PosesNear:
    """Draws initial poses near those of candidates, of each about equally many.

    Args:
        candidates: grasps of the object and of the hand.
        hand: the hand.
        spread: random spread of the poses.
    """

    def __init__(self, candidates: GraspCandidates, hand: HandModel, spread: Nearness) -> None:
        to_hand = {"dtype": hand.dtype, "device": hand.device}
        self.hand, self.spread = hand, spread
        self.position = candidates.position.to(**to_hand)
        self.rotation = matrix_from_quaternion(candidates.quaternion.to(**to_hand))
        self.joints = hand.robot.reduce_hand(candidates.joints.to(**to_hand))

    def draw(self, count: int, generator: torch.Generator) -> tuple[Float[Tensor, "c 4 4"], Float[Tensor, "c a"]]:
        """Wrist poses (c, 4, 4) in the object frame [m] and actuated joints (c, a) [rad]."""
        chosen, new = torch.arange(count) % len(self.position), self.position

        def normal(size: int) -> Tensor:
            return torch.randn(count, size, generator=generator).to(new)

        wrist = torch.eye(4, dtype=new.dtype, device=new.device).repeat(count, 1, 1)
        wrist[:, :3, 3] = self.position[chosen] + self.spread.position * normal(3)
        wrist[:, :3, :3] = matrix_from_rotation_vector(self.spread.rotation * normal(3)) @ self.rotation[chosen]
        joints = self.joints[chosen] + self.spread.joint * normal(self.joints.shape[1])
        return wrist, torch.clamp(joints, self.hand.lower, self.hand.upper)


def unit(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Vectors scaled to length 1."""
    return torch.nn.functional.normalize(vectors, dim=-1)


def long_axes(points: Float[Tensor, "p 3"]) -> tuple[Float[Tensor, "p 3"], Tensor]:
    """Longest principal axis (p, 3) of each point's neighbourhood, and whether it is elongated (p,)."""
    near = (torch.cdist(points, points) < NEIGHBOURHOOD).to(points)
    mass = near.sum(1, keepdim=True)
    mean = near @ points / mass
    second = (near @ (points.unsqueeze(-1) * points.unsqueeze(-2)).flatten(1)).view(-1, 3, 3) / mass.unsqueeze(-1)
    values, vectors = torch.linalg.eigh(second - mean.unsqueeze(-1) * mean.unsqueeze(-2))
    return vectors[..., 2], values[:, 2] > ELONGATED**2 * values[:, 1]
