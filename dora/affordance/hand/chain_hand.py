"""The hand with link poses from pytorch_kinematics, as tensors that automatic differentiation can follow."""

from __future__ import annotations

import numpy as np
import pytorch_kinematics
import torch
from jaxtyping import Float
from pytorch_kinematics.frame import Frame
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.robot import RobotDescription


class ChainHand(HandModel):
    """`HandModel` with forward kinematics of pytorch_kinematics; the geometry is the same.

    The chain is that part of the robot's URDF which the wrist carries, so poses are those in the wrist frame.
    pytorch_kinematics reads <mimic> and ignores it; coupled joints get their angles by the robot's couplings. It keeps
    a URDF's numbers in float32; they are replaced by the exact ones.

    Args:
        robot: any robot with fingers.
        dtype: floating type of every tensor.
        device: torch device of every tensor.

    Attributes:
        chain: the chain of pytorch_kinematics below the wrist.

    Raises:
        InputError: as for `HandModel`.
    """

    def __init__(
        self, robot: RobotDescription, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
    ) -> None:
        wrist = pytorch_kinematics.build_chain_from_urdf(robot.urdf.read_bytes()).find_frame(robot.wrist_link)
        assert wrist is not None
        root = Frame(robot.wrist_link)
        root.children = wrist.children
        self.chain = pytorch_kinematics.Chain(root).to(dtype=dtype, device=torch.device(device))
        _use_exact_numbers(self.chain, robot)
        names = self.chain.get_joint_parameter_names()
        self._columns = [robot.hand.names.index(name) for name in names]
        super().__init__(robot, dtype, device)
        above = [self.chain.parents_indices[self.chain.frame_to_idx[link]].tolist() for link in self.links]
        self._frames = torch.tensor(sorted({frame for path in above for frame in path}))
        """Frames to be computed, each after the one that carries it, so that no product is made twice."""

    def forward(self, wrist: Float[Tensor, "c 4 4"], actuated: Float[Tensor, "c a"]) -> Float[Tensor, "c b 4 4"]:
        """As `HandModel.forward`."""
        angles = self.robot.expand_hand(actuated)[:, self._columns]
        found = self.chain.forward_kinematics(angles, getattr(self, "_frames", None))
        local = torch.stack([found[link].get_matrix().expand(len(angles), 4, 4) for link in self.links], 1)
        return wrist.unsqueeze(1) @ local


def _use_exact_numbers(chain: pytorch_kinematics.Chain, robot: RobotDescription) -> None:
    """Give a chain the joints' origins [m] and unit axes of a robot's description; links have no offset."""
    carried_by = {joint.child: joint for joint in robot.model.joints.values()}
    chain.link_offsets = [None] * len(chain.link_offsets)
    for index, link in list(chain.idx_to_frame.items())[1:]:
        joint = carried_by[link]
        chain.joint_offsets[index] = chain.identity.new_tensor(joint.origin[None])
        if joint.moves:
            chain.axes[int(chain.joint_indices[index])] = chain.axes.new_tensor(joint.axis / np.linalg.norm(joint.axis))
