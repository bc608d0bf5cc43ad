"""Signals while a batch is collected or learned from: the run stops within a step, and what it saves is whole."""

import dataclasses
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_task import PointMass
from test_agents_multi import BOTH, batch_of, learner_of
from test_agents_train import BASE, SMALL_PPO, SMALL_SAC, run
from torch import Tensor

from dora.agents.checkpoint import pack_modules, pack_optimisers, read_checkpoint
from dora.agents.learners.learner import Learner
from dora.agents.learners.ppo import PPO
from dora.agents.learners.sac import SAC
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.trainer import Trainer

ROUND = 16 * 16
"""Transitions of a batch."""
LONG = {
    "ppo": dataclasses.replace(SMALL_PPO, epochs=10_000),
    "sac": dataclasses.replace(SMALL_SAC, rollout=16, updates_per_step=100.0, warmup=1, capacity=1000),
}
"""Settings with which learning from a batch takes minutes."""


def state(learner: Learner) -> dict[str, Tensor]:
    tensors = pack_modules(learner.modules) | pack_optimisers(learner.optimisers)
    return {name: value.clone() for name, value in tensors.items()}


def steps_taken(learner: Learner) -> dict[str, int]:
    """Gradient steps of each optimiser."""
    return {
        name: int(max((float(s["step"]) for s in one.state.values()), default=0))
        for name, one in learner.optimisers.items()
    }


@pytest.mark.parametrize(
    ("agent", "count"), [("ppo", 0), ("ppo", 3), *[(agent, count) for agent in BOTH for count in (0, 3, 9)]]
)
def test_a_learner_takes_no_step_after_it_is_stopped(agent: str, count: int):
    """A batch has one gradient step in each of four passes, of PPO, or of each of two agents and then of the critic."""
    torch.manual_seed(0)
    learner = learner_of(agent, epochs=4) if agent in BOTH else PPO(SMALL_PPO, 9, 4, 1000)
    batch, seen = batch_of(learner), float(learner.normaliser.count)
    assert not learner.update(batch, lambda: sum(steps_taken(learner).values()) >= count)
    assert sum(steps_taken(learner).values()) == count
    assert learner.normaliser.count == seen + batch.numel()  # the batch counts
    assert learner.counters()["steps"] == batch.numel()
    assert learner.update(batch)


def test_gradient_steps_of_sac_that_are_left_are_taken_later():
    learner = SAC(LONG["sac"], 9, 4, 1000)  # pyright: ignore[reportArgumentType]
    batch = batch_of(learner)
    for round_, updates in ((1, 5), (2, 12)):
        learner.update(batch, lambda most=updates: learner.updates >= most)
        assert (learner.updates, learner.due) == (updates, round_ * batch.numel() * 100.0 - updates)


def interrupt_after(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signal comes in the middle of a gradient step."""
    done = torch.optim.Adam.step
    count = [0]

    def step(self: Any, *args: Any, **kwargs: Any) -> Any:
        count[0] += 1
        if count[0] == steps:
            os.kill(os.getpid(), signal.SIGTERM)
        return done(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.Adam, "step", step)


@pytest.mark.parametrize("agent", ["ppo", "sac"])
def test_a_run_is_saved_between_two_gradient_steps_and_goes_on(
    tmp_path: Path, agent: str, monkeypatch: pytest.MonkeyPatch
):
    config = dataclasses.replace(BASE, agent=agent, learner=LONG[agent], total_steps=10**6)
    folder = RunFolder(tmp_path)
    folder.create(config)
    for half in (1, 2):
        trainer = Trainer(config, PointMass, folder, resume=half == 2)
        with monkeypatch.context() as patch:
            interrupt_after(20, patch)
            result = trainer.run()
        assert trainer.interrupted == signal.SIGTERM
        assert not result["finished"]
        stored = read_checkpoint(folder.latest)
        assert all(torch.equal(stored.tensors[name], value) for name, value in state(trainer.learner).items())
        assert stored.progress["env_steps"] == result["env_steps"] == trainer.counters.env_steps
        again = Trainer(config, PointMass, folder, resume=True)
        loaded = state(again.learner)
        assert all(torch.equal(loaded[name], value) for name, value in state(trainer.learner).items())
        assert again.learner.counters() == trainer.learner.counters()
        if isinstance(again.learner, SAC):  # every transition is in the buffer once, and none of its steps is lost
            assert again.learner.replay.added == result["env_steps"] == half * ROUND
            assert again.learner.updates + again.learner.due == half * ROUND * 100
        assert sum(steps_taken(again.learner).values()) in range(20 * half, 20 * half + 3)


class Signalled(PointMass):
    """A task during whose twentieth control step the signal comes."""

    steps = 0

    def step(self, action: Tensor) -> Any:
        Signalled.steps += 1
        if Signalled.steps == 20:
            os.kill(os.getpid(), signal.SIGINT)
        return super().step(action)


def test_a_batch_without_workers_stops_at_the_next_control_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Signalled, "steps", 0)
    config = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=10 * ROUND)
    result = run(tmp_path / "run", config, Signalled)
    assert Signalled.steps == 20
    assert (result["finished"], result["env_steps"]) == (False, ROUND)  # the batch that was begun does not count
    assert read_checkpoint(RunFolder(tmp_path / "run").latest).progress["env_steps"] == ROUND
    assert run(tmp_path / "run", config, resume=True)["finished"]
