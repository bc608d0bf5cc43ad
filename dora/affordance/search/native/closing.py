"""The closing hand in compiled loops: one step of descent towards equilibrium, and the sequence of closing and loading.

`dora.affordance.search.quasi_static_closing` says what is modelled. What moves is the wrist in the object frame: the
object seen from the hand.
"""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.search.native.compiling import native
from dora.affordance.search.native.contact import STIFFNESS, Contacts, rest_on, touch
from dora.affordance.search.native.field import FieldArrays
from dora.affordance.search.native.hand import HandArrays, cross, forward, pull_back, push, self_penetration, turn

MOMENTUM = 0.7
"""Share of the last step that is added to the next one."""
LARGEST_STEP = 3e-3
"""Largest step of the object [m]; a rotation counts `ARM` m per rad."""
LARGEST_TURN = 0.05
"""Largest step of a joint [rad]."""
ARM = 0.04
"""Typical distance [m] of contacts from the middle of the grip."""
SPARE = 5.0
"""Contacts on whose stiffness the step sizes count in addition to those that exist."""
LOST = 0.06
"""Displacement [m] at which a grasp is given up."""


class Drives(NamedTuple):
    """Of all joints: stiffness [N m/rad], effort [N m], and the step per torque [rad/[N m]]."""

    stiffness: np.ndarray
    effort: np.ndarray
    step: np.ndarray


class Steps(NamedTuple):
    """Steps of descent: while the command moves, until the grip rests, and for every direction of the weight."""

    closing: int = 60
    settling: int = 20
    weight: int = 20


class Ranking(NamedTuple):
    """Quality of a candidate, log(1 + force/N) less (displacement + `shift_share` shift) / `much` [m], and how many of
    the best are `wanted`: the others are given up as soon as it is certain that they are not among them."""

    much: float
    shift_share: float
    wanted: int


class Model(NamedTuple):
    """What is the same for all candidates: hand, distance field, drives, middle of the grip in the wrist's frame [m],
    friction, and normal and offset [m] of the table (infinitely far if there is none)."""

    hand: HandArrays
    field: FieldArrays
    drives: Drives
    center: np.ndarray
    friction: float
    plane: np.ndarray


class _State(NamedTuple):
    """Of one candidate: pose of the wrist, joints, their command [rad], force of the weight on the wrist [N], the last
    step, and the contacts with the object."""

    wrist: np.ndarray
    joints: np.ndarray
    command: np.ndarray
    weight: np.ndarray
    speed: np.ndarray
    contacts: Contacts


class _Scratch(NamedTuple):
    """Room for intermediate results of a step."""

    angles: np.ndarray
    poses: np.ndarray
    wrench: np.ndarray
    gradient: np.ndarray
    ends: np.ndarray


@native
def close_and_load(model, steps, ranking, load, directions, wrists, opened, squeezed):
    """Closes every hand from `opened` to `squeezed` (c, j), then lets a weight act along each direction in turn.

    Args:
        model: a `Model`.
        steps: a `Steps`.
        ranking: a `Ranking`.
        load: the weight [N].
        directions: (d, 3) of the weight in the object frame.
        wrists: (c, 4, 4) poses in the object frame; after closing on return.
        opened: (c, j) all joints [rad], in the order of the model; after closing on return.
        squeezed: (c, j) command [rad].

    Returns:
        (c, 2 + d): shift of the object by closing [m], sum of normal forces [N], and the farthest it has been from
        there up to each direction [m], up to when it was given up.
    """
    count, joints = opened.shape
    result, best = np.zeros((count, 2 + len(directions))), np.full(ranking.wanted, -np.inf)
    state, scratch = _room(len(model.hand.sphere_body), joints, len(model.hand.ends))
    for row in range(count):
        start = wrists[row].copy()
        _begin(state, start, opened[row])
        force = _close(model, steps, opened[row].copy(), squeezed[row], state, scratch)
        wrists[row, :, :], opened[row, :] = state.wrist, state.joints
        shift = _moved(state.wrist, start)
        result[row, 0], result[row, 1] = shift, force
        unmoved = math.log1p(force) - ranking.shift_share * shift / ranking.much
        limit = min(LOST, (unmoved - best[0]) * ranking.much)
        far = _load(model, steps.weight, load, directions, start, wrists[row], limit, state, scratch, result[row, 2:])
        _insert(best, unmoved - far / ranking.much)
    return result


@native
def _insert(best, quality):
    """Puts a quality into the ascending list of the best ones, whose first leaves."""
    if quality > best[0]:
        place = 1
        while place < len(best) and best[place] < quality:
            best[place - 1] = best[place]
            place += 1
        best[place - 1] = quality


