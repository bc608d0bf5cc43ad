"""Forward kinematics of one hand and the forces on its bodies, in compiled loops."""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.search.native.compiling import inlined, native

SMALLEST_LENGTH = 1e-9
"""Lower bound of a length by which a vector is divided [m]."""

SMALLEST_ROTATION = 1e-12
"""Angle of rotation below which a pose is left unchanged [rad]."""


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
    """Writes the angles [rad] of all joints and the poses (bodies, 3, 4) of a hand closed by a share of `close`."""
    constant, cosines, sines, depth = hand.constant, hand.cosine, hand.sine, hand.depth
    for i in range(3):
        for k in range(4):
            poses[0, i, k] = wrist[i, k]
    for joint in range(len(angles)):
        a = hand.leader[joint]
        angle = hand.offset[joint] + hand.gain[joint] * (joints[a] + share * hand.close[a])
        angles[joint] = angle
        cosine, sine = math.cos(angle), math.sin(angle)
        above = 0 if joint % depth == 0 else joint
        for k in range(4):
            x = constant[joint, 0, k] + cosine * cosines[joint, 0, k] + sine * sines[joint, 0, k]
            y = constant[joint, 1, k] + cosine * cosines[joint, 1, k] + sine * sines[joint, 1, k]
            z = constant[joint, 2, k] + cosine * cosines[joint, 2, k] + sine * sines[joint, 2, k]
            for i in range(3):
                poses[joint + 1, i, k] = poses[above, i, 0] * x + poses[above, i, 1] * y + poses[above, i, 2] * z
        for i in range(3):
            poses[joint + 1, i, 3] += poses[above, i, 3]


@inlined
def point_of(poses, body, local, index):
    """A point of a body in the frame of the poses [m]."""
    x, y, z = local[index, 0], local[index, 1], local[index, 2]
    return (
        poses[body, 0, 0] * x + poses[body, 0, 1] * y + poses[body, 0, 2] * z + poses[body, 0, 3],
        poses[body, 1, 0] * x + poses[body, 1, 1] * y + poses[body, 1, 2] * z + poses[body, 1, 3],
        poses[body, 2, 0] * x + poses[body, 2, 1] * y + poses[body, 2, 2] * z + poses[body, 2, 3],
    )


