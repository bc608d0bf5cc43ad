"""Quasi-static closing in compiled loops: steps of descent towards equilibrium while the hand closes and is loaded.

`dora.affordance.search.quasi_static_closing` describes the model. The object is fixed and the wrist moves in the
object frame; only their relative motion matters.
"""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.search.native.compiling import native
from dora.affordance.search.native.contact import STIFFNESS, Contacts, object_contacts, table_contacts
from dora.affordance.search.native.field import FieldArrays
from dora.affordance.search.native.hand import (
    HandArrays,
    add_force,
    cross,
    forward,
    pull_back,
    rotate,
    self_penetration,
)

MOMENTUM = 0.7
"""Share of the last step that is added to the next one [1]."""
LARGEST_STEP = 3e-3
"""Largest step of the wrist's pose [m]; a rotation counts `LEVER` m per rad."""
LARGEST_TURN = 0.05
"""Largest step of a joint's angle [rad]."""
LEVER = 0.04
"""Typical distance of contacts from the centre of the grasp, which scales rotations [m]."""
EXTRA_CONTACTS = 5.0
"""Number added to the contacts when step sizes are derived from their total stiffness [1]."""
GIVEN_UP_DISPLACEMENT = 0.06
"""Displacement at which the loading of a candidate ends early [m]."""


class Drives(NamedTuple):
    """Drives of all joints: stiffness [N m/rad], largest torque [N m], step of descent per torque [rad/(N m)]."""

    stiffness: np.ndarray
    effort: np.ndarray
    step: np.ndarray


class Steps(NamedTuple):
    """Numbers of steps of descent: while the command moves, then at rest, and under each direction of the weight."""

    closing: int = 60
    settling: int = 20
    weight: int = 20


class QualitySettings(NamedTuple):
    """How candidates are compared: log(1 + force/N) - (displacement + `shift_share` shift) / `displacement_scale` [m].

    The `wanted` best are looked for; the loading of a candidate ends as soon as it cannot be among them.
    """

    displacement_scale: float
    shift_share: float
    wanted: int


class Model(NamedTuple):
    """What all candidates share: hand, distance field of the object, drives, friction and table.

    `center` (3,) is the centre of the grasp in the wrist frame [m]; `friction` is Coulomb's coefficient [1]; `plane`
    (4,) is the table's normal and offset [m], with an infinite offset if there is no table.
    """

    hand: HandArrays
    field: FieldArrays
    drives: Drives
    center: np.ndarray
    friction: float
    plane: np.ndarray


class _State(NamedTuple):
    """State of one candidate.

    `wrist` (4, 4) pose in the object frame, `joints` and `command` (j,) [rad], `weight` (3,) force on the wrist [N],
    `speed` (6 + j,) last step of wrist [m], [rad] and joints [rad], and the contacts with the object.
    """

    wrist: np.ndarray
    joints: np.ndarray
    command: np.ndarray
    weight: np.ndarray
    speed: np.ndarray
    contacts: Contacts


class _Workspace(NamedTuple):
    """Arrays for intermediate results of a step, allocated once."""

    angles: np.ndarray
    poses: np.ndarray
    wrench: np.ndarray
    gradient: np.ndarray
    ends: np.ndarray


@native
def close_and_load(model, steps, quality, load, directions, wrists, opened, squeezed):
    """Closes every hand from `opened` to `squeezed`, then applies a weight along each direction in turn.

    Args:
        model: a `Model`.
        steps: a `Steps`.
        quality: a `QualitySettings`.
        load: the weight [N].
        directions: (d, 3) unit directions of the weight in the object frame.
        wrists: (c, 4, 4) wrist poses in the object frame; overwritten by those after closing.
        opened: (c, j) all joints in the order of the model [rad]; overwritten by those after closing.
        squeezed: (c, j) command of all joints [rad].

    Returns:
        (c, 2 + d): displacement of the object by closing [m], sum of normal forces after closing [N], and the largest
        displacement from there up to each direction [m], until the loading ended.
    """
    count, joints = opened.shape
    result, best = np.zeros((count, 2 + len(directions))), np.full(quality.wanted, -np.inf)
    state, workspace = _make_workspace(len(model.hand.sphere_body), joints, len(model.hand.ends))
    for row in range(count):
        start = wrists[row].copy()
        _begin(state, start, opened[row])
        force = _close(model, steps, opened[row].copy(), squeezed[row], state, workspace)
        wrists[row, :, :], opened[row, :] = state.wrist, state.joints
        shift = _displacement(state.wrist, start)
        result[row, 0], result[row, 1] = shift, force
        unmoved = math.log1p(force) - quality.shift_share * shift / quality.displacement_scale
        limit = min(GIVEN_UP_DISPLACEMENT, (unmoved - best[0]) * quality.displacement_scale)
        far = _load(model, steps.weight, load, directions, start, wrists[row], limit, state, workspace, result[row, 2:])
        _insert(best, unmoved - far / quality.displacement_scale)
    return result


@native
def _insert(best, quality):
    """Inserts a quality into the ascending array of the best ones, if it is better than the first, which drops out."""
    if quality > best[0]:
        place = 1
        while place < len(best) and best[place] < quality:
            best[place - 1] = best[place]
            place += 1
        best[place - 1] = quality


