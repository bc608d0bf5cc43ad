"""The grasp energy: the same values and gradients as `dora.affordance.energies.GraspEnergy`, which defines them."""

import math

import numpy as np

from dora.affordance.energies import CLEARANCE, LENGTH, PALM_IMPORTANCE, PRESS, TERMS
from dora.affordance.native.compiling import native
from dora.affordance.native.field import coarse, sample
from dora.affordance.native.hand import SMALL, cross, forward, point_of, pull_back, push, self_penetration
from dora.affordance.signed_distance import CHANNELS

_CLOSURE, _DISTANCE, _REGION, _CLOSING, _PENETRATION, _TABLE, _LIMITS, _SELF = range(len(TERMS))


@native
def evaluate(hand, field, weights, plane, wrist, joints, contacts):
    """Values of all terms (c, terms) and the gradient of their weighted sum (c, 6 + a)."""
    count, actuated = joints.shape
    bodies, channels = len(hand.axes) + 1, field.table.shape[1]
    terms, gradient = np.zeros((count, len(weights))), np.zeros((count, 6 + actuated))
    poses, closed = np.zeros((bodies, 3, 4)), np.zeros((bodies, 3, 4))
    wrench, wrench_closed = np.zeros((bodies, 6)), np.zeros((bodies, 6))
    angles, angles_closed = np.zeros(bodies - 1), np.zeros(bodies - 1)
    value, slope = np.zeros(channels), np.zeros((channels, 3))
    for row in range(count):
        forward(hand, wrist[row], joints[row], 0.0, angles, poses)
        forward(hand, wrist[row], joints[row], 1.0, angles_closed, closed)
        wrench[:] = 0.0
        wrench_closed[:] = 0.0
        _contact_terms(hand, field, weights, poses, contacts[row], value, slope, terms[row], wrench)
        terms[row, _CLOSING] = _closing(
            hand, field, weights[_CLOSING], closed, contacts[row], value, slope, wrench_closed
        )
        _sphere_terms(hand, field, weights, plane, poses, value, slope, terms[row], wrench)
        terms[row, _SELF] = self_penetration(hand, weights[_SELF], 0.0, poses, wrench)
        terms[row, _LIMITS] = _limits(hand, weights[_LIMITS], angles, gradient[row])
        pull_back(hand, poses, wrench, gradient[row])
        pull_back(hand, closed, wrench_closed, gradient[row])
    return terms, gradient


@native
def _contact_terms(hand, field, weights, poses, contacts, value, slope, terms, wrench):
    """closure, distance and region."""
    count = len(contacts)
    points, normals, lengths = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    jacobian = np.empty((count, 3, 3))
    force, torque = np.zeros(3), np.zeros(3)
    for k in range(count):
        body = hand.contact_body[contacts[k]]
        point = point_of(poses, body, hand.contact_local, contacts[k])
        sample(field, field.table, point, value, slope)
        importance = PALM_IMPORTANCE if body == 0 else 1.0
        terms[_DISTANCE] += importance * abs(value[0])
        pull = weights[_DISTANCE] * importance * np.sign(value[0])
        along = 0.0
        if len(value) > CHANNELS:
            terms[_REGION] += value[CHANNELS]
            along = weights[_REGION]
        last = len(value) - 1
        push(
            wrench,
            body,
            point,
            (
                pull * slope[0, 0] + along * slope[last, 0],
                pull * slope[0, 1] + along * slope[last, 1],
                pull * slope[0, 2] + along * slope[last, 2],
            ),
        )
        lengths[k] = max(math.sqrt(value[1] ** 2 + value[2] ** 2 + value[3] ** 2), SMALL)
        for i in range(3):
            points[k, i], normals[k, i] = point[i], -value[1 + i] / lengths[k]
            for j in range(3):
                jacobian[k, i, j] = slope[1 + i, j]
        moment = cross(points[k], normals[k])
        for i in range(3):
            force[i] += normals[k, i]
            torque[i] += moment[i] / LENGTH
    for i in range(3):
        terms[_CLOSURE] += force[i] ** 2 + torque[i] ** 2
    by_point = np.empty(3)
    for k in range(count):
        lever, unit = cross(torque, points[k]), normals[k]
        by_normal = (
            2 * (force[0] + lever[0] / LENGTH),
            2 * (force[1] + lever[1] / LENGTH),
            2 * (force[2] + lever[2] / LENGTH),
        )
        along = unit[0] * by_normal[0] + unit[1] * by_normal[1] + unit[2] * by_normal[2]
        turned = cross(unit, torque)
        for i in range(3):
            by_point[i] = 2 / LENGTH * turned[i]
            for j in range(3):
                by_point[i] -= (by_normal[j] - unit[j] * along) / lengths[k] * jacobian[k, j, i]
            by_point[i] *= weights[_CLOSURE]
        push(wrench, hand.contact_body[contacts[k]], points[k], by_point)


@native
def _closing(hand, field, weight, poses, contacts, value, slope, wrench):
    """closing: how far points of the fingers of a closed hand still are from being pressed in."""
    total = 0.0
    for k in range(len(contacts)):
        body = hand.contact_body[contacts[k]]
        if body == 0:
            continue
        point = point_of(poses, body, hand.contact_local, contacts[k])
        sample(field, field.distance, point, value, slope)
        miss = value[0] + PRESS
        if miss > 0.0:
            total += miss
            push(wrench, body, point, (weight * slope[0, 0], weight * slope[0, 1], weight * slope[0, 2]))
    return total


@native
def _sphere_terms(hand, field, weights, plane, poses, value, slope, terms, wrench):
    """penetration and table."""
    for s in range(len(hand.sphere_body)):
        body = hand.sphere_body[s]
        point = point_of(poses, body, hand.sphere_local, s)
        if coarse(field, point) < hand.sphere_reach[s] + field.cull:
            sample(field, field.distance, point, value, slope)
            depth = hand.sphere_reach[s] - value[0]
            if depth > 0.0:
                terms[_PENETRATION] += depth
                w = -weights[_PENETRATION]
                push(wrench, body, point, (w * slope[0, 0], w * slope[0, 1], w * slope[0, 2]))
        height = plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]
        depth = hand.sphere_radius[s] + CLEARANCE - height
        if depth > 0.0:
            terms[_TABLE] += depth
            w = -weights[_TABLE]
            push(wrench, body, point, (w * plane[0], w * plane[1], w * plane[2]))


@native
def _limits(hand, weight, angles, gradient):
    """limits: angles beyond their limits (rad)."""
    total = 0.0
    for joint in range(len(angles)):
        above, below = angles[joint] - hand.upper[joint], hand.lower[joint] - angles[joint]
        if above > 0.0 or below > 0.0:
            total += max(above, below)
            gradient[6 + hand.leader[joint]] += weight * (1.0 if above > 0.0 else -1.0) * hand.gain[joint]
    return total
