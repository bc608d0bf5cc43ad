"""The grasp energy in compiled loops: the values and gradients that `dora.affordance.search.energies` defines."""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.objects.signed_distance import CHANNELS
from dora.affordance.search.energies import CLEARANCE, LENGTH, PALM_IMPORTANCE, PRESS, TERMS
from dora.affordance.search.native.compiling import native
from dora.affordance.search.native.field import distance_to, nearest_node_distance, sample
from dora.affordance.search.native.hand import (
    SMALLEST_LENGTH,
    add_force,
    cross,
    forward,
    point_of,
    pull_back,
    rotate,
    self_penetration,
)

CLOSURE, DISTANCE, REGION, CLOSING, PENETRATION, TABLE, LIMITS, SELF = range(len(TERMS))
"""Indices into `TERMS`."""


class _Workspace(NamedTuple):
    """Arrays for intermediate results of the hand, a sample of the field and the contact points, allocated once."""

    angles: np.ndarray
    poses: np.ndarray
    wrench: np.ndarray
    ends: np.ndarray
    value: np.ndarray
    slope: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    lengths: np.ndarray
    jacobian: np.ndarray


class Adam(NamedTuple):
    """Settings of Adam as in `dora.affordance.search.descent`.

    `largest` (6 + a,) largest steps [m], [rad]; `size` (n,) share of them per step; `before` steps taken earlier;
    decay rates of the moments; `epsilon` added to the root of the second moment.
    """

    largest: np.ndarray
    size: np.ndarray
    before: int
    mean_decay: float
    square_decay: float
    epsilon: float


@native
def evaluate(hand, field, weights, plane, wrist, joints, contacts):
    """Values of all terms (c, terms) and the gradient of their weighted sum (c, 6 + a)."""
    count, actuated = joints.shape
    terms, gradient = np.zeros((count, len(weights))), np.zeros((count, 6 + actuated))
    workspace = make_workspace(hand, field, contacts.shape[1])
    for row in range(count):
        _evaluate(
            hand,
            field,
            weights,
            plane,
            wrist[row],
            joints[row],
            contacts[row],
            workspace,
            True,
            terms[row],
            gradient[row],
        )
    return terms, gradient


@native
def descend(hand, field, factors, plane, adam, wrist, joints, contacts, mean, square):
    """Takes n steps of Adam with weights `factors` (n, terms); poses, joints and moments change in place.

    Returns:
        (c, terms) values of the terms before the last step.
    """
    count, actuated = joints.shape
    terms, gradient = np.zeros((count, factors.shape[1])), np.zeros(6 + actuated)
    pose, angles, m, v = np.zeros((3, 4)), np.zeros(actuated), np.zeros(6 + actuated), np.zeros(6 + actuated)
    workspace = make_workspace(hand, field, contacts.shape[1])
    for row in range(count):
        pose[:], angles[:], m[:], v[:] = wrist[row, :3], joints[row], mean[row], square[row]
        for step in range(len(factors)):
            terms[row] = 0.0
            gradient[:] = 0.0
            _evaluate(
                hand, field, factors[step], plane, pose, angles, contacts[row], workspace, False, terms[row], gradient
            )
            adam_step(adam, step, pose, angles, gradient, m, v)
        wrist[row, :3], joints[row], mean[row], square[row] = pose, angles, m, v
    return terms


@native
def adam_step(adam, step, pose, joints, gradient, mean, square):
    """One step of Adam (D. Kingma and J. Ba, 2015) for one candidate; `gradient` is overwritten by the step."""
    taken = adam.before + step + 1
    scale = adam.size[step] / (1 - adam.mean_decay**taken)
    unbias = 1 / (1 - adam.square_decay**taken)
    for i in range(len(gradient)):
        mean[i] += (1 - adam.mean_decay) * (gradient[i] - mean[i])
        square[i] += (1 - adam.square_decay) * (gradient[i] ** 2 - square[i])
        gradient[i] = -scale * adam.largest[i] * mean[i] / (math.sqrt(square[i] * unbias) + adam.epsilon)
    rotate(pose, (0.0, 0.0, 0.0), (gradient[3], gradient[4], gradient[5]))
    for i in range(3):
        pose[i, 3] += gradient[i]
    for j in range(len(joints)):
        joints[j] += gradient[6 + j]


