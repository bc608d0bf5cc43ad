"""Whether a squeezing hand would hold: quasi-static equilibrium of drives, contacts with friction, and weight.

A model, not a simulation of motion: the drives are springs with limited torque, hand and object push each other
apart with stiff springs at the spheres of the hand, friction is a spring along the surface that slides at Coulomb's
limit. The hand closes from its open posture to its squeezing command, then the weight acts along every direction of the
protocol; what moves is found by descent with momentum, without masses. The search ranks its candidates by the result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.hand.protocol import DIRECTIONS, STANDARD, Protocol
from dora.affordance.search.compiled import CompiledEnergy
from dora.affordance.search.native.closing import ARM, Drives, Model, Ranking, Steps, close_and_load
from dora.affordance.search.native.contact import STIFFNESS

SAFETY = 2.0
"""Weight in the model over that of the object: few steps of descent then tell what slips."""
FINGER_CONTACTS = 4.0
"""Contacts on whose stiffness the step sizes of the joints count."""
MUCH = 0.01
"""Displacement [m] that outweighs an e-fold of force."""
SHIFT_SHARE = 0.3
"""What a shift by closing counts against a displacement under weight."""


class Holding(NamedTuple):
    """Result of `hold` for c candidates.

    Attributes:
        shift: (c,) how far closing moves the object [m].
        displacement: (c, 6) farthest the object is from where closing left it, up to every direction [m].
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
        """What ranks candidates: a firm grip that moves little, log(1 + force) less what moves in `MUCH`."""
        return self.force.log1p() - (self.displacement[:, -1] + SHIFT_SHARE * self.shift) / MUCH


STEPS = Steps()
"""Steps that judge a candidate."""


def hold(
    energy: CompiledEnergy,
    wrist: Float[Tensor, "c 4 4"],
    opened: Float[Tensor, "c j"],
    squeezed: Float[Tensor, "c j"],
    mass: float,
    protocol: Protocol = STANDARD,
    steps: Steps = STEPS,
    on_table: bool = False,
    wanted: int | None = None,
) -> Holding:
    """Close and load every candidate.

    Args:
        energy: knows hand and object.
        wrist: pose of the wrist in the object frame.
        opened: all hand joints before closing [rad], in the order of `RobotDescription.hand`.
        squeezed: command of all hand joints.
        mass: of the object [kg].
        protocol: has friction, gravity.
        steps: of the model.
        on_table: whether the hand stays above the energy's table.
        wanted: of the best by `Holding.quality` are looked for; the displacement of others may be told too small, yet
            never so small that they would be among the best. None: all.
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
    center = torch.as_tensor(hand.palm_frame.center + ARM * hand.palm_frame.normal).double().numpy()
    plane = energy.plane() if on_table else np.array([0.0, 0.0, 0.0, np.inf])
    model = Model(free, energy.field_arrays, drives, center, float(protocol.friction), plane)
    load = SAFETY * mass * protocol.gravity
    end, final = wrist.double().numpy().copy(), opened[:, order].double().numpy()
    command = squeezed[:, order].double().numpy()
    ranking = Ranking(MUCH, SHIFT_SHARE, max(1, min(len(end), wanted or len(end))))
    result = close_and_load(model, steps, ranking, load, np.array(DIRECTIONS), end, final, command)
    found = torch.from_numpy(result).to(wrist)
    joints = opened.clone()
    joints[:, order] = torch.from_numpy(final).to(opened)
    return Holding(found[:, 0], found[:, 2:], found[:, 1], torch.from_numpy(end).to(wrist), joints)


def _levers(hand: HandModel) -> np.ndarray:
    """Distance [m] from every joint to the farthest sphere beyond it, straight hand."""
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
