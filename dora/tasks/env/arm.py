"""One arm of a task: its robot, the object that it handles, its guide, and what its actions command."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.approach_paths import ReachSettings
from dora.affordance.reach.feasibility import Reach
from dora.affordance.reach.feasibility_table import Grid, ReachTable
from dora.errors import InputError
from dora.geometry.poses import Pose, compose
from dora.progress import slow_phase
from dora.robot.motion.controller_rollout import Controller
from dora.sim.robot_agent import DescribedRobot
from dora.tasks.guidance.exact_correction import exact_correction
from dora.tasks.guidance.guide import Guide
from dora.tasks.guidance.residual_action import Target, wrist_step
from dora.tasks.mdp.guidance_parts import FILTER, PRIOR
from dora.tasks.mdp.randomisation import Randomisation
from dora.tasks.mdp.snapshot import Snapshot

WRIST = 6
"""Components of an action that move the wrist; the others bend the hand [1]."""


@dataclass(frozen=True)
class ArmSpec:
    """What a task says of one arm.

    Attributes:
        object: name of the object that it handles.
        home: name of the robot's posture at the start of an episode; the object's `start_posture` if None.
        position, quaternion: pose of the robot's base in the world [m], wxyz.
        robot: name of its folder in `robots/`, unless the environment is made with others.
    """

    object: str
    home: str | None = None
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    robot: str = "diana7_hit"


def start_posture(spec: ArmSpec) -> str:
    """Name of the robot's posture at the start of an episode."""
    return spec.home or load_object(spec.object).start_posture


