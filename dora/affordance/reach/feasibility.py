"""Motion-feasibility filter f_reach: which candidates the arm can reach at an object's pose, and why not the others.

A candidate is feasible if the opened hand hits neither table nor object on the approach, the arm can follow the
approach without collision, and a collision-free transit leads from the start posture to the standoff.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.reach.approach_paths import (
    ARM_COLLISION,
    HAND_OBJECT,
    HAND_TABLE,
    NO_MOTION,
    OK,
    REASONS,
    ApproachPaths,
    Goals,
    ReachSettings,
    attempts,
)
from dora.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_apply,
    quaternion_from_matrix,
    quaternion_inverse,
    quaternion_multiply,
)
from dora.robot import RobotDescription, Shape
from dora.robot.motion.collision import CollisionModel
from dora.robot.motion.height_bounds import ArmHeightBounds, HandHeightBounds
from dora.robot.motion.inverse_kinematics import InverseKinematics
from dora.robot.motion.planning import plan

CLOSING_SHARES = (0.0, 0.5, 1.0)
"""Interpolation between the opened hand (0) and contact (1) at which the hand's height over the table is tested [1]."""
IDENTITY = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
"""Pose of a robot's base at the world's origin: position [m], quaternion wxyz."""


@dataclass(frozen=True, eq=False)
class Reachability:
    """Result of the filter for b object poses and c candidates.

    Attributes:
        reachable: (b, c) whether the candidate is feasible.
        reason: (b, c) index into `REASONS`.
        arm_q: (b, c, dof) arm joints at the candidate [rad]; those of the best attempt if it is not reachable.
        standoff_q: (b, c, dof) arm joints at the beginning of the approach [rad], likewise.
    """

    reachable: Bool[Tensor, "b c"]
    reason: Int[Tensor, "b c"]
    arm_q: Float[Tensor, "b c dof"]
    standoff_q: Float[Tensor, "b c dof"]

    @property
    def empty(self) -> Bool[Tensor, " b"]:
        """(b,) poses at which no candidate is feasible."""
        return ~self.reachable.any(-1)

    def counts(self) -> dict[str, int]:
        """Number of pairs of pose and candidate by reason."""
        number = torch.bincount(self.reason.flatten(), minlength=len(REASONS))
        return {name: int(n) for name, n in zip(REASONS, number, strict=True)}