@native
def _room(spheres, joints, ends):
    """State and scratch of a hand."""
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
    scratch = _Scratch(
        np.zeros(joints),
        np.zeros((bodies, 3, 4)),
        np.zeros((bodies, 6)),
        np.zeros(6 + joints),
        np.zeros((ends, 3)),
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
    state.contacts.touching[:] = False
    state.contacts.wait[:] = 0


@native
def _close(model, steps, opened, squeezed, state, scratch):
    """Moves the command from open to squeezed and settles; returns the sum of normal forces [N]."""
    force = 0.0
    for step in range(steps.closing + steps.settling):
        share = min(1.0, (step + 1) / steps.closing)
        for j in range(len(opened)):
            state.command[j] = opened[j] + share * (squeezed[j] - opened[j])
        force = _relax(model, state, scratch)
    return force


@native
def _load(model, steps, load, directions, start, settled, limit, state, scratch, farthest):
    """The weight along each direction in turn, until the object is `limit` [m] from the settled place; `farthest` (d,)
    gets the farthest it has been [m], which is returned, too."""
    far = 0.0
    for d in range(len(directions)):
        for _ in range(steps):
            if far < limit:
                for i in range(3):
                    state.weight[i] = 0.0
                    for k in range(3):
                        for m in range(3):
                            state.weight[i] += load * state.wrist[i, k] * start[m, k] * directions[d, m]
                _relax(model, state, scratch)
                far = max(far, _moved(state.wrist, settled))
        farthest[d] = far
    return far


@native
def _moved(wrist, other):
    """Distance [m] of the object's origin between two poses of the wrist, seen from the wrist."""
    square = 0.0
    for i in range(3):
        square += (_origin(wrist, i) - _origin(other, i)) ** 2
    return math.sqrt(square)


@native
def _origin(wrist, axis):
    """Position [m] of the object's origin in the wrist's frame, along one axis."""
    return -(wrist[0, axis] * wrist[0, 3] + wrist[1, axis] * wrist[1, 3] + wrist[2, axis] * wrist[2, 3])


@native
def _relax(model, state, scratch):
    """One step of descent of all forces; returns the sum of normal forces [N]."""
    hand, drives, joints, command, speed = model.hand, model.drives, state.joints, state.command, state.speed
    poses, wrench, gradient = scratch.poses, scratch.wrench, scratch.gradient
    forward(hand, state.wrist, joints, 0.0, scratch.angles, poses)
    wrench[:] = 0.0
    gradient[:] = 0.0
    if model.plane[3] < np.inf:
        rest_on(hand.sphere_body, hand.sphere_local, hand.sphere_radius, model.plane, poses, wrench)
    total, contacts = touch(hand, model.field, model.friction, state.contacts, poses, wrench)
    self_penetration(hand, 0.0, STIFFNESS, poses, scratch.ends, wrench)
    push(wrench, 0, (0.0, 0.0, 0.0), state.weight)
    pull_back(hand, poses, wrench, gradient)
    for j in range(len(joints)):
        torque = drives.stiffness[j] * (joints[j] - command[j])
        torque = min(max(torque, -drives.effort[j]), drives.effort[j])
        speed[6 + j] = MOMENTUM * speed[6 + j] - (gradient[6 + j] + torque) * drives.step[j]
        step = min(max(speed[6 + j], -LARGEST_TURN), LARGEST_TURN)
        joints[j] = min(max(joints[j] + step, hand.lower[j]), hand.upper[j])
    _move(state.wrist, model.center, (SPARE + contacts) * STIFFNESS, gradient, speed)
    return total


@native
def _move(wrist, center, stiffness, gradient, speed):
    """Moves the wrist, which is the object seen from the hand, by a step about the middle of the grip."""
    arm = (
        -(wrist[0, 0] * center[0] + wrist[0, 1] * center[1] + wrist[0, 2] * center[2]),
        -(wrist[1, 0] * center[0] + wrist[1, 1] * center[1] + wrist[1, 2] * center[2]),
        -(wrist[2, 0] * center[0] + wrist[2, 1] * center[1] + wrist[2, 2] * center[2]),
    )
    lever = cross(arm, gradient)
    size = 0.0
    for i in range(3):
        speed[i] = MOMENTUM * speed[i] - gradient[i] / stiffness
        speed[3 + i] = MOMENTUM * speed[3 + i] - (gradient[3 + i] + lever[i]) / (stiffness * ARM**2)
        size = max(size, abs(speed[i]), ARM * abs(speed[3 + i]))
    if size > LARGEST_STEP:
        for i in range(6):
            speed[i] *= LARGEST_STEP / size
    turn(wrist, arm, (speed[3], speed[4], speed[5]))
    for i in range(3):
        wrist[i, 3] += speed[i]
