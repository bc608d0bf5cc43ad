"""Search for the motions with which the fingers turn the caught hammer in the hand.

    python -m dora.tools.in_task.turning --generations 40

The cross-entropy method over offsets of the hand's drives at a few moments, executed in DoraHammer-v1 with
`reorient="in_hand"`: of a population of motions, each tried from a few starts, those that turn the hammer far
without letting it slip are kept, and the next population is drawn around them. Both ways at once: each start says which
way. The mean of the population is written after every generation, so that the search can be interrupted; called again,
it begins with what is there.
"""

import sys
import time
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

import tomli_w
import torch
import tyro
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.affordance.hand.postures import flexion
from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError, command
from dora.files import renew_checksums, write_bytes
from dora.geometry.poses import relative
from dora.geometry.rotations import quaternion_inverse, quaternion_multiply, rotation_vector_from_quaternion
from dora.progress import ProgressDisplay
from dora.robot import RobotDescription, load_robot
from dora.tasks import make_task
from dora.tasks.env.env import DoraEnv
from dora.tasks.hammer.finger_motion import FORMAT, TURNING_FILE, FingerMotion, at_moment, load_motion
from dora.tasks.hammer.mdp import in_hand
from dora.tasks.hammer.reference import TURNED_TIME, CatchReference
from dora.tasks.hammer.snapshot import HammerSnapshot
from dora.tasks.hammer.turning import turn_about_handle

TASK, OBJECT, ROBOT = "DoraHammer-v1", "hammer", "diana7_hit"
"""In which, what, and with the hand of which robot."""
MOMENTS, SECONDS = 4, 1.4
"""Moments at which offsets are given, and duration of the motion [s]."""
ELITE, KEPT, LEAST_SPREAD = 0.25, 0.5, 0.06
"""Share of the population that is kept, share of the former mean in the next one, and smallest spread [rad]."""
LEAST_POPULATION = 8
"""Smallest population of which a few members can be kept."""
OF_THE_MEAN = 2
"""Members of the population each way that are the mean itself, which shows how good it is."""
FAR, TILT, SLIP, LOST, DEEP = 0.9, 0.5, 5.0, 1.0, 200.0
"""Turn beyond which more counts nothing [rad], and costs of a radian of other rotation, of a metre of displacement, of
the loss of the hammer, and of a metre of overlap beyond the limit [rad]."""
FARTHEST, DEEPEST = 0.1, 0.01
"""Displacement and overlap beyond which more costs nothing more [m]."""
FALL, SAME_STARTS, CLEAN = 0.3, 6, 0.8
"""Longest fall of a hammer [s], generations that begin with the same caught hammers, and share of the limit of overlap
that costs nothing [1]."""
SEED = 50_000
"""First seed; training and evaluation use none of these."""


@dataclass
class Args:
    """Search the motions with which the fingers turn the hammer."""

    generations: int = 40
    """Generations of the search."""
    population: int = 32
    """Motions each way in a generation, about."""
    tries: int = 4
    """Starts from which each of them is tried."""
    spread: float = 0.5
    """Spread of the first generation around the motions that there are [rad]."""
    seed: int = 0
    """Of the search."""


@dataclass(frozen=True)
class Population(FingerMotion):
    """A motion of its own for each environment, `motions` (n, k, hand), which goes the environment's way."""

    motions: Float[Tensor, "n k hand"]

    def offsets(self, spent: Float[Tensor, " n"], direction: Float[Tensor, " n"]) -> Float[Tensor, "n hand"]:
        """The offsets of each environment's motion."""
        return at_moment(self.motions, spent / self.seconds)


@dataclass(frozen=True)
class Turned:
    """What a population has done.

    Attributes:
        score: in radians, see above.
        turn: in the hand, the way that was asked for [rad].
        held: whether it is still in the hand.
        way: 1 or -1.
    """

    score: Float[Tensor, " n"]
    turn: Float[Tensor, " n"]
    held: Bool[Tensor, " n"]
    way: Float[Tensor, " n"]


