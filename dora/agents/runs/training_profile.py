"""Where the time of a training goes: a short run whose tasks and learner keep clocks."""

import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from dora.agents.collecting.rollouts import Rollouts
from dora.agents.collecting.task_env import MakeTask
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import Evaluation
from dora.agents.runs.interrupt import Interrupt
from dora.agents.runs.machine import own_seconds
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer
from dora.errors import InputError

MOST_STEPS = 10_000_000
"""Most environment steps of a profile [1]."""
EVERY = 8
"""Control steps of a task between two writings of its clocks [1]."""
FEWEST_EPISODES = 2
"""Of the last evaluation, which is no part of the profile [1]."""


@dataclass(frozen=True)
class Clocks:
    """Times of one task [s]: `physics` and `contacts` (and all other reading and writing of its simulator) as parts of
    `environment`, which is processor time in `step` and `reset`; `acting`, processor time of its process between
    them. From its first step on."""

    physics: float
    contacts: float
    environment: float
    acting: float


@dataclass(frozen=True)
class TrainingProfile:
    """Where the time of a training went, its last evaluation and its start left out.

    Attributes:
        env, agent: what was trained.
        steps: environment steps.
        seconds: wall time of the training [s].
        steps_per_second: of both.
        cores: that the machine has.
        busy_cores: that all processes of the run kept busy on average.
        collecting, learning, evaluating, saving: shares of `seconds` in which the main process waited for a batch,
            learned from one, evaluated, and did anything else, such as saving and logging [1].
        physics, contacts, environment, acting, waiting: shares of the workers' `seconds` [1]: PhysX; reading contacts
            and states; the rest of the environment (rewards, observations, ManiSkill); the policy and the collector;
            and what is left, in which they wait for the learner, an evaluation or a core.
    """

    env: str
    agent: str
    steps: int
    seconds: float
    steps_per_second: float
    cores: int
    busy_cores: float
    collecting: float
    learning: float
    evaluating: float
    saving: float
    physics: float
    contacts: float
    environment: float
    acting: float
    waiting: float


class ClockedTasks:
    """Makes tasks that write their clocks into a folder.

    Args:
        make_task: makes a batch of tasks from their number; picklable.
        folder: of the files, one for each task.
        make_profile: makes what a task's simulator adds its times to: by part, `seconds["physics"]` among them.
    """

    def __init__(self, make_task: MakeTask, folder: Path, make_profile: Callable[[], Any]):
        self.make_task, self.folder, self.make_profile = make_task, folder, make_profile

    def __call__(self, count: int) -> Any:
        """A batch of so many tasks, whose steps and resets are timed."""
        task = self.make_task(count)
        _Clock(task, self.folder / f"{os.getpid()}-{id(task)}.json", self.make_profile())
        return task


class _Clock:
    """Times what a task does from its first step on, and writes its `Clocks`.

    Args:
        task: whose `step` and `reset` are timed from now on.
        path: of the file.
        profile: what its simulator adds its times to, as of `ClockedTasks`.
    """

    def __init__(self, task: Any, path: Path, profile: Any):
        self._task, self._path, self._profile = task, path, profile
        self._environment = self._inside = self._acting = 0.0
        self._left, self._steps = 0.0, 0
        task.step, task.reset = self._timed(task.step, is_step=True), self._timed(task.reset, is_step=False)

    def _timed(self, method: Callable[..., Any], is_step: bool) -> Callable[..., Any]:
        """The method with clocks around it; a reset before the first step is not timed."""

        def call(*args: Any, **kwargs: Any) -> Any:
            """As the method, whose times are added [s]."""
            entered, at = time.process_time(), time.perf_counter()
            if self._steps:
                self._acting += entered - self._left
            if not (is_step or self._steps):
                return method(*args, **kwargs)
            if is_step and self._task.scene.px.profile is not self._profile:  # that of a scene that was built anew
                self._task.scene.px.profile = self._profile
            try:
                return method(*args, **kwargs)
            finally:
                self._left = time.process_time()
                self._environment += self._left - entered
                self._inside += time.perf_counter() - at
                self._steps += is_step
                if is_step and self._steps % EVERY == 0:
                    self._write()

        return call

    def _write(self) -> None:
        """Parts of the simulator are wall times; they are taken as shares of the processor time inside."""
        share = self._environment / self._inside
        parts = {name: share * seconds for name, seconds in self._profile.seconds.items()}
        physics = parts.pop("physics")
        clocks = Clocks(physics, sum(parts.values()), self._environment, self._acting)
        half = self._path.with_suffix(".half")
        half.write_text(json.dumps(asdict(clocks)))
        half.replace(self._path)


