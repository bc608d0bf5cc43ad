"""The closing hand in compiled loops: one step of descent towards equilibrium, and the sequence of closing and loading.

`dora.affordance.holding` says what is modelled. What moves is the wrist in the object frame: the object seen from the
hand.
"""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.native.compiling import native
from dora.affordance.native.field import FieldArrays, coarse, sample
from dora.affordance.native.hand import SMALL, HandArrays, cross, forward, point_of, pull_back, push, self_penetration

STIFFNESS = 4e3
"""Of the contact of one sphere, across and along the surface (N/m); grips overlap by millimetres then."""
MOMENTUM = 0.7
"""Share of the last step that is added to the next one."""
LARGEST_STEP = 3e-3
"""Largest step of the object (m, and in units of `ARM` rad)."""
LARGEST_TURN = 0.05
"""Largest step of a joint (rad)."""
APPROACH = 6e-3
"""Distance (m) that a sphere comes nearer to the object in one step at most; those far away wait."""
ARM = 0.04
"""Typical distance (m) of contacts from the middle of the grip."""
SPARE = 5.0
"""Contacts on whose stiffness the step sizes count in addition to those that exist."""
LOST = 0.06
"""Displacement (m) at which a grasp is given up."""
NO_TURN = 1e-12
"""Angle (rad) of a step that does not turn."""


class Drives(NamedTuple):
    """Of all joints: stiffness (N m/rad), effort (N m), and the step per torque (rad/N m)."""

    stiffness: np.ndarray
    effort: np.ndarray
    step: np.ndarray


class Steps(NamedTuple):
    """Steps of descent: while the command moves, until the grip rests, and for every direction of the weight."""

    closing: int = 60
    settling: int = 20
    weight: int = 20


class Model(NamedTuple):
    """What is the same for all candidates: hand, distance field, drives, middle of the grip in the wrist's frame (m),
    friction, and normal and offset (m) of the table (infinitely far if there is none)."""

    hand: HandArrays
    field: FieldArrays
    drives: Drives
    center: np.ndarray
    friction: float
    plane: np.ndarray


class _State(NamedTuple):
    """Of one candidate: pose of the wrist, joints, their command (rad), force of the weight on the wrist (N), the last
    step; per sphere its material point in contact, the object's point there, whether it touches, steps to wait."""

    wrist: np.ndarray
    joints: np.ndarray
    command: np.ndarray
    weight: np.ndarray
    speed: np.ndarray
    local: np.ndarray
    anchor: np.ndarray
    touching: np.ndarray
    wait: np.ndarray


class _Scratch(NamedTuple):
    """Room for intermediate results of a step."""

    angles: np.ndarray
    poses: np.ndarray
    wrench: np.ndarray
    gradient: np.ndarray
    value: np.ndarray
    slope: np.ndarray


@native
def close_and_load(model, steps, load, directions, wrists, opened, squeezed):
    """Closes every hand from `opened` to `squeezed` (c, j), then lets a weight act along each direction in turn.

    Args:
        model: a `Model`.
        steps: a `Steps`.
        load: the weight (N).
        directions: (d, 3) of the weight in the object frame.
        wrists: (c, 4, 4) poses in the object frame; after closing on return.
        opened: (c, j) all joints (rad), in the order of the model; after closing on return.
        squeezed: (c, j) command (rad).

    Returns:
        (c, 2 + d): shift of the object by closing (m), sum of normal forces (N), and the farthest it has been from
        there up to each direction (m).
    """
    count, joints = opened.shape
    result = np.zeros((count, 2 + len(directions)))
    state, scratch = _room(len(model.hand.sphere_body), joints)
    for row in range(count):
        start = wrists[row].copy()
        _begin(state, start, opened[row])
        result[row, 1] = _close(model, steps, opened[row].copy(), squeezed[row], state, scratch)
        wrists[row, :, :], opened[row, :] = state.wrist, state.joints
        result[row, 0] = _moved(state.wrist, start)
        _load(model, steps.weight, load, directions, start, wrists[row], state, scratch, result[row, 2:])
    return result


@native
def _room(spheres, joints):
    """State and scratch of a hand."""
    state = _State(
        np.zeros((4, 4)),
        np.zeros(joints),
        np.zeros(joints),
        np.zeros(3),
        np.zeros(6 + joints),
        np.zeros((spheres, 3)),
        np.zeros((spheres, 3)),
        np.zeros(spheres, np.bool_),
        np.zeros(spheres, np.int64),
    )
    bodies = joints + 1
    scratch = _Scratch(
        np.zeros(joints),
        np.zeros((bodies, 3, 4)),
        np.zeros((bodies, 6)),
        np.zeros(6 + joints),
        np.zeros(1),
        np.zeros((1, 3)),
    )
    return state, scratch