def synergies(robot: RobotDescription) -> Float[Tensor, "p hand"]:
    """Directions of the hand joints in which the search moves: each drive of the thumb, and each drive that flexes the
    other fingers, of all of them alike, as they lie side by side along the handle. Coupled joints follow."""
    leader = {coupling.follower: coupling.leader for coupling in robot.couplings}
    thumb, *others = ([robot.hand.names.index(name) for name in f.joints] for f in robot.fingers.values())
    flexes = flexion(robot) != 0
    alike = [[finger[k] for finger in others] for k in range(len(others[0]))]
    groups = [[joint] for joint in thumb] + [group for group in alike if all(flexes[group])]
    groups = [group for group in groups if not set(group) & set(leader)]
    found = torch.zeros(len(groups), len(robot.hand.names))
    for row, group in zip(found, groups, strict=True):
        row[[j for j in range(len(row)) if leader.get(j, j) in group]] = 1.0
    return found


@dataclass(frozen=True)
class Caught:
    """Episodes in which the hammer has just been caught.

    Attributes:
        state: of the task.
        way: which way (1 or -1) the hammer of each is to be turned.
    """

    state: dict[str, Any]
    way: Float[Tensor, " n"]


def caught(task: DoraEnv, seed: int) -> Caught:
    """Plays new episodes until their fingers begin to turn, or would if they had caught the hammer."""
    task.reset(seed=seed)
    way = task.snapshot.way.clone()  # pyright: ignore[reportAttributeAccessIssue]
    settings = reference_of(task).settings
    _play(task, FALL + settings.close_time + settings.settle_time - 2 * task.config.dt)
    return Caught(task.get_state_dict(), way)


def tried(task: DoraEnv, motions: Float[Tensor, "n k hand"], start: Caught) -> Turned:
    """Plays episodes in which the hammer has been caught to the end of the turn.

    Args:
        task: in which.
        motions: one for each environment.
        start: where they go on.
    """
    task.set_state_dict(start.state)
    reference = reference_of(task)
    reference.motion = Population(SECONDS, motions[0], motions[0], motions)
    s = task.snapshot
    first_p, first_q = relative((s.hand.wrist_p, s.hand.wrist_q), (s.object.p, s.object.q))
    _play(task, FALL + SECONDS + TURNED_TIME)
    s = task.snapshot
    assert isinstance(s, HammerSnapshot)
    p, q = relative((s.hand.wrist_p, s.hand.wrist_q), (s.object.p, s.object.q))
    turn = start.way * turn_about_handle(first_q, q)
    change = quaternion_multiply(quaternion_inverse(first_q), q)
    tilt = rotation_vector_from_quaternion(change)[:, :2].norm(dim=-1)
    config: Any = task.config
    held = in_hand(s, config)
    deep = (s.max_penetration - CLEAN * config.penetration_limit).clamp(0, DEEPEST)
    slip = (p - first_p).norm(dim=-1).clamp(max=FARTHEST)
    score = turn.clamp(-FAR, FAR) - TILT * tilt - SLIP * slip - LOST * ~held - DEEP * deep
    return Turned(score, turn, held, start.way)


def reference_of(task: DoraEnv) -> CatchReference:
    """The task's reference."""
    reference = task.guide.reference
    assert isinstance(reference, CatchReference)
    return reference


def _play(task: DoraEnv, seconds: float) -> None:
    """Goes on for some time with zero correction."""
    zero = torch.zeros(task.num_envs, task.action_size)
    for _ in range(round(seconds / task.config.dt)):
        task.step(zero)


def stored(robot: RobotDescription, path: Path) -> Float[Tensor, "2 k hand"]:
    """The motions that there are, for -1 and 1; zeros if there are none, which are written then."""
    if not path.exists():
        write(robot, path, torch.zeros(2, MOMENTS, len(robot.hand.names)))
    motion = load_motion(OBJECT, robot)
    return torch.stack([motion.negative, motion.positive])


def write(robot: RobotDescription, path: Path, motions: Float[Tensor, "2 k hand"]) -> None:
    """Writes the file of motions."""
    negative, positive = ([[round(x, 4) for x in row] for row in way] for way in motions.tolist())
    table = {"format": FORMAT, "robot": robot.name, "seconds": SECONDS, "joints": list(robot.hand.names)}
    head = "# Offsets of the commanded hand joints [rad], made with `python -m dora.tools.in_task.turning`.\n"
    text = head + tomli_w.dumps(table | {"positive": positive, "negative": negative})
    write_bytes(path, text.encode())
    renew_checksums([path])


