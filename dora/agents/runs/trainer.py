"""The training loop that all learners share."""

import functools
import math
import os
import signal
import sys
import time
from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor

from dora.agents.checkpoint import (
    Checkpoint,
    bytes_of,
    check_belongs,
    check_finite,
    pack_modules,
    pack_optimisers,
    pack_rng,
    read_checkpoint,
    unpack_modules,
    unpack_optimisers,
    unpack_rng,
    whole,
)
from dora.agents.collecting.rollouts import Rollouts
from dora.agents.collecting.task_env import (
    NONFINITE,
    Easing,
    EpisodeColumns,
    MakeTask,
    TrainingRules,
    ended_episodes,
)
from dora.agents.config import RunConfig
from dora.agents.counters import LEARNER, Counters, checked_counters
from dora.agents.evaluation.evaluate import PERIODIC_SEED, Evaluation, outcome
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.learners.finite import check_modules, check_tensors
from dora.agents.learners.learner import Learner, agents_of, make_learner
from dora.agents.limits import check_checkpoint
from dora.agents.runs.interrupt import Interrupt
from dora.agents.runs.logging import RunLog
from dora.agents.runs.machine import OtherLoad
from dora.agents.runs.progress_table import ProgressTable, means_of
from dora.agents.runs.run_folder import RunFolder, make_result
from dora.agents.seeds import seeds_for
from dora.errors import RECORDS, InputError, WorkerFailure
from dora.parallel import name_leftovers
from dora.progress import ProgressDisplay
from dora.version import source_commit

ENOUGH = 2
"""Evaluations in a row that have to reach `stop_success`."""
RECENT = 200
"""Number of latest training episodes over which the displayed success rate is taken."""


