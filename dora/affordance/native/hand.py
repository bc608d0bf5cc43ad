"""Kinematics of one hand and forces on its bodies."""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.native.compiling import native

SMALL = 1e-9
"""Length (m) below which a direction is not divided by it."""


class HandArrays(NamedTuple):
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


@native
def forward(hand, wrist, joints, share, angles, poses):
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
def point_of(poses, body, local, index):
    """A point of a body (m) in the frame of the poses."""
    x, y, z = local[index, 0], local[index, 1], local[index, 2]
    return (
        poses[body, 0, 0] * x + poses[body, 0, 1] * y + poses[body, 0, 2] * z + poses[body, 0, 3],
        poses[body, 1, 0] * x + poses[body, 1, 1] * y + poses[body, 1, 2] * z + poses[body, 1, 3],
        poses[body, 2, 0] * x + poses[body, 2, 1] * y + poses[body, 2, 2] * z + poses[body, 2, 3],
    )


@native
def cross(a, b):
    """Cross product of two vectors of three components, as a tuple."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@native
def push(wrench, body, point, force):
    """Adds a force at a point, and its moment about the origin, to the wrench on a body."""
    moment = cross(point, force)
    for i in range(3):
        wrench[body, i] += force[i]
        wrench[body, 3 + i] += moment[i]


@native
def self_penetration(hand, weight, stiffness, poses, wrench):
    """Sum of overlaps (m); capsules part with a force of `weight` and of `stiffness` times the overlap."""
    capsules = len(hand.radius)
    ends, middle = np.empty((2 * capsules, 3)), np.empty((capsules, 3))
    for e in range(2 * capsules):
        ends[e, 0], ends[e, 1], ends[e, 2] = point_of(poses, hand.capsule_body[e // 2], hand.ends, e)
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
    s = min(max((uv * vw - uw * vv) / max(uu * vv - uv * uv, SMALL**2), 0.0), 1.0)
    t = min(max((uv * s + vw) / max(vv, SMALL**2), 0.0), 1.0)
    s = min(max((uv * t - uw) / max(uu, SMALL**2), 0.0), 1.0)
    square = ww + s * s * uu + t * t * vv + 2 * (s * uw - t * vw - s * t * uv)
    limit = hand.radius[a] + hand.radius[b]
    if square >= limit * limit:
        return 0.0
    first, second = _between(ends, a, s), _between(ends, b, t)
    distance = math.sqrt(max(square, 0.0))
    w = -(weight + stiffness * (limit - distance)) / max(distance, SMALL)
    force = (w * (first[0] - second[0]), w * (first[1] - second[1]), w * (first[2] - second[2]))
    push(wrench, hand.capsule_body[a], first, force)
    push(wrench, hand.capsule_body[b], second, (-force[0], -force[1], -force[2]))
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
def pull_back(hand, poses, wrench, gradient):
    """Adds the generalised forces of wrenches on the bodies to the gradient; as `HandModel.pull_back`."""
    total, beyond = wrench[0].copy(), np.empty(6)
    for joint in range(len(hand.axes) - 1, -1, -1):
        body, axis = joint + 1, hand.axes[joint]
        if joint % hand.depth == hand.depth - 1:
            beyond[:] = 0.0
        for i in range(6):
            beyond[i] += wrench[body, i]
        pose = poses[body]
        lever = cross(pose[:, 3], beyond)
        torque = 0.0
        for i in range(3):
            turned = pose[i, 0] * axis[0] + pose[i, 1] * axis[1] + pose[i, 2] * axis[2]
            torque += turned * (beyond[3 + i] - lever[i])
        gradient[6 + hand.leader[joint]] += torque * hand.gain[joint]
        if joint % hand.depth == 0:
            for i in range(6):
                total[i] += beyond[i]
    lever = cross(poses[0, :, 3], total)
    for i in range(3):
        gradient[i] += total[i]
        gradient[3 + i] += total[3 + i] - lever[i]