class Reach:
    """Feasibility of candidates for one robot and one kind of object.

    Args:
        robot: arm and hand.
        obj: the object whose convex pieces are obstacles; None for no object.
        base: pose of the robot's base in the world: position [m], quaternion wxyz.
        settings: numbers of the filter.
        start: name of the robot's posture from which motions start.

    Raises:
        InputError: the robot has no posture `start`.
    """

    def __init__(
        self,
        robot: RobotDescription,
        obj: AffordanceObject | None,
        base: tuple[tuple[float, ...], tuple[float, ...]] = IDENTITY,
        settings: ReachSettings | None = None,
        start: str = "home",
    ):
        self.robot, self.settings = robot, settings or ReachSettings()
        self.digest = "" if obj is None else obj.digest
        self.folder = None if obj is None else obj.folder
        self.base = base
        self.pieces: tuple[Shape | trimesh.Trimesh, ...] = () if obj is None else tuple(p.shape for p in obj.pieces)
        self.kinematics = InverseKinematics(robot, robot.posture(start).arm)
        self.start = self.kinematics.start
        self._base_p, self._base_q = (torch.tensor(part, dtype=torch.float32) for part in base)
        up = torch.tensor([0.0, 0.0, 1.0])
        self._normal = quaternion_apply(quaternion_inverse(self._base_q), up)
        self._level = self.settings.table_height - float(self._base_p[2])
        self._hand, self._arm = HandHeightBounds(robot), ArmHeightBounds(robot, self.kinematics.chain)
        self._models: dict[str, CollisionModel] = {}

    def filter(
        self,
        candidates: GraspCandidates,
        object_p: Float[Tensor, "b 3"],
        object_q: Float[Tensor, "b 4"],
        exact: bool = True,
    ) -> Reachability:
        """Tests every candidate at every pose of the object.

        Args:
            candidates: c candidates.
            object_p: (b, 3) positions of the object in the world [m].
            object_q: (b, 4) orientations of the object in the world, wxyz.
            exact: whether to test what needs Pinocchio and Coal: the hand against the object, the arm against itself
                and the object, and the transit. Without it arm and hand are tested against the table alone.

        Raises:
            InputError: `exact`, and Pinocchio, Coal or (motion "plan") OMPL is not installed.
        """
        b, c, s = len(object_p), len(candidates), self.settings
        poses = self._in_base(object_p, object_q)
        goals = self._goals(candidates, *poses)
        reason = torch.full((b * c,), OK)
        if exact:
            reason[self.hits_object(candidates).repeat(b)] = HAND_OBJECT
        reason[self._hand_height(candidates, goals) < s.table_clearance] = HAND_TABLE
        arm_q = self.start.repeat(b * c, 1)
        standoff_q = arm_q.clone()
        rows = (reason == OK).nonzero()[:, 0]
        left = torch.arange(len(rows))
        for attempt in attempts(self.kinematics, goals[rows], self.start, s, self._normal):
            if len(left) == 0:
                break
            paths, now = attempt(left), rows[left]
            low = self._arm.height(paths.descent, self._normal, self._level).amin(-1) < s.table_clearance
            failure = torch.where((paths.failure == OK) & low, ARM_COLLISION, paths.failure)
            if exact:
                failure = self._collisions(candidates, poses, now, paths, failure)
            better = (failure == OK) | (failure > reason[now])
            arm_q[now[better]], standoff_q[now[better]] = paths.descent[better, -1], paths.descent[better, 0]
            reason[now] = torch.where(failure == OK, OK, torch.maximum(reason[now], failure))
            left = left[failure != OK]
        dof = arm_q.shape[-1]
        return Reachability(
            (reason == OK).reshape(b, c), reason.reshape(b, c), arm_q.reshape(b, c, dof), standoff_q.reshape(b, c, dof)
        )

    def plan(
        self,
        start: Float[np.ndarray, " dof"],
        goal: Float[np.ndarray, " dof"],
        hand: Float[np.ndarray, " h"],
        object_p: Float[Tensor, " 3"],
        object_q: Float[Tensor, " 4"],
        seed: int = 0,
    ) -> Float[np.ndarray, "k dof"] | None:
        """Collision-free way points (k, dof) between two arm postures [rad], or None if none are found.

        Args:
            start: (dof,) arm joints at the beginning [rad].
            goal: (dof,) arm joints at the end [rad].
            hand: (h,) hand joints during the motion [rad].
            object_p: (3,) position of the object in the world [m].
            object_q: (4,) orientation of the object in the world, wxyz.
            seed: seed of the planner, see `dora.robot.motion.planning.plan`.

        Raises:
            InputError: Pinocchio, Coal or OMPL is not installed, or a posture is outside the joint limits.
        """
        position, quaternion = self._in_base(object_p[None], object_q[None])
        model = self._model("plan")
        model.place_object(position[0].double().numpy(), quaternion[0].double().numpy())
        return plan(model, start, goal, hand, replace(self.settings.plan, seed=seed))

    def hits_object(self, candidates: GraspCandidates) -> Bool[Tensor, " c"]:
        """Mask (c,) of candidates whose opened hand overlaps the object on the approach, for any pose of the object.

        Raises:
            InputError: Pinocchio or Coal is not installed.
        """
        hit = torch.zeros(len(candidates), dtype=torch.bool)
        if not self.pieces:
            return hit
        model, s = self._model("hand"), self.settings
        wrist_p, wrist_q = self.wrist_pose(self.start)
        # The arm stays where it is; the object is moved relative to it.
        turn = quaternion_multiply(wrist_q.expand(len(candidates), 4), quaternion_inverse(candidates.quaternion))
        steps = torch.arange(0.0, s.standoff + 1e-6, s.spacing / 2)
        offsets = candidates.position[:, None] - candidates.approach[:, None] * steps[:, None]
        places = wrist_p - quaternion_apply(turn[:, None].expand(-1, len(steps), 4), offsets)
        arm, hands = self.start.double().numpy()[None], candidates.pregrasp.double().numpy()
        for i, (quaternion, positions) in enumerate(zip(turn.double().numpy(), places.double().numpy(), strict=True)):
            for position in positions:
                model.place_object(position, quaternion)
                if not model.free(arm, hands[i]):
                    hit[i] = True
                    break
        return hit

    def wrist_pose(self, q: Float[Tensor, " dof"]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 4"]]:
        """Position [m] and orientation (wxyz) of the wrist in the base frame at arm joints (dof,) [rad]."""
        position, rotation = self.kinematics.chain.tip_pose(q[None])
        return position[0], quaternion_from_matrix(rotation)[0]

    def _in_base(self, position: Tensor, quaternion: Tensor) -> tuple[Tensor, Tensor]:
        """Poses given in the world, in the base frame."""
        back = quaternion_inverse(self._base_q).expand(len(position), 4)
        return quaternion_apply(back, position - self._base_p), quaternion_multiply(back, quaternion)

    def _goals(self, candidates: GraspCandidates, object_p: Tensor, object_q: Tensor) -> Goals:
        """Wrist poses of all candidates at all poses in the base frame; rows of one pose are consecutive."""
        b, c = len(object_p), len(candidates)
        each = object_q.repeat_interleave(c, 0)
        return Goals(
            object_p.repeat_interleave(c, 0) + quaternion_apply(each, candidates.position.repeat(b, 1)),
            quaternion_multiply(each, candidates.quaternion.repeat(b, 1)),
            quaternion_apply(each, candidates.approach.repeat(b, 1)),
        )

    def _hand_height(self, candidates: GraspCandidates, goals: Goals) -> Tensor:
        """Smallest height of the hand above the table on the approach and while it closes (b c,) [m]."""
        heights = []
        normal = (matrix_from_quaternion(goals.quaternion).transpose(1, 2) @ self._normal)[:, None]
        for share in CLOSING_SHARES:
            joints = torch.lerp(candidates.pregrasp, candidates.joints, share)
            spheres = self._hand.spheres(joints).repeat(len(goals.position) // len(candidates), 1, 1)
            heights.append(((spheres * normal).sum(-1) - self._hand.radii).amin(-1))
        at_standoff = heights[0] - self.settings.standoff * (goals.approach @ self._normal)
        lowest = torch.stack([*heights, at_standoff]).amin(0)
        return lowest + goals.position @ self._normal - self._level

    def _collisions(
        self,
        candidates: GraspCandidates,
        poses: tuple[Tensor, Tensor],
        rows: Tensor,
        paths: ApproachPaths,
        failure: Tensor,
    ) -> Tensor:
        """`failure`, updated by the collisions on approach and transit."""
        failure, c = failure.clone(), len(candidates)
        position, quaternion = (x.double().numpy() for x in poses)
        hands = candidates.pregrasp.double().numpy()
        approach = self._model("approach")
        transit = self._model("transit" if self.settings.motion == "controller" else "plan")
        for i in (failure == OK).nonzero()[:, 0].tolist():
            pose, hand = divmod(int(rows[i]), c)
            approach.place_object(position[pose], quaternion[pose])
            transit.place_object(position[pose], quaternion[pose])
            descent = paths.descent[i].double().numpy()
            if not approach.free(descent, hands[hand]):
                failure[i] = ARM_COLLISION
            elif not self._arrives(transit, paths.transit[i], descent[0], hands[hand]):
                failure[i] = NO_MOTION
        return failure

    def _arrives(self, model: CollisionModel, transit: Tensor | None, standoff: np.ndarray, hand: np.ndarray) -> bool:
        """Whether a collision-free motion leads from the start posture to the standoff."""
        if transit is not None:
            return model.free(transit.double().numpy(), hand)
        if self.settings.motion == "none":
            return True
        return plan(model, self.start.double().numpy(), standoff, hand, self.settings.plan) is not None

    def _model(self, name: Literal["hand", "approach", "transit", "plan"]) -> CollisionModel:
        """The collision model for one part of the motion, built at its first use."""
        if name not in self._models:
            s = self.settings
            clearance = {
                "hand": {"hand object": -s.overlap},
                "approach": {"arm": 0.0, "arm object": s.clearance},
                "plan": {
                    "arm": 0.0,
                    "table": s.table_clearance,
                    "arm object": s.clearance,
                    "hand object": s.clearance,
                },
                "transit": {
                    "arm": -s.graze,
                    "table": s.table_clearance,
                    "arm object": s.clearance,
                    "hand object": -s.brush,
                },
            }[name]
            table = (*self._normal.tolist(), self._level)
            self._models[name] = CollisionModel(self.robot, self.pieces, table, clearance)
        return self._models[name]
