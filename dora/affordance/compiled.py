"""The grasp energy compiled for a CPU: the same values and gradients as `GraspEnergy`, row by row in one loop.

A row has some hundred points, too few for tensor operations to be worth their overhead: compiled, an evaluation
takes a fraction of the time. `GraspEnergy` stays the definition; a test holds this module to it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor

from dora.affordance.energies import (
    CLEARANCE,
    LENGTH,
    PALM_IMPORTANCE,
    PRESS,
    RAMPED,
    TERMS,
    Evaluation,
    GraspEnergy,
)
from dora.affordance.signed_distance import CHANNELS, CULL, SignedDistanceField

_SMALL = 1e-9
_CLOSURE, _DISTANCE, _REGION, _CLOSING, _PENETRATION, _TABLE, _LIMITS, _SELF = range(len(TERMS))


def native(function: Callable) -> Callable:
    """A function compiled by Numba, kept on disk; type checks that were put around it are left out."""
    return njit(cache=True, error_model="numpy")(inspect.unwrap(function))


class _Hand(NamedTuple):
    """Arrays of `HandModel` and `GraspEnergy`: joints finger by finger, then points, then pairs of capsules."""

    depth: int
    constant: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray
    axes: np.ndarray
    leader: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    close: np.ndarray
    contact_body: np.ndarray
    contact_local: np.ndarray
    sphere_body: np.ndarray
    sphere_local: np.ndarray
    sphere_radius: np.ndarray
    sphere_reach: np.ndarray
    capsule_body: np.ndarray
    ends: np.ndarray
    radius: np.ndarray
    pairs: np.ndarray
    bound: np.ndarray


class _Field(NamedTuple):
    """Arrays of `SignedDistanceField`: all channels, distance, nodes per axis, first node, nodes per m, cull (m)."""

    table: np.ndarray
    distance: np.ndarray
    shape: tuple[int, int, int]
    lower: tuple[float, float, float]
    inverse: float
    cull: float


class CompiledEnergy(GraspEnergy):
    """`GraspEnergy` on a CPU, compiled; arguments and results are the same."""

    def __call__(
        self,
        wrist: Float[Tensor, "c 4 4"],
        joints: Float[Tensor, "c a"],
        contacts: Int[Tensor, "c k"],
        ramp: float = 1.0,
    ) -> Evaluation:
        """As `GraspEnergy`."""
        weights = np.array([getattr(self.weights, name) * (ramp if name in RAMPED else 1.0) for name in TERMS])
        plane = self.plane()
        terms, gradient = _evaluate(
            self.arrays(), self.field_arrays(), weights, plane, wrist.numpy(), joints.numpy(), contacts.numpy()
        )
        value = torch.from_numpy(terms).to(joints)
        gradients = torch.from_numpy(gradient).to(joints)
        names = [
            name
            for name in TERMS
            if (name != "region" or self._has_region) and (name != "table" or self.table is not None)
        ]
        total = value @ value.new_tensor(weights)
        return Evaluation(
            total, {name: value[:, TERMS.index(name)] for name in names}, gradients[:, :6], gradients[:, 6:]
        )

    def plane(self) -> np.ndarray:
        """Normal and offset (m) of the table, for compiled functions; infinitely far if there is none."""
        normal, offset = ((0.0, 0.0, 0.0), math.inf) if self.table is None else (self.table.normal, self.table.offset)
        return np.array([*normal, offset])

    @cache  # noqa: B019
    def field_arrays(self) -> _Field:
        """The object for compiled functions."""
        return _field_arrays(self.field)

    @cache  # noqa: B019
    def arrays(self) -> _Hand:
        """The hand for compiled functions."""
        hand, numbers = self.hand, {}
        leader = hand.joint_gain.abs().argmax(1)
        tensors = {
            "constant": hand.constant.flatten(0, 1),
            "cosine": hand.cosine.flatten(0, 1),
            "sine": hand.sine.flatten(0, 1),
            "axes": hand.axes,
            "gain": hand.joint_gain.gather(1, leader[:, None])[:, 0],
            "offset": hand.joint_offset,
            "lower": hand.joint_lower,
            "upper": hand.joint_upper,
            "close": self._close,
            "contact_local": hand.contacts.local,
            "sphere_local": hand.spheres.local,
            "sphere_radius": hand.sphere_radius,
            "sphere_reach": self._skin,
            "ends": hand.ends.local,
            "radius": hand.radius,
            "bound": self._bound[hand.pairs[:, 0], hand.pairs[:, 1]],
        }
        indices = {
            "leader": leader,
            "contact_body": hand.contacts.body,
            "sphere_body": hand.spheres.body,
            "capsule_body": self._capsule_body,
            "pairs": hand.pairs,
        }
        numbers |= {name: np.ascontiguousarray(tensor.double().numpy()) for name, tensor in tensors.items()}
        numbers |= {name: np.ascontiguousarray(tensor.long().numpy()) for name, tensor in indices.items()}
        return _Hand(depth=hand.depth, **numbers)


def _field_arrays(field: SignedDistanceField) -> _Field:
    table = np.ascontiguousarray(field.table.numpy())
    x, y, z = field.shape
    return _Field(
        table=table,
        distance=np.ascontiguousarray(table[:, :1]),
        shape=(x, y, z),
        lower=tuple(field.lower.tolist()),
        inverse=1 / field.spacing,
        cull=CULL * field.spacing,
    )


@native
def _evaluate(hand, field, weights, plane, wrist, joints, contacts):
    """Values of all terms (c, terms) and the gradient of their weighted sum (c, 6 + a)."""
    count, actuated = joints.shape
    bodies, channels = len(hand.axes) + 1, field.table.shape[1]
    terms, gradient = np.zeros((count, len(weights))), np.zeros((count, 6 + actuated))
    poses, closed = np.zeros((bodies, 3, 4)), np.zeros((bodies, 3, 4))
    wrench, wrench_closed = np.zeros((bodies, 6)), np.zeros((bodies, 6))
    angles, angles_closed = np.zeros(bodies - 1), np.zeros(bodies - 1)
    value, slope = np.zeros(channels), np.zeros((channels, 3))
    for row in range(count):
        _forward(hand, wrist[row], joints[row], 0.0, angles, poses)
        _forward(hand, wrist[row], joints[row], 1.0, angles_closed, closed)
        wrench[:] = 0.0
        wrench_closed[:] = 0.0
        _contact_terms(hand, field, weights, poses, contacts[row], value, slope, terms[row], wrench)
        terms[row, _CLOSING] = _closing(
            hand, field, weights[_CLOSING], closed, contacts[row], value, slope, wrench_closed
        )
        _sphere_terms(hand, field, weights, plane, poses, value, slope, terms[row], wrench)
        terms[row, _SELF] = _self_penetration(hand, weights[_SELF], 0.0, poses, wrench)
        terms[row, _LIMITS] = _limits(hand, weights[_LIMITS], angles, gradient[row])
        _pull_back(hand, poses, wrench, gradient[row])
        _pull_back(hand, closed, wrench_closed, gradient[row])
    return terms, gradient


@native
def _forward(hand, wrist, joints, share, angles, poses):
    """Angles of all joints and poses (bodies, 3, 4) of a hand closed by a share of `close`."""
    for i in range(3):
        for k in range(4):
            poses[0, i, k] = wrist[i, k]
    local = np.empty((3, 4))
    for joint in range(len(angles)):
        a = hand.leader[joint]
        angle = hand.offset[joint] + hand.gain[joint] * (joints[a] + share * hand.close[a])
        angles[joint] = angle
        cosine, sine = math.cos(angle), math.sin(angle)
        for i in range(3):
            for k in range(4):
                local[i, k] = (
                    hand.constant[joint, i, k] + cosine * hand.cosine[joint, i, k] + sine * hand.sine[joint, i, k]
                )
        above = 0 if joint % hand.depth == 0 else joint
        for i in range(3):
            for k in range(4):
                total = poses[above, i, 3] if k == 3 else 0.0
                for m in range(3):
                    total += poses[above, i, m] * local[m, k]
                poses[joint + 1, i, k] = total


@native
def _point(poses, body, local, index):
    """A point of a body (m) in the frame of the poses."""
    x, y, z = local[index, 0], local[index, 1], local[index, 2]
    return (
        poses[body, 0, 0] * x + poses[body, 0, 1] * y + poses[body, 0, 2] * z + poses[body, 0, 3],
        poses[body, 1, 0] * x + poses[body, 1, 1] * y + poses[body, 1, 2] * z + poses[body, 1, 3],
        poses[body, 2, 0] * x + poses[body, 2, 1] * y + poses[body, 2, 2] * z + poses[body, 2, 3],
    )


@native
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@native
def _push(wrench, body, point, force):
    """Adds a force at a point, and its moment about the origin, to the wrench on a body."""
    moment = _cross(point, force)
    for i in range(3):
        wrench[body, i] += force[i]
        wrench[body, 3 + i] += moment[i]


@native
def _nearest(position, lower, inverse, count):
    """Index of the nearest node along one axis."""
    return int(min(max((position - lower) * inverse + 0.5, 0.0), count - 0.5))


@native
def _coarse(field, point):
    """Distance (m) at the node nearest to a point."""
    i = _nearest(point[0], field.lower[0], field.inverse, field.shape[0])
    j = _nearest(point[1], field.lower[1], field.inverse, field.shape[1])
    k = _nearest(point[2], field.lower[2], field.inverse, field.shape[2])
    return field.distance[(i * field.shape[1] + j) * field.shape[2] + k, 0]


@native
def _along(position, lower, inverse, count):
    """Along one axis: first node of the cell, share of the cell passed, distance (m) beyond the grid."""
    place = (position - lower) * inverse
    inside = min(max(place, 0.0), count - 1.0)
    base = min(int(inside), count - 2)
    return base, inside - base, (place - inside) / inverse


@native
def _sample(field, table, point, value, slope):
    """As `SignedDistanceField.sample`: interpolated channels of a table and their derivatives (per m)."""
    i, x, outside_x = _along(point[0], field.lower[0], field.inverse, field.shape[0])
    j, y, outside_y = _along(point[1], field.lower[1], field.inverse, field.shape[1])
    k, z, outside_z = _along(point[2], field.lower[2], field.inverse, field.shape[2])
    outside = (outside_x, outside_y, outside_z)
    distant = math.sqrt(outside_x**2 + outside_y**2 + outside_z**2)
    row, plane = field.shape[2], field.shape[1] * field.shape[2]
    a = i * plane + j * row + k
    b = a + plane
    for c in range(table.shape[1]):
        v000, v001 = table[a, c], table[a + 1, c]
        v010, v011 = table[a + row, c], table[a + row + 1, c]
        v100, v101 = table[b, c], table[b + 1, c]
        v110, v111 = table[b + row, c], table[b + row + 1, c]
        d00, d01, d10, d11 = v100 - v000, v101 - v001, v110 - v010, v111 - v011
        v00, v01, v10, v11 = v000 + x * d00, v001 + x * d01, v010 + x * d10, v011 + x * d11
        v0, v1 = v00 + y * (v10 - v00), v01 + y * (v11 - v01)
        value[c] = v0 + z * (v1 - v0)
        d0, d1 = d00 + y * (d10 - d00), d01 + y * (d11 - d01)
        slope[c, 0] = (d0 + z * (d1 - d0)) * field.inverse
        slope[c, 1] = ((v10 - v00) + z * ((v11 - v01) - (v10 - v00))) * field.inverse
        slope[c, 2] = (v1 - v0) * field.inverse
        if distant > 0.0:
            for axis in range(3):
                if outside[axis] != 0.0:
                    slope[c, axis] = 0.0
                if c == 0 or c == CHANNELS:
                    slope[c, axis] += outside[axis] / distant
            if c == 0 or c == CHANNELS:
                value[c] += distant


@native
def _contact_terms(hand, field, weights, poses, contacts, value, slope, terms, wrench):
    """closure, distance and region."""
    count = len(contacts)
    points, normals, lengths = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    jacobian = np.empty((count, 3, 3))
    force, torque = np.zeros(3), np.zeros(3)
    for k in range(count):
        body = hand.contact_body[contacts[k]]
        point = _point(poses, body, hand.contact_local, contacts[k])
        _sample(field, field.table, point, value, slope)
        importance = PALM_IMPORTANCE if body == 0 else 1.0
        terms[_DISTANCE] += importance * abs(value[0])
        pull = weights[_DISTANCE] * importance * np.sign(value[0])
        along = 0.0
        if len(value) > CHANNELS:
            terms[_REGION] += value[CHANNELS]
            along = weights[_REGION]
        last = len(value) - 1
        _push(
            wrench,
            body,
            point,
            (
                pull * slope[0, 0] + along * slope[last, 0],
                pull * slope[0, 1] + along * slope[last, 1],
                pull * slope[0, 2] + along * slope[last, 2],
            ),
        )
        lengths[k] = max(math.sqrt(value[1] ** 2 + value[2] ** 2 + value[3] ** 2), _SMALL)
        for i in range(3):
            points[k, i], normals[k, i] = point[i], -value[1 + i] / lengths[k]
            for j in range(3):
                jacobian[k, i, j] = slope[1 + i, j]
        moment = _cross(points[k], normals[k])
        for i in range(3):
            force[i] += normals[k, i]
            torque[i] += moment[i] / LENGTH
    for i in range(3):
        terms[_CLOSURE] += force[i] ** 2 + torque[i] ** 2
    by_point = np.empty(3)
    for k in range(count):
        lever, unit = _cross(torque, points[k]), normals[k]
        by_normal = (
            2 * (force[0] + lever[0] / LENGTH),
            2 * (force[1] + lever[1] / LENGTH),
            2 * (force[2] + lever[2] / LENGTH),
        )
        along = unit[0] * by_normal[0] + unit[1] * by_normal[1] + unit[2] * by_normal[2]
        turned = _cross(unit, torque)
        for i in range(3):
            by_point[i] = 2 / LENGTH * turned[i]
            for j in range(3):
                by_point[i] -= (by_normal[j] - unit[j] * along) / lengths[k] * jacobian[k, j, i]
            by_point[i] *= weights[_CLOSURE]
        _push(wrench, hand.contact_body[contacts[k]], points[k], by_point)


@native
def _closing(hand, field, weight, poses, contacts, value, slope, wrench):
    total = 0.0
    for k in range(len(contacts)):
        body = hand.contact_body[contacts[k]]
        if body == 0:
            continue
        point = _point(poses, body, hand.contact_local, contacts[k])
        _sample(field, field.distance, point, value, slope)
        miss = value[0] + PRESS
        if miss > 0.0:
            total += miss
            _push(wrench, body, point, (weight * slope[0, 0], weight * slope[0, 1], weight * slope[0, 2]))
    return total


@native
def _sphere_terms(hand, field, weights, plane, poses, value, slope, terms, wrench):
    """penetration and table."""
    for s in range(len(hand.sphere_body)):
        body = hand.sphere_body[s]
        point = _point(poses, body, hand.sphere_local, s)
        if _coarse(field, point) < hand.sphere_reach[s] + field.cull:
            _sample(field, field.distance, point, value, slope)
            depth = hand.sphere_reach[s] - value[0]
            if depth > 0.0:
                terms[_PENETRATION] += depth
                w = -weights[_PENETRATION]
                _push(wrench, body, point, (w * slope[0, 0], w * slope[0, 1], w * slope[0, 2]))
        height = plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]
        depth = hand.sphere_radius[s] + CLEARANCE - height
        if depth > 0.0:
            terms[_TABLE] += depth
            w = -weights[_TABLE]
            _push(wrench, body, point, (w * plane[0], w * plane[1], w * plane[2]))


@native
def _self_penetration(hand, weight, stiffness, poses, wrench):
    """Sum of overlaps (m); capsules part with a force of `weight` and of `stiffness` times the overlap."""
    capsules = len(hand.radius)
    ends, middle = np.empty((2 * capsules, 3)), np.empty((capsules, 3))
    for e in range(2 * capsules):
        ends[e, 0], ends[e, 1], ends[e, 2] = _point(poses, hand.capsule_body[e // 2], hand.ends, e)
    for c in range(capsules):
        for i in range(3):
            middle[c, i] = 0.5 * (ends[2 * c, i] + ends[2 * c + 1, i])
    total, pairs, bound = 0.0, hand.pairs, hand.bound
    for q in range(len(bound)):
        a, b = pairs[q, 0], pairs[q, 1]
        x, y, z = middle[a, 0] - middle[b, 0], middle[a, 1] - middle[b, 1], middle[a, 2] - middle[b, 2]
        if x * x + y * y + z * z < bound[q]:
            total += _overlap(hand, weight, stiffness, a, b, ends, wrench)
    return total


@native
def _overlap(hand, weight, stiffness, a, b, ends, wrench):
    """Overlap (m) of two capsules, and the forces that part them."""
    uu = vv = ww = uv = uw = vw = 0.0
    for i in range(3):
        u, v = ends[2 * a + 1, i] - ends[2 * a, i], ends[2 * b + 1, i] - ends[2 * b, i]
        w = ends[2 * a, i] - ends[2 * b, i]
        uu, vv, ww, uv, uw, vw = uu + u * u, vv + v * v, ww + w * w, uv + u * v, uw + u * w, vw + v * w
    s = min(max((uv * vw - uw * vv) / max(uu * vv - uv * uv, _SMALL**2), 0.0), 1.0)
    t = min(max((uv * s + vw) / max(vv, _SMALL**2), 0.0), 1.0)
    s = min(max((uv * t - uw) / max(uu, _SMALL**2), 0.0), 1.0)
    square = ww + s * s * uu + t * t * vv + 2 * (s * uw - t * vw - s * t * uv)
    limit = hand.radius[a] + hand.radius[b]
    if square >= limit * limit:
        return 0.0
    first, second = _between(ends, a, s), _between(ends, b, t)
    distance = math.sqrt(max(square, 0.0))
    w = -(weight + stiffness * (limit - distance)) / max(distance, _SMALL)
    force = (w * (first[0] - second[0]), w * (first[1] - second[1]), w * (first[2] - second[2]))
    _push(wrench, hand.capsule_body[a], first, force)
    _push(wrench, hand.capsule_body[b], second, (-force[0], -force[1], -force[2]))
    return limit - distance


@native
def _between(ends, capsule, share):
    """A point on a capsule's axis."""
    a, b = 2 * capsule, 2 * capsule + 1
    return (
        ends[a, 0] + share * (ends[b, 0] - ends[a, 0]),
        ends[a, 1] + share * (ends[b, 1] - ends[a, 1]),
        ends[a, 2] + share * (ends[b, 2] - ends[a, 2]),
    )