@native
def _make_workspace(spheres, joints, ends):
    """State and workspace for a hand with these numbers of spheres, joints and ends of capsules."""
    state = _State(
        np.zeros((4, 4)),
        np.zeros(joints),
        np.zeros(joints),
        np.zeros(3),
        np.zeros(6 + joints),
        Contacts(
            np.zeros((spheres, 3)), np.zeros((spheres, 3)), np.zeros(spheres, np.bool_), np.zeros(spheres, np.int64)
        ),
    )
    bodies = joints + 1
    workspace = _Workspace(
        np.zeros(joints),
        np.zeros((bodies, 3, 4)),
        np.zeros((bodies, 6)),
        np.zeros(6 + joints),
        np.zeros((ends, 3)),
    )
    return state, workspace


@native
def _begin(state, wrist, opened):
    """Sets the state to an open hand at rest without contacts."""
    state.wrist[:] = wrist
    state.joints[:] = opened
    state.command[:] = opened
    state.weight[:] = 0.0
    state.speed[:] = 0.0
    state.contacts.touching[:] = False
    state.contacts.wait[:] = 0


@native
def _close(model, steps, opened, squeezed, state, workspace):
    """Moves the command from open to squeezed, then holds it constant; returns the sum of normal forces [N]."""
    force = 0.0
    for step in range(steps.closing + steps.settling):
        share = min(1.0, (step + 1) / steps.closing)
        for j in range(len(opened)):
            state.command[j] = opened[j] + share * (squeezed[j] - opened[j])
        force = _descent_step(model, state, workspace)
    return force


@native
def _load(model, steps, load, directions, start, settled, limit, state, workspace, farthest):
    """Applies the weight along each direction until the displacement from the pose `settled` exceeds `limit` [m].

    Writes the largest displacement up to each direction to `farthest` (d,) [m] and returns the last.
    """
    far = 0.0
    for d in range(len(directions)):
        for _ in range(steps):
            if far < limit:
                for i in range(3):
                    state.weight[i] = 0.0
                    for k in range(3):
                        for m in range(3):
                            state.weight[i] += load * state.wrist[i, k] * start[m, k] * directions[d, m]
                _descent_step(model, state, workspace)
                far = max(far, _displacement(state.wrist, settled))
        farthest[d] = far
    return far


@native
def _displacement(wrist, other):
    """Displacement of the object's origin in the wrist frame between two poses of the wrist [m]."""
    square = 0.0
    for i in range(3):
        square += (_origin(wrist, i) - _origin(other, i)) ** 2
    return math.sqrt(square)


@native
def _origin(wrist, axis):
    """Component of the object's origin along one axis of the wrist frame [m]."""
    return -(wrist[0, axis] * wrist[0, 3] + wrist[1, axis] * wrist[1, 3] + wrist[2, axis] * wrist[2, 3])


@native
def _descent_step(model, state, workspace):
    """One step of wrist and joints along the generalised forces; returns the sum of normal forces [N]."""
    hand, drives, joints, command, speed = model.hand, model.drives, state.joints, state.command, state.speed
    poses, wrench, gradient = workspace.poses, workspace.wrench, workspace.gradient
    forward(hand, state.wrist, joints, 0.0, workspace.angles, poses)
    wrench[:] = 0.0
    gradient[:] = 0.0
    if model.plane[3] < np.inf:
        table_contacts(hand.sphere_body, hand.sphere_local, hand.sphere_radius, model.plane, poses, wrench)
    total, contacts = object_contacts(hand, model.field, model.friction, state.contacts, poses, wrench)
    self_penetration(hand, 0.0, STIFFNESS, poses, workspace.ends, wrench)
    add_force(wrench, 0, (0.0, 0.0, 0.0), state.weight)
    pull_back(hand, poses, wrench, gradient)
    for j in range(len(joints)):
        torque = drives.stiffness[j] * (joints[j] - command[j])
        torque = min(max(torque, -drives.effort[j]), drives.effort[j])
        speed[6 + j] = MOMENTUM * speed[6 + j] - (gradient[6 + j] + torque) * drives.step[j]
        step = min(max(speed[6 + j], -LARGEST_TURN), LARGEST_TURN)
        joints[j] = min(max(joints[j] + step, hand.lower[j]), hand.upper[j])
    _move(state.wrist, model.center, (EXTRA_CONTACTS + contacts) * STIFFNESS, gradient, speed)
    return total


@native
def _move(wrist, center, stiffness, gradient, speed):
    """Moves the wrist by one step of descent; its rotation is about the centre of the grasp."""
    arm = (
        -(wrist[0, 0] * center[0] + wrist[0, 1] * center[1] + wrist[0, 2] * center[2]),
        -(wrist[1, 0] * center[0] + wrist[1, 1] * center[1] + wrist[1, 2] * center[2]),
        -(wrist[2, 0] * center[0] + wrist[2, 1] * center[1] + wrist[2, 2] * center[2]),
    )
    lever = cross(arm, gradient)
    size = 0.0
    for i in range(3):
        speed[i] = MOMENTUM * speed[i] - gradient[i] / stiffness
        speed[3 + i] = MOMENTUM * speed[3 + i] - (gradient[3 + i] + lever[i]) / (stiffness * LEVER**2)
        size = max(size, abs(speed[i]), LEVER * abs(speed[3 + i]))
    if size > LARGEST_STEP:
        for i in range(6):
            speed[i] *= LARGEST_STEP / size
    rotate(wrist, arm, (speed[3], speed[4], speed[5]))
    for i in range(3):
        wrist[i, 3] += speed[i]
