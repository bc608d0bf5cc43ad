"""Ranking of grasp candidates by simulated executions: reach, close, lift from a table, hold.

The palm is mounted on a carriage instead of the arm: it moves along the candidate's approach direction, the hand closes
as fast as in the tasks, and the palm rises. Every candidate is executed several times with different masses,
frictions and errors of the wrist's pose. Ranking and reporting draw from separate random streams, so that the reported
rates of the best candidates are not biased by their selection.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import sapien
import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.grasp_test_settings import STANDARD
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.errors import InputError
from dora.geometry.rotations import (
    matrix_from_quaternion,
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)
from dora.parallel import Progress, run_cases
from dora.robot import RobotDescription
from dora.sim.grasp_tests.test_scene import GraspTestScene, Physics

Purpose = Literal["ranking", "reporting"]
"""Purposes of executions, each with its own random stream."""
_STREAM: dict[Purpose, int] = {"ranking": 0, "reporting": 1}
"""Number of the random stream by purpose."""
COMMAND_RATE = 20.0
"""Rate of commands to the hand, as in the tasks [1/s]."""
BLOCKED_LAG = 0.03
"""Lag of the palm behind its command at which an approach counts as blocked [m]."""


@dataclass(frozen=True)
class Execution:
    """Numbers of an execution, and the ranges from which each execution draws.

    Attributes:
        draws: number of executions per candidate.
        mass: range of the factor on the object's mass, uniform [1].
        friction: range of the Coulomb coefficient of object, hand and table, uniform [1].
        position: largest error of the wrist's position along each axis of the object frame, uniform [m].
        rotation: largest error of the wrist's orientation about each axis of the wrist frame, uniform [rad].
        standoff: length of the approach [m].
        speed: speed of the approach and of the lift [m/s].
        closing_time: duration of the closing [s].
        settling_time: time between closing and lift [s].
        height: height of the lift of the palm [m].
        lifted: rise of the object above which the lift succeeds [m].
        hold: time for which the palm stays at the top [s].
        turn: largest angle between the object's orientations on the table and in the end [rad].

    Raises:
        InputError: `draws` is below 1, or a range of `mass` or `friction` is not positive and ascending.
    """

    draws: int = 8
    mass: tuple[float, float] = (0.75, 1.5)
    friction: tuple[float, float] = (0.6, 1.0)
    position: float = 0.005
    rotation: float = 0.05
    standoff: float = 0.10
    speed: float = 0.16
    closing_time: float = 0.6
    settling_time: float = 0.2
    height: float = 0.14
    lifted: float = 0.10
    hold: float = 0.5
    turn: float = 0.5

    def __post_init__(self) -> None:
        if self.draws < 1:
            raise InputError(f"ranking needs at least 1 execution per candidate, not {self.draws}.")
        for name in ("mass", "friction"):
            low, high = getattr(self, name)
            if not 0 < low <= high:
                raise InputError(
                    f"the range of {name} for ranking must be positive and ascending, not {low} to {high}."
                )


@dataclass(frozen=True)
class Lift:
    """One execution.

    Attributes:
        position: (3,) wrist at the grasp in the world [m].
        quaternion: (4,) wrist at the grasp in the world, wxyz.
        approach: (3,) unit direction of the approach in the world.
        pregrasp, grasp: (hand,) hand joints before closing and commanded by closing [rad].
        mass: mass of the object [kg].
        friction: Coulomb coefficient of object, hand and table [1].
    """

    position: np.ndarray
    quaternion: np.ndarray
    approach: np.ndarray
    pregrasp: np.ndarray
    grasp: np.ndarray
    mass: float
    friction: float


class LiftTest:
    """Executes lifts one after the other in one scene; arguments as for `rank`."""

    def __init__(self, obj: AffordanceObject, robot: RobotDescription, execution: Execution, physics: Physics):
        self.execution, self.physics = execution, physics
        self.rest = np.array([0.0, 0.0, obj.support]), np.array(obj.rest)
        gravity = (0.0, 0.0, -STANDARD.gravity)
        self.scene = GraspTestScene(obj, robot, STANDARD.friction, physics, gravity, carriage=True, table=True)

    def __call__(self, lift: Lift) -> bool:
        """Reach, close, lift and hold; returns whether the lift succeeded."""
        e, scene = self.execution, self.scene
        turn = matrix_from_quaternion(torch.tensor(lift.quaternion)).numpy()
        before, above = -e.standoff * lift.approach @ turn, np.array([0.0, 0.0, e.height]) @ turn
        grasp = np.zeros(3)
        scene.stage(*self.rest, lift.mass, lift.friction)
        scene.hand.reset(lift.pregrasp, sapien.Pose(lift.position.tolist(), lift.quaternion.tolist()), before)
        if not self._move(before, grasp):
            return False
        self._close(lift)
        scene.run(self.physics.steps(e.settling_time))
        self._move(grasp, above)
        scene.run(self.physics.steps(e.hold))
        return self._succeeded()

    def _move(self, begin: np.ndarray, end: np.ndarray) -> bool:
        """Moves the palm along a straight line between offsets (3,) in the root frame [m]; whether it arrived."""
        commands = max(1, round(float(np.linalg.norm(end - begin)) / self.execution.speed * COMMAND_RATE))
        for command in range(1, commands + 1):
            self.scene.hand.move((begin + (end - begin) * command / commands).tolist())
            self.scene.run(self.physics.steps(1 / COMMAND_RATE))
        return self.scene.hand.lag < BLOCKED_LAG

    def _close(self, lift: Lift) -> None:
        commands = max(1, round(self.execution.closing_time * COMMAND_RATE))
        for command in range(1, commands + 1):
            self.scene.hand.command(lift.pregrasp + (lift.grasp - lift.pregrasp) * command / commands)
            self.scene.run(self.physics.steps(1 / COMMAND_RATE))

    def _succeeded(self) -> bool:
        pose, contacts = self.scene.pose, self.scene.read_contacts()
        cosine = min(1.0, abs(float(np.dot(pose.q, self.rest[1]))))
        up = float(pose.p[2] - self.rest[0][2]) > self.execution.lifted
        return up and contacts.in_contact and bool(2 * np.arccos(cosine) < self.execution.turn)


def rank(
    candidates: GraspCandidates,
    obj: AffordanceObject,
    robot: RobotDescription,
    execution: Execution | None = None,
    purpose: Purpose = "ranking",
    seed: int = 0,
    physics: Physics | None = None,
    processes: int | None = None,
    progress: Progress | None = None,
) -> Float[Tensor, " c"]:
    """Share of executed lifts that succeeded, per candidate.

    A lift succeeds if in the end the object is `lifted` above its start, in contact with the hand, and rotated by less
    than `turn`. The arm is not simulated: whether it reaches a candidate is decided by the motion-feasibility filter.

    Args:
        candidates: c candidates of this object and this robot.
        obj: the object, which starts at rest on a table.
        robot: the robot whose hand is simulated on a carriage.
        execution: numbers of the executions; the defaults if None.
        purpose: random stream: "ranking" to choose candidates, "reporting" to report their rates.
        seed: seed of the draws, which are the same for all candidates.
        physics: resolution of the simulation; the default if None.
        processes: number of processes, one per core by default; 1 stays in this process.
        progress: called with the number of executions done and their total.

    Raises:
        InputError: the candidates are of another object.
        WorkerFailure: a simulating process died or hangs.
    """
    candidates.check_fits("the set", obj, None, stored=False)
    execution = execution or Execution()
    lifts = lifts_of(candidates, obj, execution, np.random.default_rng([seed, _STREAM[purpose]]))
    done = run_cases(LiftTest, (obj, robot, execution, physics or Physics()), lifts, processes, progress)
    return torch.tensor(done, dtype=torch.float32).view(len(candidates), execution.draws).mean(1)


def lifts_of(
    candidates: GraspCandidates, obj: AffordanceObject, execution: Execution, random: np.random.Generator
) -> list[Lift]:
    """All `draws` executions of each of c candidates, candidate by candidate."""
    draws, count = execution.draws, len(candidates)
    factor = random.uniform(*execution.mass, draws)
    friction = random.uniform(*execution.friction, draws)
    shift = torch.tensor(random.uniform(-execution.position, execution.position, (draws, 3)), dtype=torch.float32)
    tilt = torch.tensor(random.uniform(-execution.rotation, execution.rotation, (draws, 3)), dtype=torch.float32)
    rest = torch.tensor(obj.rest, dtype=torch.float32).expand(count * draws, 4)
    height = torch.tensor([0.0, 0.0, obj.support])

    def every(field: Tensor) -> Tensor:
        return field.cpu().float().repeat_interleave(draws, 0)

    position = height + quaternion_apply(rest, every(candidates.position) + shift.repeat(count, 1))
    turned = quaternion_multiply(rest, every(candidates.quaternion))
    turned = quaternion_multiply(turned, quaternion_from_rotation_vector(tilt).repeat(count, 1))
    approach = quaternion_apply(rest, every(candidates.approach))
    rows = position, turned, approach, every(candidates.pregrasp), every(candidates.grasp)
    arrays = [row.numpy().astype(np.float64) for row in rows]
    return [
        Lift(*(array[i] for array in arrays), mass=obj.mass * factor[i % draws], friction=friction[i % draws])
        for i in range(count * draws)
    ]
