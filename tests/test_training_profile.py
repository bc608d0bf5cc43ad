"""The profile of a training: clocks of tasks, what is made of them, and a short run."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from fake_task import PointMass
from short_runs import BASE, SMALL_PPO

from dora.agents.runs import training_profile
from dora.agents.runs.training_profile import EVERY, ClockedTasks, Clocks, profile_training
from dora.errors import InputError
from dora.sim import StepProfile


class Simulated(PointMass):
    """A point mass with something that a profile can be put on."""

    def __init__(self, num_envs: int):
        super().__init__(num_envs)
        self.scene: Any = SimpleNamespace(px=SimpleNamespace(profile=None))


class Slow:
    """A task whose steps take 2 s of processor time and 4 s by the clock, 1 s of it in PhysX, and its resets 3 s."""

    def __init__(self, now: SimpleNamespace):
        self.now, self.scene = now, SimpleNamespace(px=SimpleNamespace(profile=None))

    def step(self, action: str) -> str:
        self.now.used += 2
        self.now.passed += 4
        self.scene.px.profile.seconds["physics"] += 1
        self.scene.px.profile.seconds["read"] += 0.5
        return action * 2

    def reset(self) -> str:
        self.now.used += 3
        self.now.passed += 3
        return "first"


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Processor time that was used, and time that has passed [s]."""
    now = SimpleNamespace(used=100.0, passed=500.0)
    clock = SimpleNamespace(process_time=lambda: now.used, perf_counter=lambda: now.passed)
    monkeypatch.setattr(training_profile, "time", clock)
    return now


def test_a_tasks_clocks_run_from_its_first_step_on(now: SimpleNamespace, tmp_path: Path):
    task = ClockedTasks(lambda count: Slow(now), tmp_path, StepProfile)(4)  # pyright: ignore[reportArgumentType]
    assert task.reset() == "first"
    now.used += 50  # before training
    for _ in range(EVERY):
        assert task.step("ab") == "abab"
        now.used += 0.25  # the policy
    task.scene = SimpleNamespace(px=SimpleNamespace(profile=None))  # built anew
    task.reset()
    for _ in range(EVERY):
        task.step("ab")
    (path,) = tmp_path.iterdir()
    found = Clocks(**json.loads(path.read_text()))
    steps, inside = 2 * EVERY, 8 * EVERY + 3
    assert found.environment == 2 * steps + 3
    assert found.acting == 0.25 * EVERY
    share = found.environment / inside  # of the time inside in which it had a core
    assert found.physics == pytest.approx(share * steps)
    assert found.contacts == pytest.approx(share * steps / 2)


def test_shares_are_of_the_main_process_and_of_all_workers():
    spent = {"collect": 10.0, "learn": 5.0, "evaluate": 4.0}
    moments, clocks = ((10.0, 3.0), (30.0, 37.0)), [Clocks(4.0, 2.0, 8.0, 1.0), Clocks(6.0, 2.0, 12.0, 3.0)]
    found = training_profile._summed(replace(BASE, workers=2), 4000, spent, moments, clocks, 2)
    assert (found.env, found.agent, found.steps) == ("Fake-v1", "ppo", 4000)
    assert (found.seconds, found.steps_per_second, found.busy_cores, found.cores) == (20.0, 200.0, 1.7, 2)
    assert (found.collecting, found.learning, found.evaluating) == (0.5, 0.25, 0.2)
    assert found.saving == pytest.approx(0.05)
    assert (found.physics, found.contacts, found.environment, found.acting) == (0.25, 0.1, pytest.approx(0.15), 0.1)
    assert found.waiting == pytest.approx(0.4)


def test_a_short_run_is_profiled_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(training_profile.tempfile, "tempdir", str(tmp_path))
    config = replace(BASE, workers=1, eval_every=512, eval_envs=2, learner=SMALL_PPO)
    found = profile_training(config, Simulated, StepProfile, 1024, 2)
    assert (found.env, found.agent, found.steps) == ("Fake-v1", "ppo", 1024)
    main = found.collecting, found.learning, found.evaluating, found.saving
    assert sum(main) == pytest.approx(1.0)
    assert min(main) > 0  # the time of the last evaluation, which is as long as the training, is left out
    assert 0 < found.environment < 1
    assert 0 < found.acting < 1
    assert found.busy_cores > 0
    assert list(tmp_path.iterdir()) == []


def test_a_training_without_workers_is_refused():
    with pytest.raises(InputError, match="workers is 0: give 1 or more"):
        profile_training(replace(BASE, workers=0, learner=SMALL_PPO), PointMass, StepProfile, 512, 2)


@pytest.mark.parametrize("steps", [511, training_profile.MOST_STEPS + 1])
def test_too_few_and_too_many_steps_are_refused(steps: int):
    config = replace(BASE, workers=1, learner=SMALL_PPO)
    with pytest.raises(InputError, match=f"--steps is {steps}: give a number from 512"):
        profile_training(config, PointMass, StepProfile, steps, 2)