def profile_training(
    config: RunConfig, make_task: MakeTask, make_profile: Callable[[], Any], steps: int, cores: int
) -> TrainingProfile:
    """Train for a while and tell where the time went; the run is thrown away.

    Args:
        config: settings of the run, with workers.
        make_task: makes a batch of its tasks from their number; picklable.
        make_profile: as for `ClockedTasks`.
        steps: environment steps; evaluations come as often as the settings say.
        cores: of the machine.

    Raises:
        InputError: there are too few steps for two batches, too many, or no workers.
    """
    if config.workers < 1:
        raise InputError(f"workers is {config.workers}: give 1 or more, whose time is told beside the learner's.")
    batch = config.num_envs * config.workers * config.learner.rollout
    if not 2 * batch <= steps <= MOST_STEPS:
        raise InputError(f"--steps is {steps}: give a number from {2 * batch} (two batches) to {MOST_STEPS}.")
    config = replace(config, total_steps=steps, final_episodes=FEWEST_EPISODES, stop_success=None)
    with tempfile.TemporaryDirectory() as name:
        folder, clocks = RunFolder(Path(name) / "run"), Path(name) / "clocks"
        clocks.mkdir()
        folder.create(config)
        trainer = _Timed(config, make_task, folder, zero=False)
        trainer.clocked = ClockedTasks(make_task, clocks, make_profile)
        trainer.run()
        if trainer.interrupted is not None:
            raise KeyboardInterrupt
        found = [Clocks(**json.loads(path.read_text())) for path in sorted(clocks.glob("*.json"))]
    return _summed(config, trainer.counters.env_steps, trainer.spent, (trainer.begun, trainer.ended), found, cores)


class _Timed(Trainer):
    """A run that notes when its training began and ended, with tasks of workers that have clocks."""

    clocked: ClockedTasks
    """Makes those."""

    def _rollouts(self, interrupt: Interrupt) -> Rollouts:
        self.make_task = self.clocked  # evaluation has its own already
        rollouts = super()._rollouts(interrupt)
        self.begun = time.perf_counter(), own_seconds()
        return rollouts

    def _final_evaluation(self, interrupt: Interrupt) -> tuple[Evaluation, Evaluation | None]:
        self.ended = time.perf_counter(), own_seconds()
        self.spent = dict(self.counters.seconds)  # before the last evaluation's time is added
        return super()._final_evaluation(interrupt)


Moment = tuple[float, float]
"""Wall time, and the processor time of the run until then [s]."""


def _summed(
    config: RunConfig,
    steps: int,
    spent: Mapping[str, float],
    between: tuple[Moment, Moment],
    clocks: Sequence[Clocks],
    cores: int,
) -> TrainingProfile:
    """The profile of a run from its own clocks and those of its workers."""
    (begun, used), (ended, used_then) = between
    seconds = ended - begun
    phases = {name: time_of / seconds for name, time_of in spent.items()}
    of_workers = {
        name: sum(getattr(each, name) for each in clocks) / (seconds * config.workers)
        for name in ("physics", "contacts", "environment", "acting")
    }
    rest = of_workers["environment"] - of_workers["physics"] - of_workers["contacts"]
    return TrainingProfile(
        env=config.env,
        agent=config.agent,
        steps=steps,
        seconds=seconds,
        steps_per_second=steps / seconds,
        cores=cores,
        busy_cores=(used_then - used) / seconds,
        collecting=phases["collect"],
        learning=phases["learn"],
        evaluating=phases["evaluate"],
        saving=1 - sum(phases.values()),
        physics=of_workers["physics"],
        contacts=of_workers["contacts"],
        environment=rest,
        acting=of_workers["acting"],
        waiting=1 - of_workers["environment"] - of_workers["acting"],
    )