class Trainer:
    """One run: trains, evaluates, logs and saves in a run folder.

    Attributes:
        interrupted: the signal that asked the run to end, None if there was none.
        saved: whether all that was trained until then is in the latest checkpoint.

    Args:
        config: settings.
        make_task: makes tasks for workers and for evaluation.
        folder: an existing run folder.
        resume: go on from the folder's latest checkpoint, or begin if there is none yet.
        zero: evaluate zero correction at the end, too, if there is a prior.
        cluster: workers are actors of a Ray cluster instead of processes of this machine.

    Raises:
        InputError: if the checkpoint does not fit, or the networks are too large for one.
    """

    def __init__(
        self,
        config: RunConfig,
        make_task: MakeTask,
        folder: RunFolder,
        *,
        resume: bool = False,
        zero: bool = True,
        cluster: bool = False,
    ):
        name_leftovers()  # a replay buffer has semaphores
        self._others, self._looked = OtherLoad(), time.perf_counter()
        self._commit = source_commit()  # of the code that runs: the checkout may change meanwhile
        self.config, self.make_task, self.folder, self._zero, self._cluster = config, make_task, folder, zero, cluster
        torch.set_num_threads(config.learner_threads)
        os.environ[RECORDS] = str(folder.nonfinite.absolute())  # processes that are started later see it, too
        self.interrupted: int | None = None
        self.saved = False
        self.counters = Counters(next_evaluation=config.eval_every)
        self._evaluators = Evaluators(make_task, config)
        self.columns: EpisodeColumns = self._evaluators.env.columns
        self.sizes = self._evaluators.sizes
        weights_seed, self._exploration_seed = seeds_for(config.seed, 0, 2)
        torch.manual_seed(weights_seed)
        self.agents = agents_of(config, self._evaluators.agents)
        self.learner: Learner = make_learner(config, *self.sizes, self.agents)
        check_checkpoint(bytes_of(self.learner.modules, self.learner.optimisers))
        torch.manual_seed(self._exploration_seed)
        self._recent = torch.zeros(0, len(self.columns.names))
        self._resumed: dict[str, Tensor] | None = None
        self._last_evaluation: Evaluation | None = None
        if resume:
            self._load()

    def run(self) -> dict[str, Any]:
        """Train until the budget is spent or `stop_success` is reached; returns what `result.json` got.

        After Ctrl-C or SIGTERM the state is saved, the result has `finished` false, and `interrupted` is the signal; a
        signal while the result of a finished run is written changes nothing of it.

        Raises:
            RunFailure: if training diverged, in which case the last checkpoint stays, or a worker failed, in which
                case the state is saved; `result.json` has `finished` false.
        """
        evaluation, zero, finished = None, None, False
        with Interrupt() as interrupt:
            self.folder.mark_unfinished()
            log = RunLog(self.folder.path, self.counters.env_steps, self.config)
            try:
                evaluation, zero = self._train_and_evaluate(log, interrupt)
                finished = True
            except KeyboardInterrupt:
                interrupt.closing = True
                self.interrupted = interrupt.number or signal.SIGINT
            finally:
                interrupt.closing = True
                self._evaluators.close()
                evaluation = evaluation or self._last_evaluation
                result = self._write_result(evaluation, zero, finished)
                if finished:
                    log.add_final(result, self.counters.env_steps)
                log.close()
        if finished:
            self.interrupted = interrupt.number
        return result

    def _train_and_evaluate(self, log: RunLog, interrupt: Interrupt) -> tuple[Evaluation, Evaluation | None]:
        """Everything between the beginning and the end of a run; whatever ends it early, the state is on disk."""
        stages, first_step = self._evaluators.env.task.stage_names, self.counters.env_steps
        self._table = ProgressTable(self.folder.progress, stages, first_step)
        with self._rollouts(interrupt) as rollouts, ProgressDisplay() as progress:
            try:
                self._train(rollouts, log, progress, interrupt)
            except (KeyboardInterrupt, WorkerFailure) as error:
                if not interrupt.at_once:  # else perhaps in the middle of learning
                    self.save()
                    self.saved = True
                if interrupt.requested and isinstance(error, WorkerFailure):
                    raise KeyboardInterrupt from None  # the same signal ended the worker
                raise
        self.save()
        self.saved = True
        progress.say(f"last evaluation of the best policy, on {self.config.final_episodes} episodes ...")
        evaluation, zero = self._final_evaluation(interrupt)
        progress.say(outcome(evaluation, zero))
        return evaluation, zero

    def _write_result(self, evaluation: Evaluation | None, zero: Evaluation | None, finished: bool) -> dict[str, Any]:
        self._take_time()
        counters = self.counters
        result = make_result(
            self.config,
            env_steps=counters.env_steps,
            wall_seconds=counters.wall_seconds,
            episodes=counters.episodes,
            evaluation=evaluation,
            zero=zero,
            curve=counters.curve,
            finished=finished,
            commit=self._commit,
            nonfinite=counters.nonfinite,
            other_seconds=counters.other_seconds,
        )
        if evaluation is not None:
            self.folder.write_evaluation(evaluation, zero)
        return self.folder.write_result(result)

    def _rollouts(self, interrupt: Interrupt) -> Rollouts:
        config = self.config
        workers = max(config.workers, 1)
        easing = Easing(config.overlap_share, config.overlap_steps, self.counters.env_steps, workers)
        rollouts = Rollouts(
            functools.partial(self.make_task, config.num_envs),
            self.learner.policy,
            workers=config.workers,
            num_envs=config.num_envs,
            rollout=self.learner.rollout,
            seeds=seeds_for(config.seed, self.counters.env_steps + 1, workers),
            rules=TrainingRules(config.stagger, config.after_success, easing),
            ahead=self.learner.replay is not None,
            check=interrupt.check,
            cluster=self._cluster,
        )
        if self._resumed is not None:
            with whole(self.folder.latest):
                unpack_rng(self._resumed)
        else:
            torch.manual_seed(self._exploration_seed)
        return rollouts

    def _train(self, rollouts: Rollouts, log: RunLog, progress: ProgressDisplay, interrupt: Interrupt) -> None:
        counters, config = self.counters, self.config
        show, saved = progress.bar("training"), time.monotonic()
        if self._evaluation_is_due():  # that which was interrupted, and perhaps the last one
            self._evaluate(log, progress, interrupt)
        while counters.env_steps < config.total_steps and counters.reached < ENOUGH:
            interrupt.check()
            start = time.perf_counter()
            batch = rollouts.collect(interrupt.check)
            collected = time.perf_counter()
            values = self.learner.update(batch, lambda: interrupt.requested)
            check_modules(self.learner.modules)
            counters.env_steps += batch.numel()
            self._count_nonfinite(batch, progress)
            ended = ended_episodes(batch["next", "done"], batch["next", "statistics"], self.columns)
            counters.episodes += len(ended)
            learned = time.perf_counter()
            counters.seconds["collect"] += collected - start
            counters.seconds["learn"] += learned - collected
            self._take_time()
            self._log_iteration(log, values, ended, batch.numel() / (learned - start))
            interrupt.check()
            if self._evaluation_is_due():
                self._evaluate(log, progress, interrupt)
            if time.monotonic() - saved > config.checkpoint_seconds:
                self.save()
                saved = time.monotonic()
            mean_rate = counters.env_steps / max(counters.wall_seconds, 1e-9)
            show(counters.env_steps, config.total_steps, mean_rate, self._status(mean_rate))

    def _count_nonfinite(self, batch: TensorDictBase, progress: ProgressDisplay) -> None:
        """Count the episodes that were not finite, cut short or not, and tell of the first."""
        ended = batch["next", "statistics"][batch["next", "done"][..., 0]]
        count = int(self.columns.column(ended, NONFINITE).sum())
        if count and not self.counters.nonfinite:
            where = self.folder.nonfinite
            progress.say(
                f"The simulation of {count} episodes was not finite: they were ended, and further ones are counted"
                + (f"; last states are in {where}." if where.exists() else ".")
            )
        self.counters.nonfinite += count

    def _status(self, rate: float) -> str:
        """Environment steps per second and the success rates in training and in the last evaluation."""
        rates = self._training_success(), self.counters.curve[-1][2] if self.counters.curve else None
        training, evaluated = ("-" if x is None else f"{x:.2f}" for x in rates)
        return f"{rate:,.0f} steps/s, success {training} (evaluated {evaluated})"

    def _take_time(self) -> None:
        """Add what has passed since the last call: all of it, whatever was done meanwhile."""
        now = time.perf_counter()
        self.counters.wall_seconds += now - self._looked
        self.counters.other_seconds += self._others.seconds()
        self._looked = now

    def _training_success(self) -> float | None:
        if len(self._recent) == 0:
            return None
        return float(self.columns.column(self._recent, "success").mean())

    def _log_iteration(self, log: RunLog, values: dict[str, float], ended: Float[Tensor, "e k"], rate: float) -> None:
        counters = self.counters
        step = counters.env_steps
        log.add_learner(values, step)
        shares = {f"{k}_share": v / counters.wall_seconds for k, v in counters.seconds.items()}
        log.add("speed", {"steps_per_second": rate, **shares}, step)
        self._recent = torch.cat([self._recent, ended])[-RECENT:]
        means = means_of(ended, self.columns)
        log.add("training", means, step)
        self._table.add({"env_steps": step, "seconds": counters.wall_seconds, "episodes": len(ended)} | means)

    def _evaluation_is_due(self) -> bool:
        """At each multiple of `eval_every`, and at the end of a budget that is none."""
        steps, curve = self.counters.env_steps, self.counters.curve
        at_end = steps >= self.config.total_steps and len(curve) > 0 and curve[-1][0] < steps
        return at_end or steps >= self.counters.next_evaluation

    def _evaluate(self, log: RunLog, progress: ProgressDisplay, interrupt: Interrupt) -> None:
        """Evaluate, and keep the policy if it is the best so far."""
        counters, config = self.counters, self.config
        if not self.folder.latest.exists():  # where a policy has been evaluated, there is a checkpoint to go on from
            self.save()
        start = time.perf_counter()
        evaluation = self._evaluators.run(self.learner.policy, config.eval_episodes, PERIODIC_SEED, interrupt.check)
        self.counters.seconds["evaluate"] += time.perf_counter() - start
        self._take_time()
        while counters.next_evaluation <= counters.env_steps:
            counters.next_evaluation += config.eval_every
        self._last_evaluation = evaluation
        success, mean_return, depth = evaluation.success_rate, evaluation.return_mean, evaluation.penetration_p95_mm
        measured = {"success_rate": success, "return_mean": mean_return}
        log.add("evaluation", measured | ({} if depth is None else {"penetration_p95_mm": depth}), counters.env_steps)
        log.add("evaluation/stage", evaluation.stage_rates, counters.env_steps)
        row = [success, mean_return, *(math.nan if x is None else x for x in (depth, self._training_success()))]
        counters.curve.append([counters.env_steps, round(counters.wall_seconds, 2), *row])
        self.folder.write_curve(counters.curve)
        progress.say(
            f"{counters.env_steps:,} steps, {counters.wall_seconds:.0f} s: success {evaluation.success_text}, "
            f"return {mean_return:.2f}" + (f", penetration p95 {depth:.1f} mm" if depth is not None else "")
        )
        if counters.best is None or [success, mean_return] > counters.best:
            counters.best = [success, mean_return]
            self._keep_as_best()
        reached = config.stop_success is not None and evaluation.reaches(config.stop_success)
        counters.reached = counters.reached + 1 if reached else 0

    def _keep_as_best(self) -> None:
        """Write the networks that act, without critics."""
        self._checkpoint(pack_modules(self.learner.policy.modules_by_name)).write(self.folder.best)

    def _final_evaluation(self, interrupt: Interrupt) -> tuple[Evaluation, Evaluation | None]:
        """Evaluate the best policy, and zero correction, on seeds that did not select it."""
        start = time.perf_counter()
        if self.counters.best is None:  # there was no evaluation, and what is there is of another run
            self._keep_as_best()
        with torch.random.fork_rng(devices=[]):  # networks of its own: those that learn stay as they are
            policy = make_learner(self.config, *self.sizes, self.agents).policy
        unpack_modules(policy.modules_by_name, self._read_best().tensors, self.folder.best)
        evaluation, zero = self._evaluators.final(policy, interrupt.check, zero=self._zero)
        self.counters.seconds["evaluate"] += time.perf_counter() - start
        self._take_time()
        return evaluation, zero

    def _read_best(self) -> Checkpoint:
        """The checkpoint of the best evaluation of this run.

        Raises:
            InputError: if it is missing, damaged, or of another run.
        """
        path = self.folder.best
        if not path.exists():
            raise InputError(f"{path} is missing, the best policy of this run so far: put it back, or start a new run.")
        best = read_checkpoint(path)
        check_belongs(best, path, self.config, self.sizes, self.agents, exactly=True)
        return best

    def save(self) -> None:
        """Write the latest checkpoint.

        Raises:
            InputError: if the disk is full; the previous checkpoint survives.
            RunFailure: if something in it is not finite; the previous checkpoint survives.
        """
        self._take_time()
        replay = self.learner.replay
        tensors = pack_modules(self.learner.modules) | pack_optimisers(self.learner.optimisers) | pack_rng()
        check_tensors(tensors)
        if replay is not None:
            replay.save(self.folder.replay, self.config.digest())
        self._checkpoint(tensors).write(self.folder.latest)
        if replay is not None:
            replay.forget_old_files(self.folder.replay)

    def _checkpoint(self, tensors: dict[str, Tensor]) -> Checkpoint:
        progress = dict(vars(self.counters)) | {LEARNER: self.learner.counters()}
        return Checkpoint(self.config, self.sizes, tensors, progress, agents=self.agents)

    def _load(self) -> None:
        """Go on from the latest checkpoint, or begin where the run ended before it wrote one.

        Raises:
            InputError: it is damaged, of another run, or was there and is missing.
        """
        path, replay = self.folder.latest, self.learner.replay
        if not self.folder.has_checkpoint():
            print(
                f"There is no checkpoint in {self.folder.path} yet: the run begins at its first step.", file=sys.stderr
            )
            if replay is not None:
                replay.forget_old_files(self.folder.replay)
            return
        checkpoint = read_checkpoint(path)
        check_belongs(checkpoint, path, self.config, self.sizes, self.agents, exactly=True)
        check_finite(checkpoint.tensors, path)
        unpack_modules(self.learner.modules, checkpoint.tensors, path)
        with whole(path):
            unpack_optimisers(self.learner.optimisers, checkpoint.tensors)
            self.learner.set_counters(checkpoint.progress[LEARNER])
        self.counters = checked_counters(checkpoint.progress, path)
        if checkpoint.config.total_steps < self.config.total_steps:  # asked to go on, however good it is
            self.counters.reached = 0
        if self.counters.best is not None:
            best = self._read_best()
            if best.progress["env_steps"] > self.counters.env_steps:  # written after the checkpoint, before a kill
                self.counters.best = best.progress["best"]
        if replay is not None:
            replay.load(self.folder.replay, self.config.digest())
            replay.forget_old_files(self.folder.replay)  # those of a newer state, which was never finished
        self._resumed = checkpoint.tensors
