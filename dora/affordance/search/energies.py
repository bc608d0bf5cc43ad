"""The grasp energy E = E_DFC + E_HO + E_Robot, every term named, weighted and with its exact gradient.

| term | part | value |
|---|---|---|
| closure | E_DFC | ||G c||^2 at the hand's contact points, c the object's inward normals there |
| distance | E_HO | sum over contact points of abs(signed distance) [m], times `PALM_IMPORTANCE` for the palm |
| region | E_HO | sum over contact points of the distance to the region to be held [m] |
| closing | E_HO | sum over contact points on fingers of (distance + `PRESS`)+ when the hand closes a little [m] |
| penetration | E_HO | sum over the hand's spheres of their overlap with the object and a thin skin around it [m] |
| table | E_HO | sum over the spheres of their depth below the table plus a clearance [m] |
| limits | E_Robot | sum over the joints of the angle beyond a limit [rad] |
| self_penetration | E_Robot | sum over pairs of capsules that may collide of their overlap [m] |

All positions are in the object frame. A term yields its value per candidate and forces dE/dp on points of
the hand; the principle of virtual work (`HandModel.pull_back`) turns those into the gradient with respect
to wrist and joints. There is no automatic differentiation, and only spheres near the object are evaluated.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.hand.grasp_test_settings import STANDARD
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.hand.postures import flexion
from dora.affordance.objects.signed_distance import CHANNELS, SignedDistanceField

LENGTH = 0.1
"""Unit of length of the positions psi in G, so that forces and moments have comparable size [m]."""
CLEARANCE = 3e-3
"""Distance that the hand keeps from the table [m]."""
PALM_IMPORTANCE = 3.0
"""Factor on the term `distance` of contact points on the palm, which cannot close towards the object [1]."""
CLOSING = 0.25
"""Share of the grasp test's squeeze by which the term `closing` closes the hand [1]."""
PRESS = 2e-3
"""Penetration depth that a contact point of the closed hand should reach [m]."""
SKIN = 7e-4
"""Distance outside the surface from which overlap counts: the error of spheres and interpolation [m]."""
SMALLEST_LENGTH = 1e-9
"""Lower bound of a length by which a vector is divided [m]."""


@dataclass(frozen=True)
class Weights:
    """Weight of every term, per unit of the term ([1], [1/m] or [1/rad]); docs/grasps.md gives the reasons."""

    closure: float = 2.0
    distance: float = 100.0
    region: float = 50.0
    closing: float = 100.0
    penetration: float = 600.0
    table: float = 300.0
    limits: float = 10.0
    self_penetration: float = 200.0


TERMS = tuple(field.name for field in fields(Weights))
"""Names of the terms."""
RAMPED = ("penetration", "table", "self_penetration")
"""Terms whose weight grows while a search converges, because they must vanish in the end."""


@dataclass(frozen=True)
class Table:
    """The table as a plane in the object frame: the height above it is normal . p + offset [m]."""

    normal: tuple[float, float, float]
    offset: float


class PointForces(NamedTuple):
    """Forces dE/dp (n, 3) on points (n, 3) of `body` (n,) of candidate `row` (n,); object frame, points in [m]."""

    row: Int[Tensor, " n"]
    body: Int[Tensor, " n"]
    point: Float[Tensor, "n 3"]
    force: Float[Tensor, "n 3"]


class Evaluation(NamedTuple):
    """Weighted sum `total` (c,), unweighted `terms` (c,) by name, and the gradient of `total`.

    `wrist` (c, 6) is the gradient with respect to the wrist's translation [m] and rotation vector [rad] about its
    origin, both in the object frame; `joints` (c, a) that with respect to the actuated joints [rad].
    """

    total: Float[Tensor, " c"]
    terms: dict[str, Float[Tensor, " c"]]
    wrist: Float[Tensor, "c 6"]
    joints: Float[Tensor, "c a"]


