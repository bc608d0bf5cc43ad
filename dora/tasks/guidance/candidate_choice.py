"""Which candidates an episode works with: reachable, well ranked, near; imperfect as the preset says."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.geometry.poses import carried
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_angle,
)
from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.randomisation import Randomisation

NEAREST = 3
"""Candidates that an environment observes; the first one leads the reference."""
ROTATION_WEIGHT = 0.1
"""Metres that one radian counts when candidates are compared [m/rad]."""
SCORE_MARGIN = 0.1
"""Candidates whose score is at most this much below the best reachable one's count as well ranked."""
UNRANKED, UNREACHABLE = 1e3, 1e6
"""Distances added to candidates that are ranked lower or cannot be reached [m]; larger than any real one."""


class CandidateChoice:
    """The candidates in use, one row per environment; poses in the object frame, the error included.

    All k candidates of an environment have the same error: a shift in the object frame, a turn about the wrist, joints.

    Attributes:
        error_scale: share of the randomisation's candidate error in force, for curricula.
        error_draws: random numbers of an environment's error: 3 position, 3 rotation, one per hand joint.
        buffers: `position` (n, k, 3) [m], `quaternion` (n, k, 4), of the k nearest; of the first one `approach`
            (n, 3), `pregrasp` and `grasp` (n, hand) [rad], and its index `chosen` (n,); `reachable` (n,), 0 where no
            candidate can be reached.
    """

    def __init__(self, candidates: GraspCandidates, num_envs: int, device: torch.device):
        self.candidates = candidates.to(device)
        self._score = torch.nan_to_num(self.candidates.score, nan=0.0)
        self.error_scale = 1.0
        hand = self.candidates.grasp.shape[1]
        self.error_draws = 6 + hand
        self.buffers = Buffers(
            num_envs, device, position=(NEAREST, 3), quaternion=(NEAREST, 4), approach=(3,), pregrasp=(hand,),
            grasp=(hand,), reachable=(), chosen=(),
        )  # fmt: skip
        self.buffers.quaternion[..., 0] = 1.0

    def nearest(
        self,
        object_p: Float[Tensor, "b 3"],
        object_q: Float[Tensor, "b 4"],
        wrist_p: Float[Tensor, "b 3"],
        wrist_q: Float[Tensor, "b 4"],
        reachable: Bool[Tensor, "b c"],
    ) -> Int[Tensor, "b k"]:
        """Indices of the k best candidates: reachable before unreachable, well ranked before lower ones, then by
        distance from the wrist. With fewer than k reachable ones, the first is repeated."""
        b, count = len(object_p), len(self.candidates)
        goal_p, goal_q = carried(self.candidates.position, self.candidates.quaternion, object_p, object_q)
        away = (goal_p - wrist_p[:, None]).norm(dim=-1)
        turn = rotation_angle(goal_q, wrist_q[:, None].expand(b, count, 4))
        score = torch.where(reachable, self._score, -1.0)
        well_ranked = score >= score.amax(-1, keepdim=True) - SCORE_MARGIN
        cost = away + ROTATION_WEIGHT * turn + UNRANKED * ~well_ranked + UNREACHABLE * ~reachable
        best = cost.topk(min(NEAREST, count), largest=False)
        index = torch.where(best.values < UNREACHABLE, best.indices, best.indices[:, :1])
        return torch.cat([index, index[:, :1].expand(b, NEAREST - index.shape[1])], -1)

    def choose(
        self, rows: Int[Tensor, " b"], index: Int[Tensor, "b k"], reachable: Bool[Tensor, " b"],
        error: Float[Tensor, "b e"], randomisation: Randomisation,
    ) -> None:  # fmt: skip
        """Gives the environments `rows` the candidates `index`, with an error as `randomisation` says.

        `error`: `error_draws` independent uniform numbers in [-1, 1]: 3 for position, 3 for rotation, then joints;
        `reachable` says whether any candidate can be reached.
        """
        c, first, error = self.candidates, index[:, 0], self.error_scale * error
        tilt = quaternion_from_rotation_vector(randomisation.candidate_rotation * error[:, 3:6])
        bend = randomisation.candidate_joint * error[:, 6:]
        self.buffers.write(
            rows,
            position=c.position[index] + randomisation.candidate_position * error[:, None, :3],
            quaternion=quaternion_multiply(c.quaternion[index], tilt[:, None].expand(-1, NEAREST, 4)),
            approach=c.approach[first],
            pregrasp=c.pregrasp[first] + bend,
            grasp=c.grasp[first] + bend,
            reachable=reachable.float(),
            chosen=first.float(),
        )

    def goals(
        self, object_p: Float[Tensor, "n 3"], object_q: Float[Tensor, "n 4"]
    ) -> tuple[Float[Tensor, "n k 3"], Float[Tensor, "n k 4"], Float[Tensor, "n 3"]]:
        """World wrist positions and orientations that the candidates ask for at the objects' poses, and the
        direction of the first one's approach."""
        b = self.buffers
        goals = carried(b.position, b.quaternion, object_p, object_q)
        return *goals, quaternion_apply(object_q, b.approach)
