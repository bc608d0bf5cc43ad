"""Quasi-static closing: the equilibrium of a squeezing hand's drives, contacts with friction, and the object's weight.

A model without masses, not a simulation of motion. Drives are springs with limited torque; contacts are stiff normal
springs at the spheres of the hand, with tangential springs that slide at Coulomb's limit. The hand closes from its
open posture to its squeezing command, then the weight acts along each direction of the grasp test. Descent with
momentum finds the equilibria. The search orders its candidates by the quality of the result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.hand.grasp_test_settings import DIRECTIONS, STANDARD, GraspTestSettings
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.search.compiled import CompiledEnergy
from dora.affordance.search.native.closing import LEVER, Drives, Model, QualitySettings, Steps, close_and_load
from dora.affordance.search.native.contact import STIFFNESS

WEIGHT_FACTOR = 2.0
"""Ratio of the weight in the model to that of the object [1]; with it few steps of descent show which grasps slip."""
FINGER_CONTACTS = 4.0
"""Number of contacts whose stiffness bounds the step sizes of the joints [1]."""
DISPLACEMENT_SCALE = 0.01
"""Displacement that costs as much quality as a factor e of force gains [m]."""
SHIFT_SHARE = 0.3
"""Weight of the displacement by closing relative to the displacement under load [1]."""


class ClosedHand(NamedTuple):
    """Result of `close_hand` for c candidates.

    Attributes:
        shift: (c,) displacement of the object's origin by closing, relative to the hand [m].
        displacement: (c, 6) largest displacement from there, up to each direction of the weight [m].
        force: (c,) sum of normal forces after closing [N].
        wrist: (c, 4, 4) pose of the wrist in the object frame after closing.
        joints: (c, j) all hand joints after closing [rad], in the order of `RobotDescription.hand`.
    """

    shift: Float[Tensor, " c"]
    displacement: Float[Tensor, "c 6"]
    force: Float[Tensor, " c"]
    wrist: Float[Tensor, "c 4 4"]
    joints: Float[Tensor, "c j"]

    @property
    def quality(self) -> Float[Tensor, " c"]:
        """Quality of the grasp: log(1 + force) - (displacement + `SHIFT_SHARE` shift) / `DISPLACEMENT_SCALE` [1]."""
        return self.force.log1p() - (self.displacement[:, -1] + SHIFT_SHARE * self.shift) / DISPLACEMENT_SCALE


STEPS = Steps()
"""Default numbers of steps."""


def close_hand(
    energy: CompiledEnergy,
    wrist: Float[Tensor, "c 4 4"],
    opened: Float[Tensor, "c j"],
    squeezed: Float[Tensor, "c j"],
    mass: float,
    test_settings: GraspTestSettings = STANDARD,
    steps: Steps = STEPS,
    on_table: bool = False,
    wanted: int | None = None,
) -> ClosedHand:
    """Close the hand of every candidate and apply the object's weight along each direction of the grasp test.

    Args:
        energy: its hand, object and table are used.
        wrist: (c, 4, 4) pose of the wrist in the object frame [m].
        opened: (c, j) all hand joints before closing [rad], in the order of `RobotDescription.hand`.
        squeezed: (c, j) command of all hand joints [rad], in the same order.
        mass: mass of the object [kg].
        test_settings: friction and gravity of the grasp test.
        steps: numbers of steps of descent.
        on_table: whether the energy's table pushes the hand up.
        wanted: how many of the best by `ClosedHand.quality` must be exact. The loading of others ends early: their
            displacement is too small, but never so small that they would be among the best. None: all are exact.

    Returns:
        The closed hands and what was measured of them.
    """
    hand, robot = energy.hand, energy.hand.robot.hand
    arrays = energy.arrays
    joints, order = len(arrays.axes), hand.joint_index
    free = arrays._replace(
        leader=np.arange(joints), gain=np.ones(joints), offset=np.zeros(joints), close=np.zeros(joints)
    )
    index = order.numpy()
    lever = _levers(hand)
    drives = Drives(
        robot.stiffness[index].astype(float),
        robot.effort[index].astype(float),
        1 / (robot.stiffness[index] + FINGER_CONTACTS * STIFFNESS * lever**2),
    )
    center = torch.as_tensor(hand.palm_frame.center + LEVER * hand.palm_frame.normal).double().numpy()
    plane = energy.plane() if on_table else np.array([0.0, 0.0, 0.0, np.inf])
    model = Model(free, energy.field_arrays, drives, center, float(test_settings.friction), plane)
    load = WEIGHT_FACTOR * mass * test_settings.gravity
    end, final = wrist.double().cpu().numpy().copy(), opened[:, order].double().cpu().numpy()
    command = squeezed[:, order].double().cpu().numpy()
    quality = QualitySettings(DISPLACEMENT_SCALE, SHIFT_SHARE, max(1, min(len(end), wanted or len(end))))
    result = close_and_load(model, steps, quality, load, np.array(DIRECTIONS), end, final, command)
    found = torch.from_numpy(result).to(wrist)
    joints = opened.clone()
    real = hand.axes.any(-1).cpu()  # padding stands for no joint
    joints[:, order[real]] = torch.from_numpy(final).to(opened)[:, real]
    return ClosedHand(found[:, 0], found[:, 2:], found[:, 1], torch.from_numpy(end).to(wrist), joints)


def _levers(hand: HandModel) -> np.ndarray:
    """Distance from each joint to the farthest sphere that it moves, in the straight hand [m]."""
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