@native
def _limits(hand, weight, angles, gradient):
    total = 0.0
    for joint in range(len(angles)):
        above, below = angles[joint] - hand.upper[joint], hand.lower[joint] - angles[joint]
        if above > 0.0 or below > 0.0:
            total += max(above, below)
            gradient[6 + hand.leader[joint]] += weight * (1.0 if above > 0.0 else -1.0) * hand.gain[joint]
    return total


@native
def _pull_back(hand, poses, wrench, gradient):
    """Adds the generalised forces of wrenches on the bodies to the gradient; as `HandModel.pull_back`."""
    total, beyond = wrench[0].copy(), np.empty(6)
    for joint in range(len(hand.axes) - 1, -1, -1):
        body, axis = joint + 1, hand.axes[joint]
        if joint % hand.depth == hand.depth - 1:
            beyond[:] = 0.0
        for i in range(6):
            beyond[i] += wrench[body, i]
        pose = poses[body]
        lever = _cross(pose[:, 3], beyond)
        torque = 0.0
        for i in range(3):
            turned = pose[i, 0] * axis[0] + pose[i, 1] * axis[1] + pose[i, 2] * axis[2]
            torque += turned * (beyond[3 + i] - lever[i])
        gradient[6 + hand.leader[joint]] += torque * hand.gain[joint]
        if joint % hand.depth == 0:
            for i in range(6):
                total[i] += beyond[i]
    lever = _cross(poses[0, :, 3], total)
    for i in range(3):
        gradient[i] += total[i]
        gradient[3 + i] += total[3 + i] - lever[i]
