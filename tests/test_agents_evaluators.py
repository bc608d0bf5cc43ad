"""Evaluation on several cores: the same rows as on one, and no process left behind."""

import dataclasses
import functools
import itertools
import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any, ClassVar

import pytest
import torch
from fake_task import PointMass
from torch import Tensor

from dora.agents.config import PPOConfig, RunConfig
from dora.agents.evaluation.evaluate import FINAL_SEED, MOST_SEEDS, PERIODIC_SEED, STARTS, Evaluation, first_seed
from dora.agents.evaluation.evaluators import Evaluators
from dora.agents.learners.learner import make_learner
from dora.agents.seeds import TRAINING_SEEDS
from dora.errors import InputError

EPISODES = 30
"""Three batches and a part of one."""
CONFIG = RunConfig("Fake-v1", "ppo", "affordance", workers=2, eval_envs=8, learner=PPOConfig(hidden=(16,)))


FAILURES: dict[str, Callable[[], Any]] = {
    "ends": lambda: os._exit(3),
    "fails": lambda: {}["no step here"],
    "refuses": lambda: (_ for _ in ()).throw(InputError("The action is NaN.")),
}
"""What a step does in a helper."""


class Judging(PointMass):
    """A task that reports all that evaluation understands: overlap beside success, the end, the simulator's health."""

    logged = (*PointMass.logged, "raw_success", "success_at_end", "nonfinite")
    ranking_steps = 1234

    def step(self, action: Tensor) -> Any:
        *rest, info = super().step(action)
        row = torch.arange(self.num_envs)
        first = self.elapsed_steps == 1
        info |= {"success": row < 4, "raw_success": row < 6, "success_at_end": row < 2, "nonfinite": first & (row == 7)}
        return *rest, info


class FailsElsewhere(PointMass):
    """A task that breaks in every process but the one named."""

    def __init__(self, num_envs: int, home: int, failure: str):
        super().__init__(num_envs)
        self.home, self.failure = home, failure

    def step(self, action: Tensor) -> Any:
        if os.getpid() != self.home:
            FAILURES[self.failure]()
        return super().step(action)


def helpers() -> list[BaseProcess]:
    """Helper processes of this one that have not ended."""
    return multiprocessing.active_children()


class Threads(PointMass):
    """A task that notes on how many threads torch computes while it is stepped."""

    seen: ClassVar[set[int]] = set()

    def step(self, action: Tensor) -> Any:
        self.seen.add(torch.get_num_threads())
        return super().step(action)


def test_a_machine_of_more_cores_gives_the_same_rows():
    """A product of matrices on four threads is rounded otherwise than on one."""
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        Evaluators(Threads, dataclasses.replace(CONFIG, workers=0)).run(None, EPISODES, 0)
        assert Threads.seen == {1}
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(before)


def test_a_share_is_reached_by_the_count_of_episodes():
    """The rate of 95 successes in 100 is .94999999 in float32."""
    evaluators = Evaluators(PointMass, CONFIG)
    columns, width = evaluators.env.columns, len(evaluators.env.columns.names)
    for count, share in ((95, 0.95), (90, 0.9), (48, 0.48), (0, 0.0), (100, 1.0)):
        table = torch.zeros(100, width)
        columns.column(table, "success")[:count] = 1.0
        assert Evaluation(columns, table).reaches(share)
        assert not Evaluation(columns, table).reaches(share + 0.005)
    evaluators.close()


def test_processes_give_the_rows_of_one_process():
    alone, shared = (Evaluators(PointMass, dataclasses.replace(CONFIG, workers=workers)) for workers in (1, 2))
    torch.manual_seed(0)
    policy = make_learner(CONFIG, *alone.sizes).policy
    for acting in (policy, None):
        one, two = (evaluators.run(acting, EPISODES, 100) for evaluators in (alone, shared))
        assert len(one.table) == EPISODES
        assert torch.equal(one.table, two.table)
    policy.normaliser.shift.add_(1.0)  # another policy, whose weights have to arrive
    one, two = (evaluators.run(policy, EPISODES, 100) for evaluators in (alone, shared))
    assert torch.equal(one.table, two.table)
    assert len(helpers()) == 1
    alone.close()
    shared.close()
    assert not helpers()


class Counted(PointMass):
    """A task that notes how many environments each copy has, and how often they are stepped."""

    made: ClassVar[list[int]] = []
    steps: ClassVar[list[int]] = []

    def __init__(self, num_envs: int):
        super().__init__(num_envs)
        self.made.append(num_envs)

    def step(self, action: Tensor) -> Any:
        self.steps.append(self.num_envs)
        return super().step(action)