class GraspEnergy:
    """The energy E of candidates of one object.

    Args:
        hand: the hand.
        field: the object's distance field, with a region channel if a region is to be held.
        weights: weights of the terms; the defaults if None.
        table: the table on which the object rests; None if it is free.

    Attributes:
        close: (a,) change of the actuated joints that closes the hand for the term `closing` [rad].
        skin: (s,) radii of the hand's spheres and the thickness `SKIN` [m].
    """

    def __init__(
        self, hand: HandModel, field: SignedDistanceField, weights: Weights | None = None, table: Table | None = None
    ) -> None:
        self.hand, self.field, self.table = hand, field, table
        self.weights = weights or Weights()
        start, end = hand.ends.local[0::2], hand.ends.local[1::2]
        bound = 0.5 * (end - start).norm(dim=-1) + hand.radius
        self._bound = torch.full((len(bound), len(bound)), -torch.inf, dtype=hand.dtype, device=hand.device)
        first, second = hand.pairs.unbind(1)
        self._bound[first, second] = (bound[first] + bound[second]).square()
        self._capsule_body = hand.ends.body[0::2]
        self.skin = hand.sphere_radius + SKIN
        self.close = hand.lower.new_tensor(CLOSING * STANDARD.squeeze * hand.robot.reduce_hand(flexion(hand.robot)))
        self._has_region = field.table.shape[1] > CHANNELS

    def __call__(
        self,
        wrist: Float[Tensor, "c 4 4"],
        joints: Float[Tensor, "c a"],
        contacts: Int[Tensor, "c k"],
        ramp: float = 1.0,
    ) -> Evaluation:
        """Evaluate the energy and its gradient.

        Args:
            wrist: (c, 4, 4) pose of the wrist in the object frame [m].
            joints: (c, a) actuated joints [rad].
            contacts: (c, k) indices into `hand.contacts` of the points that should touch.
            ramp: factor on the weights of `RAMPED` [1].
        """
        poses = self.hand.forward(wrist, joints)
        closed = self.hand.forward(wrist, joints + self.close)
        found = self.contact_terms(poses, contacts)
        found |= self.sphere_terms(poses)
        found["self_penetration"] = self.self_penetration(poses)
        terms = {name: value for name, (value, _) in found.items()}
        terms["limits"], slope = self.limits(joints)
        terms["closing"], applied = self.closing(closed, contacts)
        factor = self.ramped_weights(ramp)
        forces = [applied._replace(force=factor[name] * applied.force) for name, (_, applied) in found.items()]
        wrench = assemble(len(wrist), poses.shape[1], forces)
        wrist_gradient, joint_gradient = self.hand.pull_back(poses, wrench)
        wrench = assemble(len(wrist), poses.shape[1], [applied._replace(force=factor["closing"] * applied.force)])
        wrist_closed, joint_closed = self.hand.pull_back(closed, wrench)
        total = torch.stack([factor[name] * value for name, value in terms.items()]).sum(0)
        joint_gradient = joint_gradient + joint_closed + factor["limits"] * slope
        return Evaluation(total, terms, wrist_gradient + wrist_closed, joint_gradient)

    @property
    def names(self) -> list[str]:
        """Names of the terms that this object has: `region` needs one to be held, `table` a table."""
        lacks = {"region": not self._has_region, "table": self.table is None}
        return [name for name in TERMS if not lacks.get(name, False)]

    def ramped_weights(self, ramp: float) -> dict[str, float]:
        """Weight of every one of `TERMS`, those in `RAMPED` multiplied by `ramp`."""
        return {name: getattr(self.weights, name) * (ramp if name in RAMPED else 1.0) for name in TERMS}

    def weighted(self, weights: Weights) -> GraspEnergy:
        """The same energy with other weights."""
        other = copy(self)
        other.weights = weights
        return other

    def contact_points(
        self, poses: Float[Tensor, "c b 4 4"], contacts: Int[Tensor, "c k"]
    ) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"], Float[Tensor, "n 3"]]:
        """Row (n,), body (n,) and position (n, 3) in the object frame [m] of n = c k contact points."""
        count, each = contacts.shape
        row = torch.arange(count, device=contacts.device).repeat_interleave(each)
        body = self.hand.contacts.body[contacts].flatten()
        pose = poses[row, body]
        local = self.hand.contacts.local[contacts].view(-1, 3, 1)
        return row, body, (pose[:, :3, :3] @ local).squeeze(-1) + pose[:, :3, 3]

    def closing(self, poses: Float[Tensor, "c b 4 4"], contacts: Int[Tensor, "c k"]) -> tuple[Tensor, PointForces]:
        """Term `closing`: sum over finger points of (distance + `PRESS`)+ [m]; `poses` are those of the closed hand."""
        row, body, point = self.contact_points(poses, contacts)
        value, slope = self.field.sample(point, 1)
        miss = (value[:, 0] + PRESS) * (body > 0)
        force = slope[:, 0] * (miss > 0).unsqueeze(1)
        return miss.clamp_min(0).view(contacts.shape).sum(1), PointForces(row, body, point, force)

    def contact_terms(
        self, poses: Float[Tensor, "c b 4 4"], contacts: Int[Tensor, "c k"]
    ) -> dict[str, tuple[Tensor, PointForces]]:
        """Terms `closure`, `distance` and `region`, which attract the hand, with their forces."""
        count, each = contacts.shape
        row, body, point = self.contact_points(poses, contacts)
        value, slope = self.field.sample(point)
        terms = {"closure": self._closure(point, value, slope, count, each)}
        importance = torch.where(body == 0, PALM_IMPORTANCE, 1.0).to(value)
        pull = (importance * value[:, 0].sign()).unsqueeze(1) * slope[:, 0]
        terms["distance"] = (importance * value[:, 0].abs()).view(count, each).sum(1), pull
        if self._has_region:
            terms["region"] = value[:, CHANNELS].view(count, each).sum(1), slope[:, CHANNELS]
        return {name: (term, PointForces(row, body, point, force)) for name, (term, force) in terms.items()}

    def _closure(self, point: Tensor, value: Tensor, slope: Tensor, count: int, each: int) -> tuple[Tensor, Tensor]:
        """||G c||^2 (c,) and its derivative (c k, 3) with respect to the contact points."""
        raw = value[:, 1:CHANNELS]
        length = raw.norm(dim=-1, keepdim=True).clamp_min(SMALLEST_LENGTH)
        inward = (-raw / length).view(count, each, 3)
        arm = (point / LENGTH).view(count, each, 3)
        force, torque = net_wrench(arm, inward)
        by_normal = 2 * (force.unsqueeze(1) + torch.linalg.cross(torque.unsqueeze(1), arm)).view(-1, 3)
        unit = inward.view(-1, 3)
        by_raw = -(by_normal - unit * (unit * by_normal).sum(-1, keepdim=True)) / length
        by_point = 2 / LENGTH * torch.linalg.cross(inward, torque.unsqueeze(1)).view(-1, 3)
        by_point = by_point + (by_raw.unsqueeze(1) @ slope[:, 1:CHANNELS]).squeeze(1)
        return force.square().sum(-1) + torque.square().sum(-1), by_point

    def sphere_terms(self, poses: Float[Tensor, "c b 4 4"]) -> dict[str, tuple[Tensor, PointForces]]:
        """Terms `penetration` and `table`, which keep the hand's spheres out of object and table, with their forces."""
        hand = self.hand
        centers = hand.place(poses, hand.spheres)
        terms = {}
        touching = self.field.may_touch(centers, self.skin)
        points = centers.view(-1, 3)[touching]
        value, slope = self.field.sample(points, 1)
        depth = self.skin[touching % len(self.skin)] - value[:, 0]
        terms["penetration"] = self._overlap(touching, points, depth, -slope[:, 0], len(poses))
        if self.table is not None:
            normal = centers.new_tensor(self.table.normal)
            depth = (hand.sphere_radius + (CLEARANCE - self.table.offset)) - centers @ normal
            below = (depth > 0).flatten().nonzero().squeeze(1)
            points = centers.view(-1, 3)[below]
            terms["table"] = self._overlap(below, points, depth.flatten()[below], -normal.expand_as(points), len(poses))
        return terms

    def _overlap(
        self, flat: Tensor, points: Tensor, depth: Tensor, slope: Tensor, count: int
    ) -> tuple[Tensor, PointForces]:
        """Sum of positive depths of spheres with flat indices into (c, s); `slope` is d depth / d point."""
        spheres = len(self.hand.sphere_radius)
        row = flat // spheres
        value = depth.new_zeros(count).index_add_(0, row, depth.clamp_min(0))
        return value, PointForces(row, self.hand.spheres.body[flat % spheres], points, slope * (depth > 0).unsqueeze(1))

    def self_penetration(self, poses: Float[Tensor, "c b 4 4"]) -> tuple[Tensor, PointForces]:
        """Sum over pairs of capsules of (r_a + r_b - distance of their axes)+."""
        row, pair, first, second, gap = self.close_pairs(poses)
        overlap = -gap.clamp_max(0)
        value = overlap.new_zeros(len(poses)).index_add_(0, row, overlap)
        away = first - second
        force = -away / away.norm(dim=-1, keepdim=True).clamp_min(SMALLEST_LENGTH) * (gap < 0).unsqueeze(1)
        body = self._capsule_body[pair].flatten()
        return value, PointForces(row.repeat(2), body, torch.cat((first, second)), torch.cat((force, -force)))

    def close_pairs(
        self, poses: Float[Tensor, "c b 4 4"]
    ) -> tuple[Int[Tensor, " n"], Int[Tensor, "2 n"], Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, " n"]]:
        """Pairs of capsules whose bounding spheres meet.

        Returns:
            Row (n,), indices of the capsules (2, n), nearest points (n, 3) on the axis of each in the frame of
            `poses` [m], and distance (n,) of the surfaces, negative where they overlap [m].
        """
        ends = self.hand.place(poses, self.hand.ends)
        ends = ends - poses[:, None, 0, :3, 3]
        middle = 0.5 * (ends[:, 0::2] + ends[:, 1::2])
        square = middle.square().sum(-1)
        apart = torch.baddbmm(square.unsqueeze(1) + square.unsqueeze(2), middle, middle.mT, alpha=-2)
        row, a, b = (apart < self._bound).nonzero().unbind(1)
        ends = ends + poses[:, None, 0, :3, 3]
        flat, first, second = ends.flatten(0, 1), 2 * (row * middle.shape[1] + a), 2 * (row * middle.shape[1] + b)
        near = segment_points(flat[first], flat[first + 1], flat[second], flat[second + 1])
        gap = (near[0] - near[1]).norm(dim=-1) - self.hand.radius[a] - self.hand.radius[b]
        return row, torch.stack((a, b)), *near, gap

    def limits(self, joints: Float[Tensor, "c a"]) -> tuple[Float[Tensor, " c"], Float[Tensor, "c a"]]:
        """Term `limits`: sum of the angles beyond the limits of all joints, coupled ones included [rad]; gradient."""
        angle = self.hand.all_joints(joints)
        above, below = angle - self.hand.joint_upper, self.hand.joint_lower - angle
        value = above.clamp_min(0).sum(1) + below.clamp_min(0).sum(1)
        return value, ((above > 0).to(angle) - (below > 0).to(angle)) @ self.hand.joint_gain


