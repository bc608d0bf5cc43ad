"""Whether a squeezing hand would hold: quasi-static equilibrium of drives, contacts with friction, and weight.

A model, not a simulation of motion: the drives are springs with limited torque, hand and object push each other
apart with stiff springs at the spheres of the hand, friction is a spring along the surface that slides at Coulomb's
limit. The hand closes from its open posture to its squeezing command, then the weight acts along every direction of the
protocol; what moves is found by descent with momentum, without masses. The search ranks its candidates by the result.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.compiled import (
    CompiledEnergy,
    _coarse,
    _cross,
    _forward,
    _point,
    _pull_back,
    _push,
    _sample,
    _self_penetration,
    native,
)
from dora.affordance.protocol import DIRECTIONS, STANDARD, Protocol

STIFFNESS = 4e3
"""Of the contact of one sphere, across and along the surface (N/m); grips overlap by millimetres then."""
MOMENTUM = 0.7
LARGEST_STEP = 3e-3
"""Largest step of the object (m, and in units of `ARM` rad) and of the fingers."""
SAFETY = 2.0
"""Weight in the model over that of the object: few steps of descent then tell what slips."""
APPROACH = 6e-3
"""Distance (m) that a sphere comes nearer to the object in one step at most; those far away wait."""
ARM = 0.04
"""Typical distance (m) of contacts from the middle of the grip."""
SPARE = 5.0
"""Contacts on whose stiffness the step sizes count in addition to those that exist."""
FINGER_CONTACTS = 4.0
"""Contacts on whose stiffness the step sizes of the joints count."""
MUCH = 0.01
"""Displacement (m) that outweighs an e-fold of force."""
SHIFT_SHARE = 0.3
"""What a shift by closing counts against a displacement under weight."""
LOST = 0.06
"""Displacement (m) at which a grasp is given up."""


class Holding(NamedTuple):
    """Result of `hold` for c candidates.

    Attributes:
        shift: (c,) how far closing moves the object (m).
        displacement: (c, 6) farthest the object is from where closing left it, up to every direction (m).
        force: (c,) sum of normal forces after closing (N).
        wrist: (c, 4, 4) pose of the wrist in the object frame after closing.
        joints: (c, j) all hand joints after closing (rad), in the order of `RobotDescription.hand`.
    """

    shift: Float[Tensor, " c"]
    displacement: Float[Tensor, "c 6"]
    force: Float[Tensor, " c"]
    wrist: Float[Tensor, "c 4 4"]
    joints: Float[Tensor, "c j"]

    @property
    def quality(self) -> Float[Tensor, " c"]:
        """What ranks candidates: a firm grip that moves little, log(1 + force) less what moves in `MUCH`."""
        return self.force.log1p() - (self.displacement[:, -1] + SHIFT_SHARE * self.shift) / MUCH


class Steps(NamedTuple):
    """Steps of descent: while the command moves, until the grip rests, and for every direction of the weight."""

    closing: int = 60
    settling: int = 20
    weight: int = 20


STEPS = Steps()
"""Steps that judge a candidate."""


class _Drives(NamedTuple):
    stiffness: np.ndarray
    effort: np.ndarray
    damping: np.ndarray


def hold(
    energy: CompiledEnergy,
    wrist: Float[Tensor, "c 4 4"],
    opened: Float[Tensor, "c j"],
    squeezed: Float[Tensor, "c j"],
    mass: float,
    protocol: Protocol = STANDARD,
    steps: Steps = STEPS,
    on_table: bool = False,
) -> Holding:
    """Close and load every candidate.

    Args:
        energy: knows hand and object.
        wrist: pose of the wrist in the object frame.
        opened: all hand joints before closing (rad), in the order of `RobotDescription.hand`.
        squeezed: command of all hand joints.
        mass: of the object (kg).
        protocol: has friction, gravity.
        steps: of the model.
        on_table: whether the hand stays above the energy's table.
    """
    hand, robot = energy.hand, energy.hand.robot.hand
    arrays = energy.arrays()
    joints, order = len(arrays.axes), hand.joint_index
    free = arrays._replace(
        leader=np.arange(joints), gain=np.ones(joints), offset=np.zeros(joints), close=np.zeros(joints)
    )
    index = order.numpy()
    lever = _levers(hand)
    drives = _Drives(
        robot.stiffness[index].astype(float),
        robot.effort[index].astype(float),
        1 / (robot.stiffness[index] + FINGER_CONTACTS * STIFFNESS * lever**2),
    )
    center = torch.as_tensor(hand.grip.center + ARM * hand.grip.normal).double().numpy()
    numbers = np.array([SAFETY * mass * protocol.gravity, protocol.friction])
    end, final = wrist.double().numpy().copy(), opened[:, order].double().numpy()
    result = _hold(
        free,
        steps,
        energy.field_arrays(),
        drives,
        center,
        numbers,
        energy.plane() if on_table else np.array([0.0, 0.0, 0.0, np.inf]),
        np.array(DIRECTIONS),
        end,
        final,
        squeezed[:, order].double().numpy(),
    )
    found = torch.from_numpy(result).to(wrist)
    joints = opened.clone()
    joints[:, order] = torch.from_numpy(final).to(opened)
    return Holding(found[:, 0], found[:, 2:], found[:, 1], torch.from_numpy(end).to(wrist), joints)


def _levers(hand) -> np.ndarray:
    """Distance (m) from every joint to the farthest sphere beyond it, straight hand."""
    eye = torch.eye(4, dtype=hand.dtype)[None]
    poses = hand.forward(eye, torch.zeros_like(hand.lower)[None])
    centers = hand.place(poses, hand.spheres)[0]
    found = np.zeros(hand.fingers * hand.depth)
    body = hand.spheres.body
    for joint in range(len(found)):
        last = (joint // hand.depth + 1) * hand.depth
        beyond = centers[(body > joint) & (body <= last)]
        if len(beyond):
            found[joint] = float((beyond - poses[0, joint + 1, :3, 3]).norm(dim=-1).max())
    return found


@native
def _hold(hand, steps, field, drives, center, numbers, plane, directions, wrists, opened, squeezed):
    count, joints = opened.shape
    bodies, spheres = joints + 1, len(hand.sphere_body)
    result = np.zeros((count, 2 + len(directions)))
    angles, poses, wrench = np.zeros(joints), np.zeros((bodies, 3, 4)), np.zeros((bodies, 6))
    value, slope = np.zeros(1), np.zeros((1, 3))
    local, anchor = np.zeros((spheres, 3)), np.zeros((spheres, 3))
    touching, wait = np.zeros(spheres, np.bool_), np.zeros(spheres, np.int64)
    gradient, speed = np.zeros(6 + joints), np.zeros(6 + joints)
    weight, first = np.zeros(3), np.zeros(3)
    for row in range(count):
        wrist, q = wrists[row].copy(), opened[row].copy()
        start = wrists[row].copy()
        touching[:] = False
        wait[:] = 0
        speed[:] = 0.0
        weight[:] = 0.0
        command = opened[row].copy()
        for step in range(steps.closing + steps.settling):
            share = min(1.0, (step + 1) / steps.closing)
            for j in range(joints):
                command[j] = opened[row, j] + share * (squeezed[row, j] - opened[row, j])
            _forward(hand, wrist, q, 0.0, angles, poses)
            force = _relax(
                hand,
                field,
                drives,
                center,
                numbers[1],
                plane,
                weight,
                wrist,
                q,
                command,
                poses,
                wrench,
                value,
                slope,
                local,
                anchor,
                touching,
                wait,
                gradient,
                speed,
            )
        result[row, 1] = force
        for i in range(3):
            first[i] = _object(wrist, i)
            result[row, 0] += (first[i] - _object(start, i)) ** 2
        result[row, 0] = math.sqrt(result[row, 0])
        settled_wrist, settled_joints = wrist.copy(), q.copy()
        farthest = 0.0
        for d in range(len(directions)):
            for _ in range(steps.weight):
                if farthest < LOST:
                    for i in range(3):
                        weight[i] = 0.0
                        for k in range(3):
                            for m in range(3):
                                weight[i] += numbers[0] * wrist[i, k] * start[m, k] * directions[d, m]
                    _forward(hand, wrist, q, 0.0, angles, poses)
                    _relax(
                        hand,
                        field,
                        drives,
                        center,
                        numbers[1],
                        plane,
                        weight,
                        wrist,
                        q,
                        command,
                        poses,
                        wrench,
                        value,
                        slope,
                        local,
                        anchor,
                        touching,
                        wait,
                        gradient,
                        speed,
                    )
                    moved = 0.0
                    for i in range(3):
                        moved += (_object(wrist, i) - first[i]) ** 2
                    farthest = max(farthest, math.sqrt(moved))
            result[row, 2 + d] = farthest
        wrists[row], opened[row] = settled_wrist, settled_joints
    return result


@native
def _object(wrist, axis):
    """Position of the object's origin in the wrist's frame, along one axis."""
    return -(wrist[0, axis] * wrist[0, 3] + wrist[1, axis] * wrist[1, 3] + wrist[2, axis] * wrist[2, 3])


@native
def _relax(
    hand,
    field,
    drives,
    center,
    friction,
    plane,
    weight,
    wrist,
    q,
    command,
    poses,
    wrench,
    value,
    slope,
    local,
    anchor,
    touching,
    wait,
    gradient,
    speed,
):
    """One step of descent of all forces; returns the sum of normal forces."""
    wrench[:] = 0.0
    gradient[:] = 0.0
    total, contacts = 0.0, SPARE
    for s in range(len(hand.sphere_body)):
        if plane[3] < np.inf:
            _rest_on(hand, plane, poses, s, wrench)
        if wait[s] > 0:
            wait[s] -= 1
            continue
        body, radius = hand.sphere_body[s], hand.sphere_radius[s]
        point = _point(poses, body, hand.sphere_local, s)
        beyond = _coarse(field, point) - radius - field.cull
        if beyond > 0.0:
            touching[s] = False
            wait[s] = int(beyond / APPROACH)
            continue
        _sample(field, field.distance, point, value, slope)
        depth = radius - value[0]
        if depth <= 0.0:
            touching[s] = False
            continue
        contacts += 1
        length = max(math.sqrt(slope[0, 0] ** 2 + slope[0, 1] ** 2 + slope[0, 2] ** 2), 1e-9)
        n = (slope[0, 0] / length, slope[0, 1] / length, slope[0, 2] / length)
        normal = STIFFNESS * depth
        total += normal
        if not touching[s]:
            touching[s] = True
            _hold_on(poses, body, point, n, radius, local, anchor, s)
        here = _point(poses, body, local, s)
        slip = (here[0] - anchor[s, 0], here[1] - anchor[s, 1], here[2] - anchor[s, 2])
        along = slip[0] * n[0] + slip[1] * n[1] + slip[2] * n[2]
        t = (slip[0] - along * n[0], slip[1] - along * n[1], slip[2] - along * n[2])
        size = STIFFNESS * math.sqrt(t[0] ** 2 + t[1] ** 2 + t[2] ** 2)
        share = 1.0
        if size > friction * normal:
            share = friction * normal / size
            for i in range(3):
                anchor[s, i] = here[i] - share * t[i]
        k = share * STIFFNESS
        _push(
            wrench,
            body,
            here,
            (k * t[0] - normal * n[0], k * t[1] - normal * n[1], k * t[2] - normal * n[2]),
        )
    _self_penetration(hand, 0.0, STIFFNESS, poses, wrench)
    _push(wrench, 0, (0.0, 0.0, 0.0), weight)
    _pull_back(hand, poses, wrench, gradient)
    for j in range(len(q)):
        torque = drives.stiffness[j] * (q[j] - command[j])
        torque = min(max(torque, -drives.effort[j]), drives.effort[j])
        change = -(gradient[6 + j] + torque) * drives.damping[j]
        speed[6 + j] = MOMENTUM * speed[6 + j] + change
        q[j] = min(max(q[j] + min(max(speed[6 + j], -0.05), 0.05), hand.lower[j]), hand.upper[j])
    _move(wrist, center, contacts * STIFFNESS, gradient, speed)
    return total


@native
def _rest_on(hand, plane, poses, s, wrench):
    """The table pushes a sphere out."""
    body = hand.sphere_body[s]
    point = _point(poses, body, hand.sphere_local, s)
    height = plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]
    depth = hand.sphere_radius[s] - height
    if depth > 0.0:
        push = -STIFFNESS * depth
        _push(wrench, body, point, (push * plane[0], push * plane[1], push * plane[2]))


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
    lever = _cross(arm, gradient)
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
    if angle > 1e-12:
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