@native
def _begin(state, wrist, opened):
    """An open hand at rest that touches nothing."""
    state.wrist[:] = wrist
    state.joints[:] = opened
    state.command[:] = opened
    state.weight[:] = 0.0
    state.speed[:] = 0.0
    state.touching[:] = False
    state.wait[:] = 0


@native
def _close(model, steps, opened, squeezed, state, scratch):
    """Moves the command from open to squeezed and settles; returns the sum of normal forces (N)."""
    force = 0.0
    for step in range(steps.closing + steps.settling):
        share = min(1.0, (step + 1) / steps.closing)
        for j in range(len(opened)):
            state.command[j] = opened[j] + share * (squeezed[j] - opened[j])
        force = _relax(model, state, scratch)
    return force


@native
def _load(model, steps, load, directions, start, settled, state, scratch, farthest):
    """The weight along each direction in turn; `farthest` (d,) gets the farthest from the settled place (m)."""
    far = 0.0
    for d in range(len(directions)):
        for _ in range(steps):
            if far < LOST:
                for i in range(3):
                    state.weight[i] = 0.0
                    for k in range(3):
                        for m in range(3):
                            state.weight[i] += load * state.wrist[i, k] * start[m, k] * directions[d, m]
                _relax(model, state, scratch)
                far = max(far, _moved(state.wrist, settled))
        farthest[d] = far


@native
def _moved(wrist, other):
    """Distance (m) of the object's origin between two poses of the wrist, seen from the wrist."""
    square = 0.0
    for i in range(3):
        square += (_origin(wrist, i) - _origin(other, i)) ** 2
    return math.sqrt(square)


@native
def _origin(wrist, axis):
    """Position (m) of the object's origin in the wrist's frame, along one axis."""
    return -(wrist[0, axis] * wrist[0, 3] + wrist[1, axis] * wrist[1, 3] + wrist[2, axis] * wrist[2, 3])


@native
def _relax(model, state, scratch):
    """One step of descent of all forces; returns the sum of normal forces (N)."""
    hand, drives, joints = model.hand, model.drives, state.joints
    poses, wrench, gradient = scratch.poses, scratch.wrench, scratch.gradient
    forward(hand, state.wrist, joints, 0.0, scratch.angles, poses)
    wrench[:] = 0.0
    gradient[:] = 0.0
    total, contacts = 0.0, SPARE
    for s in range(len(hand.sphere_body)):
        if model.plane[3] < np.inf:
            _rest_on(hand, model.plane, poses, s, wrench)
        normal = _touch(model, state, scratch, s)
        if normal > 0.0:
            total += normal
            contacts += 1
    self_penetration(hand, 0.0, STIFFNESS, poses, wrench)
    push(wrench, 0, (0.0, 0.0, 0.0), state.weight)
    pull_back(hand, poses, wrench, gradient)
    for j in range(len(joints)):
        torque = drives.stiffness[j] * (joints[j] - state.command[j])
        torque = min(max(torque, -drives.effort[j]), drives.effort[j])
        state.speed[6 + j] = MOMENTUM * state.speed[6 + j] - (gradient[6 + j] + torque) * drives.step[j]
        step = min(max(state.speed[6 + j], -LARGEST_TURN), LARGEST_TURN)
        joints[j] = min(max(joints[j] + step, hand.lower[j]), hand.upper[j])
    _move(state.wrist, model.center, contacts * STIFFNESS, gradient, state.speed)
    return total