def net_wrench(
    psi: Float[Tensor, "c k 3"], normals: Float[Tensor, "c k 3"]
) -> tuple[Float[Tensor, "c 3"], Float[Tensor, "c 3"]]:
    """Net wrench G c of the paper: (sum of c_k, sum of psi_k x c_k) of unit forces c_k at points psi_k."""
    return normals.sum(1), torch.linalg.cross(psi, normals).sum(1)


def assemble(count: int, bodies: int, forces: list[PointForces]) -> Float[Tensor, "c b 6"]:
    """Wrench on each of `bodies` bodies of `count` candidates: sum of forces, and of their moments about the origin."""
    row, body, point, force = (torch.cat(parts) for parts in zip(*forces, strict=True))
    wrench = force.new_zeros(count * bodies, 6)
    wrench.index_add_(0, row * bodies + body, torch.cat((force, torch.linalg.cross(point, force)), 1))
    return wrench.view(count, bodies, 6)


def segment_points(
    a0: Float[Tensor, "n 3"], a1: Float[Tensor, "n 3"], b0: Float[Tensor, "n 3"], b1: Float[Tensor, "n 3"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Nearest points of segments a0 a1 and b0 b1, whose lengths may be zero.

    As in C. Ericson, Real-Time Collision Detection, 2004, section 5.1.9. For automatic differentiation the points are
    fixed to their segments: the derivative of the distance with respect to their places along these is zero.
    """
    with torch.no_grad():
        s, t = _segment_shares(a0, a1, b0, b1)
    return a0 + s.unsqueeze(-1) * (a1 - a0), b0 + t.unsqueeze(-1) * (b1 - b0)


def _segment_shares(a0: Tensor, a1: Tensor, b0: Tensor, b1: Tensor) -> tuple[Tensor, Tensor]:
    """Places (n,) of the nearest points along segments a0 a1 and b0 b1, from 0 to 1."""
    u, v, w = a1 - a0, b1 - b0, a0 - b0
    uu, vv, uv = (u * u).sum(-1), (v * v).sum(-1), (u * v).sum(-1)
    uw, vw = (u * w).sum(-1), (v * w).sum(-1)
    tiny = torch.finfo(a0.dtype).tiny
    s = ((uv * vw - uw * vv) / (uu * vv - uv * uv).clamp_min(SMALLEST_LENGTH**2)).clamp(0, 1)
    t = ((uv * s + vw) / vv.clamp_min(tiny)).clamp(0, 1)
    return ((uv * t - uw) / uu.clamp_min(tiny)).clamp(0, 1), t