@native
def make_workspace(hand, field, contacts):
    """The workspace for one candidate."""
    bodies, channels = len(hand.axes) + 1, field.table.shape[1]
    return _Workspace(
        np.zeros(bodies - 1),
        np.zeros((bodies, 3, 4)),
        np.zeros((bodies, 6)),
        np.zeros((len(hand.ends), 3)),
        np.zeros(channels),
        np.zeros((channels, 3)),
        np.zeros((contacts, 3)),
        np.zeros((contacts, 3)),
        np.zeros(contacts),
        np.zeros((contacts, 3, 3)),
    )


@native
def _evaluate(hand, field, weights, plane, wrist, joints, contacts, workspace, every, terms, gradient):
    """Adds terms and gradient of one candidate; unless `every` is set, terms of weight 0 are skipped."""
    poses, wrench = workspace.poses, workspace.wrench
    if every or weights[CLOSING] > 0.0:
        forward(hand, wrist, joints, 1.0, workspace.angles, poses)
        wrench[:] = 0.0
        terms[CLOSING] = closing(hand, field, weights[CLOSING], poses, contacts, wrench)
        pull_back(hand, poses, wrench, gradient)
    forward(hand, wrist, joints, 0.0, workspace.angles, poses)
    wrench[:] = 0.0
    contact_terms(hand, field, weights, contacts, workspace, terms)
    if every or weights[CLOSURE] > 0.0:
        terms[CLOSURE] = closure(weights[CLOSURE], hand.contact_body, contacts, workspace)
    sphere_terms(hand, field, weights, plane, poses, terms, wrench)
    terms[SELF] = self_penetration(hand, weights[SELF], 0.0, poses, workspace.ends, wrench)
    terms[LIMITS] = limits(hand, weights[LIMITS], workspace.angles, gradient)
    pull_back(hand, poses, wrench, gradient)


@native
def contact_terms(hand, field, weights, contacts, workspace, terms):
    """Terms `distance` and `region`; stores points, normals and their derivatives for `closure`."""
    body_of, local, poses, wrench = hand.contact_body, hand.contact_local, workspace.poses, workspace.wrench
    value, slope, points, normals, lengths = (
        workspace.value,
        workspace.slope,
        workspace.points,
        workspace.normals,
        workspace.lengths,
    )
    last = len(value) - 1
    for k in range(len(contacts)):
        body = body_of[contacts[k]]
        point = point_of(poses, body, local, contacts[k])
        sample(field, field.table, point, value, slope)
        importance = PALM_IMPORTANCE if body == 0 else 1.0
        terms[DISTANCE] += importance * abs(value[0])
        pull = weights[DISTANCE] * importance * np.sign(value[0])
        along = 0.0
        if last >= CHANNELS:
            terms[REGION] += value[CHANNELS]
            along = weights[REGION]
        force = (
            pull * slope[0, 0] + along * slope[last, 0],
            pull * slope[0, 1] + along * slope[last, 1],
            pull * slope[0, 2] + along * slope[last, 2],
        )
        add_force(wrench, body, point, force)
        length = max(math.sqrt(value[1] ** 2 + value[2] ** 2 + value[3] ** 2), SMALLEST_LENGTH)
        lengths[k] = length
        for i in range(3):
            points[k, i], normals[k, i] = point[i], -value[1 + i] / length
            for j in range(3):
                workspace.jacobian[k, i, j] = slope[1 + i, j]