@inlined
def cross(a, b):
    """Cross product of two vectors of three components, as a tuple."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inlined
def add_force(wrench, body, point, force):
    """Adds a force [N] at a point [m], and its moment about the origin, to the wrench on a body."""
    moment = cross(point, force)
    for i in range(3):
        wrench[body, i] += force[i]
        wrench[body, 3 + i] += moment[i]


@native
def self_penetration(hand, weight, stiffness, poses, ends, wrench):
    """Sum of the penetration depths of capsule pairs [m]; adds the forces that separate them to `wrench`.

    The force on a pair is `weight` + `stiffness` times its penetration depth. `ends` (2 capsules, 3) is a workspace
    for the end points of the axes.
    """
    body, local, pairs, bound = hand.capsule_body, hand.ends, hand.pairs, hand.bound
    for e in range(len(ends)):
        ends[e, 0], ends[e, 1], ends[e, 2] = point_of(poses, body[e // 2], local, e)
    total = 0.0
    for q in range(len(bound)):
        a, b = 2 * pairs[q, 0], 2 * pairs[q, 1]
        x = ends[a, 0] + ends[a + 1, 0] - ends[b, 0] - ends[b + 1, 0]
        y = ends[a, 1] + ends[a + 1, 1] - ends[b, 1] - ends[b + 1, 1]
        z = ends[a, 2] + ends[a + 1, 2] - ends[b, 2] - ends[b + 1, 2]
        if 0.25 * (x * x + y * y + z * z) < bound[q]:
            total += _overlap(hand.radius, body, weight, stiffness, a // 2, b // 2, ends, wrench)
    return total


@native
def _overlap(radius, body, weight, stiffness, a, b, ends, wrench):
    """Penetration depth of two capsules [m]; adds the forces that separate them."""
    uu = vv = ww = uv = uw = vw = 0.0
    for i in range(3):
        u, v = ends[2 * a + 1, i] - ends[2 * a, i], ends[2 * b + 1, i] - ends[2 * b, i]
        w = ends[2 * a, i] - ends[2 * b, i]
        uu, vv, ww, uv, uw, vw = uu + u * u, vv + v * v, ww + w * w, uv + u * v, uw + u * w, vw + v * w
    s = min(max((uv * vw - uw * vv) / max(uu * vv - uv * uv, SMALLEST_LENGTH**2), 0.0), 1.0)
    t = min(max((uv * s + vw) / max(vv, SMALLEST_LENGTH**2), 0.0), 1.0)
    s = min(max((uv * t - uw) / max(uu, SMALLEST_LENGTH**2), 0.0), 1.0)
    square = ww + s * s * uu + t * t * vv + 2 * (s * uw - t * vw - s * t * uv)
    limit = radius[a] + radius[b]
    if square >= limit * limit:
        return 0.0
    first, second = _between(ends, a, s), _between(ends, b, t)
    distance = math.sqrt(max(square, 0.0))
    w = -(weight + stiffness * (limit - distance)) / max(distance, SMALLEST_LENGTH)
    force = (w * (first[0] - second[0]), w * (first[1] - second[1]), w * (first[2] - second[2]))
    add_force(wrench, body[a], first, force)
    add_force(wrench, body[b], second, (-force[0], -force[1], -force[2]))
    return limit - distance


@inlined
def _between(ends, capsule, share):
    """The point at a share of a capsule's axis."""
    a, b = 2 * capsule, 2 * capsule + 1
    return (
        ends[a, 0] + share * (ends[b, 0] - ends[a, 0]),
        ends[a, 1] + share * (ends[b, 1] - ends[a, 1]),
        ends[a, 2] + share * (ends[b, 2] - ends[a, 2]),
    )


@native
def pull_back(hand, poses, wrench, gradient):
    """Adds the generalised forces of wrenches on the bodies to the gradient; as `HandModel.pull_back`.

    `wrench` is overwritten: the wrench on each body becomes the sum over that body and those it carries.
    """
    axes, leader, gain, depth = hand.axes, hand.leader, hand.gain, hand.depth
    for joint in range(len(axes) - 1, -1, -1):
        body = joint + 1
        above = 0 if joint % depth == 0 else joint
        beyond = (wrench[body, 0], wrench[body, 1], wrench[body, 2])
        lever = cross((poses[body, 0, 3], poses[body, 1, 3], poses[body, 2, 3]), beyond)
        torque = 0.0
        for i in range(3):
            moment = wrench[body, 3 + i] - lever[i]
            for k in range(3):
                torque += poses[body, i, k] * axes[joint, k] * moment
        gradient[6 + leader[joint]] += torque * gain[joint]
        for i in range(6):
            wrench[above, i] += wrench[body, i]
    force = (wrench[0, 0], wrench[0, 1], wrench[0, 2])
    lever = cross((poses[0, 0, 3], poses[0, 1, 3], poses[0, 2, 3]), force)
    for i in range(3):
        gradient[i] += force[i]
        gradient[3 + i] += wrench[0, 3 + i] - lever[i]


@native
def rotate(wrist, arm, rotation):
    """Rotates a pose in place by a rotation vector [rad] about the point at its origin less `arm` (3,) [m]."""
    angle = math.sqrt(rotation[0] ** 2 + rotation[1] ** 2 + rotation[2] ** 2)
    if angle < SMALLEST_ROTATION:
        return
    axis = (rotation[0] / angle, rotation[1] / angle, rotation[2] / angle)
    cosine, sine = math.cos(angle), math.sin(angle)
    for k in range(4):
        old = arm if k == 3 else (wrist[0, k], wrist[1, k], wrist[2, k])
        side = cross(axis, old)
        along = (1 - cosine) * (axis[0] * old[0] + axis[1] * old[1] + axis[2] * old[2])
        for i in range(3):
            new = cosine * old[i] + sine * side[i] + along * axis[i]
            wrist[i, k] += new - old[i]