@native
def _touch(model, state, scratch, s):
    """Contact of a sphere with the object, with Coulomb friction: its force goes to the wrench; returns its normal part
    (N), 0 without contact."""
    hand, field, anchor = model.hand, model.field, state.anchor
    if state.wait[s] > 0:
        state.wait[s] -= 1
        return 0.0
    body, radius = hand.sphere_body[s], hand.sphere_radius[s]
    point = point_of(scratch.poses, body, hand.sphere_local, s)
    beyond = coarse(field, point) - radius - field.cull
    if beyond > 0.0:
        state.touching[s] = False
        state.wait[s] = int(beyond / APPROACH)
        return 0.0
    value, slope = scratch.value, scratch.slope
    sample(field, field.distance, point, value, slope)
    depth = radius - value[0]
    if depth <= 0.0:
        state.touching[s] = False
        return 0.0
    length = max(math.sqrt(slope[0, 0] ** 2 + slope[0, 1] ** 2 + slope[0, 2] ** 2), SMALL)
    n = (slope[0, 0] / length, slope[0, 1] / length, slope[0, 2] / length)
    normal = STIFFNESS * depth
    if not state.touching[s]:
        state.touching[s] = True
        _hold_on(scratch.poses, body, point, n, radius, state.local, anchor, s)
    here = point_of(scratch.poses, body, state.local, s)
    slip = (here[0] - anchor[s, 0], here[1] - anchor[s, 1], here[2] - anchor[s, 2])
    along = slip[0] * n[0] + slip[1] * n[1] + slip[2] * n[2]
    t = (slip[0] - along * n[0], slip[1] - along * n[1], slip[2] - along * n[2])
    size = STIFFNESS * math.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
    share = 1.0
    if size > model.friction * normal:
        share = model.friction * normal / size
        for i in range(3):
            anchor[s, i] = here[i] - share * t[i]
    k = share * STIFFNESS
    force = (k * t[0] - normal * n[0], k * t[1] - normal * n[1], k * t[2] - normal * n[2])
    push(scratch.wrench, body, here, force)
    return normal


@native
def _rest_on(hand, plane, poses, s, wrench):
    """The table pushes a sphere out."""
    body = hand.sphere_body[s]
    point = point_of(poses, body, hand.sphere_local, s)
    height = plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]
    depth = hand.sphere_radius[s] - height
    if depth > 0.0:
        k = -STIFFNESS * depth
        push(wrench, body, point, (k * plane[0], k * plane[1], k * plane[2]))


@native
def _hold_on(poses, body, point, n, radius, local, anchor, s):
    """A sphere begins to touch: its material point and the object's point there."""
    for i in range(3):
        anchor[s, i] = point[i] - radius * n[i]
    for k in range(3):
        local[s, k] = 0.0
        for i in range(3):
            local[s, k] += poses[body, i, k] * (anchor[s, i] - poses[body, i, 3])


@native
def _move(wrist, center, stiffness, gradient, speed):
    """Moves the wrist, which is the object seen from the hand, by a step about the middle of the grip."""
    pivot, arm = np.empty(3), np.empty(3)
    for i in range(3):
        pivot[i] = wrist[i, 3] + wrist[i, 0] * center[0] + wrist[i, 1] * center[1] + wrist[i, 2] * center[2]
        arm[i] = wrist[i, 3] - pivot[i]
    lever = cross(arm, gradient)
    size = 0.0
    for i in range(3):
        speed[i] = MOMENTUM * speed[i] - gradient[i] / stiffness
        speed[3 + i] = MOMENTUM * speed[3 + i] - (gradient[3 + i] + lever[i]) / (stiffness * ARM**2)
        size = max(size, abs(speed[i]), ARM * abs(speed[3 + i]))
    if size > LARGEST_STEP:
        for i in range(6):
            speed[i] *= LARGEST_STEP / size
    angle = math.sqrt(speed[3] ** 2 + speed[4] ** 2 + speed[5] ** 2)
    turn = np.eye(3)
    if angle > NO_TURN:
        a, b, c = speed[3] / angle, speed[4] / angle, speed[5] / angle
        cosine, sine = math.cos(angle), math.sin(angle)
        rest = 1 - cosine
        turn[0, 0], turn[0, 1], turn[0, 2] = cosine + a * a * rest, a * b * rest - c * sine, a * c * rest + b * sine
        turn[1, 0], turn[1, 1], turn[1, 2] = b * a * rest + c * sine, cosine + b * b * rest, b * c * rest - a * sine
        turn[2, 0], turn[2, 1], turn[2, 2] = c * a * rest - b * sine, c * b * rest + a * sine, cosine + c * c * rest
    old = wrist.copy()
    for i in range(3):
        for k in range(3):
            wrist[i, k] = turn[i, 0] * old[0, k] + turn[i, 1] * old[1, k] + turn[i, 2] * old[2, k]
        wrist[i, 3] = pivot[i] + speed[i] + turn[i, 0] * arm[0] + turn[i, 1] * arm[1] + turn[i, 2] * arm[2]