@pytest.mark.parametrize(("episodes", "sizes"), [(3, [3]), (8, [8]), (19, [8, 3]), (1, [2]), (17, [8, 2])])
def test_no_more_episodes_are_simulated_than_asked_for(episodes: int, sizes: list[int]):
    """But for a last one alone, which has a companion."""
    Counted.made.clear()
    Counted.steps.clear()
    evaluators = Evaluators(Counted, dataclasses.replace(CONFIG, workers=1), episodes)
    evaluation = evaluators.run(None, episodes, 100)
    assert len(evaluation.table) == episodes
    assert Counted.made == sizes
    assert sum(Counted.steps) == 16 * (episodes + (episodes % 8 == 1))
    evaluators.close()


def test_a_row_does_not_depend_on_the_number_of_episodes():
    evaluators = Evaluators(PointMass, dataclasses.replace(CONFIG, workers=1))
    torch.manual_seed(0)
    policy = make_learner(CONFIG, *evaluators.sizes).policy
    for acting in (policy, None):
        most = evaluators.run(acting, 24, 100).table
        for episodes in (1, 2, 3, 9, 23):
            assert torch.equal(evaluators.run(acting, episodes, 100).table, most[:episodes])
    evaluators.close()


def test_what_a_task_reports_is_counted():
    evaluators = Evaluators(Judging, dataclasses.replace(CONFIG, workers=1))
    evaluation = evaluators.run(None, 8, 0)
    rates = evaluation.success_rate, evaluation.raw_success_rate, evaluation.success_at_end_rate
    assert rates == (0.5, 0.75, 0.25)
    assert (evaluation.nonfinite_episodes, evaluation.ranking_steps, evaluation.first_seed) == (1, 1234, 0)
    assert evaluation.success_interval == pytest.approx((0.2152, 0.7848), abs=1e-4)
    evaluators.close()
    plain = Evaluators(PointMass, dataclasses.replace(CONFIG, workers=1))
    evaluation = plain.run(None, 8, 0)
    assert (evaluation.raw_success_rate, evaluation.nonfinite_episodes, evaluation.ranking_steps) == (None, 0, None)
    assert evaluation.success_at_end_rate == evaluation.success_rate
    plain.close()


@pytest.mark.parametrize(
    ("guidance", "asked"), [("affordance", None), ("affordance", False), ("none", None), ("none", True)]
)
def test_the_zero_action_is_evaluated_where_it_is_asked_for_and_corrects_something(guidance: str, asked: bool | None):
    """It is asked for unless that is left out; without a prior it is an ordinary command and no baseline."""
    config = dataclasses.replace(CONFIG, workers=1, guidance=guidance, final_episodes=2)
    evaluators = Evaluators(PointMass, config)
    policy = make_learner(config, *evaluators.sizes).policy
    unsaid = asked is None
    zero = (evaluators.final(policy, first_seed=0) if unsaid else evaluators.final(policy, zero=asked, first_seed=0))[1]
    assert (zero is not None) == (asked is not False and guidance == "affordance")
    evaluators.close()


def test_seeds_of_evaluations_do_not_meet():
    ranges = [(0, TRAINING_SEEDS), (PERIODIC_SEED, PERIODIC_SEED + STARTS), (FINAL_SEED, FINAL_SEED + STARTS)]
    ranges += [(first := first_seed(seed, STARTS), first + STARTS) for seed in (0, 1, 2, 7, MOST_SEEDS - 1)]
    assert all(before <= after for (_, before), (after, _) in itertools.pairwise(ranges))
    assert ranges[-1][1] <= 2**32
    for seed, episodes in ((-1, 1), (MOST_SEEDS, 1), (0, STARTS + 1)):
        with pytest.raises(InputError, match="starts"):
            first_seed(seed, episodes)


@pytest.mark.parametrize(
    ("failure", "error", "message"),
    [
        ("ends", RuntimeError, "A worker process died"),
        ("fails", KeyError, "no step here"),
        ("refuses", InputError, "^The action is NaN.$"),
    ],
)
def test_a_failing_helper_is_reported_and_ended(failure: str, error: type[Exception], message: str):
    make = functools.partial(FailsElsewhere, home=os.getpid(), failure=failure)
    evaluators = Evaluators(make, CONFIG)
    with pytest.raises(error, match=message):
        evaluators.run(None, EPISODES, 0)
    assert not helpers()
    evaluators.close()


def test_an_interrupt_ends_the_helpers():
    def interrupted() -> None:
        raise KeyboardInterrupt

    evaluators = Evaluators(PointMass, CONFIG)
    with pytest.raises(KeyboardInterrupt):
        evaluators.run(None, EPISODES, 0, interrupted)
    assert not helpers()
    evaluators.close()


def test_a_helper_that_is_gone_is_reported():
    evaluators = Evaluators(PointMass, CONFIG)
    evaluators.run(None, EPISODES, 0)
    [helper] = helpers()
    helper.kill()
    helper.join()
    with pytest.raises(RuntimeError, match="A worker process died"):
        evaluators.run(None, EPISODES, 0)
    assert not helpers()
    evaluators.close()