class Arm:
    """One arm of a built scene; make a new one after a reconfiguration.

    Args:
        name, spec, agent, guide: see the attributes.
        grid: where its object may stand, for the table of f_reach; None where it does not stand.
        tables: tables of f_reach by the name of the arm, which outlive a reconfiguration.
        starts: candidates that decide where objects start; those of the guide if None.

    Attributes:
        name, spec: as the task says.
        agent: the robot.
        guide: candidates, reference and residual action.
        home: world pose of the wrist at the start of an episode, (1, 3) [m] and (1, 4) wxyz.
    """

    def __init__(
        self,
        name: str,
        spec: ArmSpec,
        agent: DescribedRobot,
        guide: Guide,
        grid: Grid | None,
        tables: dict[str, ReachTable],
        starts: GraspCandidates | None = None,
    ):
        self.name, self.spec, self.agent, self.guide, self._grid, self._tables = name, spec, agent, guide, grid, tables
        self._starts = starts
        self.posture = agent.description.posture(start_posture(spec))
        base = (torch.tensor([x], dtype=torch.float32, device=agent.device) for x in (spec.position, spec.quaternion))
        self.home: Pose = compose((next(base), next(base)), agent.posture_wrist(start_posture(spec)))

    @property
    def reach_table(self) -> ReachTable | None:
        """f_reach of the candidates over the places where the object may stand; None where it does not stand."""
        return self._table(self.name, self.guide.choice.candidates)

    @property
    def start_candidates(self) -> GraspCandidates:
        """The candidates that decide where the object starts."""
        return self.guide.choice.candidates if self._starts is None else self._starts

    @property
    def start_table(self) -> ReachTable | None:
        """The same of the candidates that decide where the object starts."""
        return self.reach_table if self._starts is None else self._table(f"{self.name}/starts", self._starts)

    def _table(self, name: str, candidates: GraspCandidates) -> ReachTable | None:
        if self._grid is not None and name not in self._tables:
            self._tables[name] = tabulated_reach(self, self._grid, candidates)
        return self._tables.get(name)

    @property
    def action_size(self) -> int:
        """Number of components of its part of the action."""
        return math.prod(self.agent.single_action_space.shape or ())

    @property
    def takes_residual(self) -> bool:
        """Whether actions are residuals of the reference: that part of guidance is in force, and actions command the
        wrist."""
        return PRIOR in self.guide.parts and self.agent.commands_wrist

    def rest(self, rows: Int[Tensor, " b"]) -> None:
        """Commands the home posture in the environments `rows`, where the robot has been put into it."""
        if self.agent.commands_wrist:
            joints = torch.tensor([*self.posture.arm, *self.posture.hand], dtype=torch.float32)
            self.agent.wrist_controller.begin(rows, joints.to(self.agent.device).expand(len(rows), -1))

    def home_joints(self) -> Float[Tensor, " joints"]:
        """The home posture in the simulator's order [rad]."""
        return torch.from_numpy(self.agent.qpos_of(self.posture.arm, self.posture.hand)).to(self.agent.device)

    def choose(
        self,
        rows: Int[Tensor, " b"],
        object_p: Float[Tensor, "b 3"],
        object_q: Float[Tensor, "b 4"],
        reachable: Bool[Tensor, "b c"],
        error: Float[Tensor, "b e"],
        randomisation: Randomisation,
        narrow: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        """Gives new episodes their candidates and starts the reference.

        Args:
            rows: environments.
            object_p, object_q: world poses of the handled object.
            reachable: which candidates f_reach accepts; among those the nearest are chosen, if that part of guidance
                is in force, or if there is no guidance at all and only the scripted solution uses candidates.
            error: uniform numbers in [-1, 1] of the candidates' error.
            randomisation: how large that error is.
            narrow: takes the (b, c) candidates among which is chosen, and returns fewer.
        """
        wrist_p, wrist_q = (x.expand(len(rows), -1) for x in self.home)
        choice, parts = self.guide.choice, self.guide.parts
        wanted = reachable if FILTER in parts or not parts else torch.ones_like(reachable)
        wanted = wanted if narrow is None else narrow(wanted)
        index = choice.nearest(object_p, object_q, wrist_p, wrist_q, wanted)
        choice.choose(rows, index, reachable.any(-1), error, randomisation)
        self.guide.begin(rows, wrist_p, wrist_q)

    def exact_correction(self, frame: Pose | None = None) -> Float[Tensor, "n a"]:
        """The residual action that undoes the error of its candidate, as far as the bounds allow.

        Args:
            frame: the true frame of its object in the measured one, position (n, 3) [m] and wxyz, if that is wrong.

        Raises:
            InputError: its actions are no residuals.
        """
        if not self.takes_residual:
            raise InputError(
                "A correction needs actions that correct a reference: leave control_mode and guidance_parts out, or "
                "config.observe_correction."
            )
        expand, bounds = self.agent.wrist_controller.expand_hand, self.guide.residual.bounds
        return exact_correction(self.guide.choice, bounds, expand, self.action_size - WRIST, frame)

    def command(self, observed: Snapshot, action: Float[Tensor, "n a"]) -> Float[Tensor, "n a"]:
        """What the controller is asked: the action itself, or the reference with the residual action.

        Args:
            observed: the state as this arm observes it.
            action: its part of the action.
        """
        if not self.takes_residual:
            return action
        expand = self.agent.wrist_controller.expand_hand
        return self._encoded(self.guide.target(observed, action, expand))

    def scripted_action(self, observed: Snapshot) -> Float[Tensor, "n a"]:
        """Action that executes the chosen candidate from the present state: zero where actions are residuals, and
        elsewhere the reference's target as a plain action of the default controller."""
        if self.takes_residual:
            return torch.zeros(len(observed.time), self.action_size, device=observed.time.device)
        target = self.guide.reference.target(observed)
        self.guide.reference.aim(target)
        return self._encoded(target)

    def _encoded(self, target: Target) -> Float[Tensor, "n a"]:
        """A world target of the wrist and a target of the hand as an action of the wrist controller, which counts in
        the robot's base frame."""
        controller = self.agent.wrist_controller
        step = wrist_step(target.wrist_p, target.wrist_q, *controller.world_wrist(), limits=controller.wrist_limits)
        step = controller.to_base_frame(step)
        return torch.cat([step, controller.hand_action(target.hand)], -1)


def tabulated_reach(arm: Arm, grid: Grid, candidates: GraspCandidates) -> ReachTable:
    """f_reach of candidates of an arm over a grid of places, made once and cached on disk.

    The motions have the period of the task and the descent and hover of the arm's reference; the other numbers are
    the defaults of `ReachSettings` and `Controller`, also where the task's own differ.
    """
    obj, reference = load_object(arm.spec.object), arm.guide.reference
    reach = Reach(
        arm.agent.description,
        obj,
        base=(arm.spec.position, arm.spec.quaternion),
        settings=ReachSettings(
            controller=Controller(period=reference.dt, descent=reference.descent, hover=reference.hover)
        ),
        start=start_posture(arm.spec),
    )
    told = slow_phase(f"what the arm can reach of {obj.name}, stored for later", "places")
    table = ReachTable.of(reach, candidates.to("cpu"), grid, obj.support, obj.rest, progress=told)
    return table.to(arm.agent.device)