@native
def closure(weight, body_of, contacts, workspace):
    """Term `closure`: squared norm of the net wrench of unit forces along the inward normals.

    Its derivative with respect to a contact point has two parts: of the moment arm, and of the normal's direction.
    """
    points, normals, jacobian = workspace.points, workspace.normals, workspace.jacobian
    fx = fy = fz = tx = ty = tz = 0.0
    for k in range(len(contacts)):
        moment = cross(points[k], normals[k])
        fx, fy, fz = fx + normals[k, 0], fy + normals[k, 1], fz + normals[k, 2]
        tx, ty, tz = tx + moment[0] / LENGTH, ty + moment[1] / LENGTH, tz + moment[2] / LENGTH
    torque = (tx, ty, tz)
    for k in range(len(contacts)):
        point = (points[k, 0], points[k, 1], points[k, 2])
        unit = (normals[k, 0], normals[k, 1], normals[k, 2])
        lever, turned = cross(torque, point), cross(unit, torque)
        x, y, z = fx + lever[0] / LENGTH, fy + lever[1] / LENGTH, fz + lever[2] / LENGTH
        along = unit[0] * x + unit[1] * y + unit[2] * z
        share = 1 / workspace.lengths[k]
        x, y, z = share * (x - unit[0] * along), share * (y - unit[1] * along), share * (z - unit[2] * along)
        by_point = (
            2 * weight * (turned[0] / LENGTH - x * jacobian[k, 0, 0] - y * jacobian[k, 1, 0] - z * jacobian[k, 2, 0]),
            2 * weight * (turned[1] / LENGTH - x * jacobian[k, 0, 1] - y * jacobian[k, 1, 1] - z * jacobian[k, 2, 1]),
            2 * weight * (turned[2] / LENGTH - x * jacobian[k, 0, 2] - y * jacobian[k, 1, 2] - z * jacobian[k, 2, 2]),
        )
        add_force(workspace.wrench, body_of[contacts[k]], point, by_point)
    return fx * fx + fy * fy + fz * fz + tx * tx + ty * ty + tz * tz


@native
def closing(hand, field, weight, poses, contacts, wrench):
    """Term `closing`: sum over the finger points of the closed hand of (distance + `PRESS`)+ [m]."""
    body_of, local = hand.contact_body, hand.contact_local
    total = 0.0
    for k in range(len(contacts)):
        body = body_of[contacts[k]]
        if body == 0:
            continue
        point = point_of(poses, body, local, contacts[k])
        value, slope = distance_to(field, point)
        miss = value + PRESS
        if miss > 0.0:
            total += miss
            add_force(wrench, body, point, (weight * slope[0], weight * slope[1], weight * slope[2]))
    return total


@native
def sphere_terms(hand, field, weights, plane, poses, terms, wrench):
    """Terms `penetration` and `table`: overlaps of the hand's spheres with the object and the table [m]."""
    body_of, local, radius, reach = hand.sphere_body, hand.sphere_local, hand.sphere_radius, hand.sphere_reach
    inside, below, cull = 0.0, 0.0, field.cull
    nx, ny, nz, offset = plane[0], plane[1], plane[2], plane[3] - CLEARANCE
    for s in range(len(body_of)):
        body = body_of[s]
        point = point_of(poses, body, local, s)
        if nearest_node_distance(field, point) < reach[s] + cull:
            value, slope = distance_to(field, point)
            depth = reach[s] - value
            if depth > 0.0:
                inside += depth
                w = -weights[PENETRATION]
                add_force(wrench, body, point, (w * slope[0], w * slope[1], w * slope[2]))
        depth = radius[s] - (nx * point[0] + ny * point[1] + nz * point[2] + offset)
        if depth > 0.0:
            below += depth
            w = -weights[TABLE]
            add_force(wrench, body, point, (w * nx, w * ny, w * nz))
    terms[PENETRATION] = inside
    terms[TABLE] = below


@native
def limits(hand, weight, angles, gradient):
    """Term `limits`: sum of the angles beyond the joint limits [rad]."""
    total = 0.0
    for joint in range(len(angles)):
        above, below = angles[joint] - hand.upper[joint], hand.lower[joint] - angles[joint]
        if above > 0.0 or below > 0.0:
            total += max(above, below)
            gradient[6 + hand.leader[joint]] += weight * (1.0 if above > 0.0 else -1.0) * hand.gain[joint]
    return total
