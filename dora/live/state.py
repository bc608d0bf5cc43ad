"""What a session says of itself: frozen records, made by its thread, read by a page or a test."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from dora.robot import RobotDescription
from dora.sim.shapes import DrawnShape
from dora.tasks.env.starts import StartNumber


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What stays the same while an environment lives.

    Attributes:
        env_id: id of the task.
        robots: description of each arm's robot.
        handles: name of the object that each arm handles.
        objects: names of the objects.
        fixtures: shapes of the other bodies that are drawn, by name.
        ladders: names of the stages, in order; of each arm if they have stages of their own.
        terms: names of the reward's terms.
        limit: largest overlap of an episode that counts as a success [mm].
        dt: duration of a control step [s].
        max_steps: control steps of an episode.
        camera: eye and target of a first view [m].
        numbers: numbers of a start that a person can choose; none where the task offers none.
        candidates: a word about each candidate; none with several arms, whose candidates cannot be chosen.
    """

    env_id: str
    robots: Mapping[str, RobotDescription]
    handles: Mapping[str, str]
    objects: tuple[str, ...]
    fixtures: Mapping[str, tuple[DrawnShape, ...]]
    ladders: tuple[tuple[str, ...], ...]
    terms: tuple[str, ...]
    limit: float
    dt: float
    max_steps: int
    camera: tuple[tuple[float, float, float], tuple[float, float, float]]
    numbers: tuple[StartNumber, ...]
    candidates: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Goal:
    """What the chosen candidate of an arm asks for: wrist pose in the world (7,) [m, wxyz], and hand joints [rad]."""

    wrist: Float[np.ndarray, " 7"]
    joints: Float[np.ndarray, " hand"]


@dataclass(frozen=True, kw_only=True)
class Forces:
    """Contact forces of the last control step, as the task reads them.

    Attributes:
        pairs: who is pressed, and by whom, such as ("arm.thumb", "hammer").
        points: where (k, 3), world frame [m].
        forces: on the first of each pair (k, 3), world frame [N].
    """

    pairs: tuple[tuple[str, str], ...]
    points: Float[np.ndarray, "k 3"]
    forces: Float[np.ndarray, "k 3"]


@dataclass(frozen=True, kw_only=True)
class History:
    """The episode so far, a row for each control step.

    Attributes:
        time: since its start [s].
        terms: weighted value of each term of the reward.
        overlap: in this step, and the largest so far [mm].
    """

    time: Float[np.ndarray, " t"]
    terms: Float[np.ndarray, "t k"]
    overlap: Float[np.ndarray, "t 2"]


@dataclass(frozen=True, kw_only=True)
class Episode:
    """The running episode.

    Attributes:
        seed: of its start.
        step, time: control steps since then, and the same in seconds.
        stages: index of the active stage of each of `Setup.ladders`; the number of its stages when all are done.
        reward: of the last step.
        verdict: how it stands, or how it ended and why.
        success: whether it counts as a success as it stands.
        over: it has ended, by failure or by time.
        chosen: index of the chosen candidate of each arm.
        reachable: indices of the candidates that can be reached from this start; of one arm only.
        shares: the start, as a share of the range of each number of `Setup.numbers`.
        history: of rewards and overlap.
    """

    seed: int
    step: int
    time: float
    stages: tuple[int, ...]
    reward: float
    verdict: str
    success: bool
    over: bool
    chosen: Mapping[str, int]
    reachable: tuple[int, ...]
    shares: tuple[float, ...]
    history: History


@dataclass(frozen=True, kw_only=True)
class Poses:
    """Where everything is after a physics step.

    Attributes:
        links: world pose of each link by arm and name (7,) [m, wxyz].
        objects, fixtures: the same of objects and of other bodies that are drawn.
    """

    links: Mapping[tuple[str, str], Float[np.ndarray, " 7"]]
    objects: Mapping[str, Float[np.ndarray, " 7"]]
    fixtures: Mapping[str, Float[np.ndarray, " 7"]]


@dataclass(frozen=True, kw_only=True)
class LiveState(Poses):
    """A session after a control step, or after an order.

    Attributes:
        count: number of states so far.
        at: when it was made [s], by the clock of the session.
        passed: poses after the earlier physics steps of the control step that led here; none after an order.
        setup: of the environment.
        scales: sizes of the objects relative to their nominal ones.
        goals: by arm.
        forces: of the contacts.
        episode: the running one.
        player: name of what acts.
        preset: how much episodes are randomised.
        candidate: index of the candidate that was asked for; None for the nearest ones.
        running: whether time goes on.
        speed: seconds of the task in a second, as asked for.
        rate: the same, as reached lately; 0 while nothing moves.
        repeat: whether the next episode begins when one is over.
        episodes, successes: finished ones since player, preset or candidate were last chosen.
        message: what could not be done, and why; empty otherwise.
    """

    count: int
    at: float
    passed: tuple[Poses, ...]
    setup: Setup
    scales: Mapping[str, float]
    goals: Mapping[str, Goal]
    forces: Forces
    episode: Episode
    player: str
    preset: str
    candidate: int | None
    running: bool
    speed: float
    rate: float
    repeat: bool
    episodes: int
    successes: int
    message: str

    def poses_at(self, time: float) -> tuple[int, Poses]:
        """The physics step that is to be shown at a time, so that a control step takes as long as its successor needs.

        Args:
            time: by the clock of the session [s].

        Returns:
            Its index in the control step, and its poses; after the last one the state itself.
        """
        share = (time - self.at) * self.speed / self.setup.dt
        index = min(max(int(share * (len(self.passed) + 1)), 0), len(self.passed))
        return index, (*self.passed, self)[index]
