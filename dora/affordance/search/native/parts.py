"""The parts of an evaluation of the grasp energy, each run repeatedly, to measure and test them one by one."""

import numpy as np

from dora.affordance.search.native.compiling import native
from dora.affordance.search.native.energy import (
    CLOSING,
    CLOSURE,
    LIMITS,
    SELF,
    adam_step,
    closing,
    closure,
    contact_terms,
    limits,
    make_workspace,
    sphere_terms,
)
from dora.affordance.search.native.hand import forward, pull_back, self_penetration

PARTS = (
    "forward_kinematics",
    "distance_region",
    "closure",
    "closing",
    "penetration_table",
    "self_penetration",
    "limits",
    "gradient",
    "adam",
)
"""Names of the parts. `distance_region` includes the field look-up whose normals `closure` uses; `closing` excludes
the forward kinematics of the closed hand; `gradient` maps forces on bodies to wrist and joints."""
_FORWARD, _CONTACTS, _CLOSURE, _CLOSING, _SPHERES, _SELF, _LIMITS, _GRADIENT, _ADAM = range(len(PARTS))
"""Indices into `PARTS`."""


@native
def repeat(part, times, hand, field, weights, plane, adam, wrist, joints, contacts):
    """Runs one of `PARTS` (given by its index) `times` times for every candidate; arguments as of `descend`.

    Returns:
        Terms (c, terms) and gradient (c, 6 + a) that the part writes, summed over `times` where it adds to them.
        `gradient` starts from the forces of distance and region, `adam` from a gradient of ones.
    """
    count, actuated = joints.shape
    terms, gradient = np.zeros((count, len(weights))), np.zeros((count, 6 + actuated))
    workspace, forces = make_workspace(hand, field, contacts.shape[1]), np.zeros((len(hand.axes) + 1, 6))
    pose, angles, mean, square = np.zeros((3, 4)), np.zeros(actuated), np.zeros(6 + actuated), np.zeros(6 + actuated)
    for row in range(count):
        pose[:], angles[:], mean[:], square[:] = wrist[row, :3], joints[row], 0.0, 0.0
        workspace.wrench[:] = 0.0
        forward(hand, pose, angles, 0.0, workspace.angles, workspace.poses)
        contact_terms(hand, field, weights, contacts[row], workspace, terms[row])
        terms[row], forces[:] = 0.0, workspace.wrench
        for _ in range(times):
            if part == _FORWARD:
                forward(hand, pose, angles, 0.0, workspace.angles, workspace.poses)
            elif part == _CONTACTS:
                contact_terms(hand, field, weights, contacts[row], workspace, terms[row])
            elif part == _CLOSURE:
                terms[row, CLOSURE] = closure(1.0, hand.contact_body, contacts[row], workspace)
            elif part == _CLOSING:
                terms[row, CLOSING] = closing(hand, field, 1.0, workspace.poses, contacts[row], workspace.wrench)
            elif part == _SPHERES:
                sphere_terms(hand, field, weights, plane, workspace.poses, terms[row], workspace.wrench)
            elif part == _SELF:
                terms[row, SELF] = self_penetration(hand, 1.0, 0.0, workspace.poses, workspace.ends, workspace.wrench)
            elif part == _LIMITS:
                terms[row, LIMITS] = limits(hand, 1.0, workspace.angles, gradient[row])
            elif part == _GRADIENT:
                workspace.wrench[:] = forces
                pull_back(hand, workspace.poses, workspace.wrench, gradient[row])
            elif part == _ADAM:
                gradient[row] = 1.0
                adam_step(adam, 0, pose, angles, gradient[row], mean, square)
    return terms, gradient