@dataclass
class Search:
    """The state of the search: mean and spread of the offsets along the synergies, each way (-1, 1)."""

    mean: Float[Tensor, "2 k p"]
    spread: Float[Tensor, "2 k p"]

    def draw(
        self, way: Float[Tensor, " n"], tries: int, random: torch.Generator
    ) -> tuple[Float[Tensor, "n k p"], Int[Tensor, " n"]]:
        """A motion for each start, and its number among those of its way; each is for at least `tries` starts, and the
        first ones are the mean itself."""
        motions = torch.empty(len(way), *self.mean.shape[1:])
        number = torch.empty(len(way), dtype=torch.long)
        for k, rows in self._rows(way):
            number[rows] = torch.arange(len(rows)) % max(1, len(rows) // tries)
            noise = torch.randn(int(number[rows].max()) + 1, *self.mean.shape[1:], generator=random)
            noise[:OF_THE_MEAN] = 0.0
            motions[rows] = (self.mean[k] + self.spread[k] * noise)[number[rows]]
        return motions, number

    def learn(self, motions: Float[Tensor, "n k p"], number: Int[Tensor, " n"], found: Turned) -> str:
        """Moves mean and spread to the motions with the best mean score over their starts; says how the mean did."""
        told = []
        for k, rows in self._rows(found.way):
            count = torch.bincount(number[rows])
            score = torch.bincount(number[rows], found.score[rows]) / count
            best = score.topk(max(2, round(ELITE * len(count)))).indices
            first = torch.stack([rows[number[rows] == motion][0] for motion in best])
            self.mean[k] = KEPT * self.mean[k] + (1 - KEPT) * motions[first].mean(0)
            self.spread[k] = (KEPT * self.spread[k] + (1 - KEPT) * motions[first].std(0)).clamp(min=LEAST_SPREAD)
            own = rows[number[rows] < OF_THE_MEAN]
            turn, held = degrees(found.turn[own].mean()), float(found.held[own].float().mean())
            told.append(f"{'-+'[k]}{turn:.0f} deg, held {held:.2f}, score {found.score[own].mean():.2f}")
        return ", ".join(told)

    @staticmethod
    def _rows(way: Float[Tensor, " n"]) -> list[tuple[int, Int[Tensor, " b"]]]:
        """Index of each way and the starts that go it."""
        return [(0, torch.where(way < 0)[0]), (1, torch.where(way > 0)[0])]


def search(args: Args) -> None:
    """Runs the generations; raises InputError if the file of motions is damaged or cannot be written, or for a
    population that is too small to choose from."""
    for name, least in (("generations", 1), ("population", LEAST_POPULATION), ("tries", 1)):
        if getattr(args, name) < least:
            raise InputError(f"--{name} is {getattr(args, name)}; it has to be at least {least}.")
    robot, folder = load_robot(ROBOT), load_object(OBJECT).folder
    assert folder is not None
    path, along = folder / TURNING_FILE, synergies(robot)
    mean = stored(robot, path) @ along.T / along.sum(-1)
    state = Search(mean, torch.full_like(mean, args.spread))
    task = make_task(TASK, 2 * args.population * args.tries, preset="standard", config={"reorient": "in_hand"})
    random = torch.Generator().manual_seed(args.seed)
    with ProgressDisplay() as display:
        show, began = display.bar("turning in the hand"), time.monotonic()
        for generation in range(args.generations):
            if generation % SAME_STARTS == 0:
                start = caught(task, SEED + args.seed * 1000 + generation)
            motions, number = state.draw(start.way, args.tries, random)
            told = state.learn(motions, number, tried(task, motions @ along, start))
            write(robot, path, state.mean @ along)
            done = generation + 1
            show(done, args.generations, done / (time.monotonic() - began), f"the mean turns {told}")
    task.close()


@command
def main() -> None:
    """Entry point."""
    search(tyro.cli(Args))


if __name__ == "__main__":
    sys.exit(main())
