"""The average of the policies of successive iterations, which evaluations run."""

import dataclasses
import functools
from pathlib import Path

import pytest
import torch
from fake_task import PointMass, TwoPoints
from short_runs import BASE, SMALL_PPO, run

from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import MAPPOConfig, PPOConfig
from dora.agents.learners.averaging import AveragedPolicy
from dora.agents.learners.networks import GaussianActor, Normaliser, Policy
from dora.agents.runs.run_folder import RunFolder

AVERAGED = dataclasses.replace(SMALL_PPO, average=0.75)


def policy() -> Policy:
    return Policy(Normaliser(3), GaussianActor(3, 2, (4,), -0.5))


def test_the_average_follows_the_parameters_by_the_share_that_is_not_kept():
    learning = policy()
    average = AveragedPolicy(learning, 0.75)
    expected = {name: value.clone() for name, value in learning.actor.named_parameters()}
    for shift in (1.0, -3.0):
        with torch.no_grad():
            for value in learning.actor.parameters():
                value.add_(shift)
        average.follow()
        for name, value in learning.actor.named_parameters():
            expected[name] = 0.75 * expected[name] + 0.25 * value
    for name, value in average.policy.actor.named_parameters():
        torch.testing.assert_close(value, expected[name])
    assert average.policy.normaliser is learning.normaliser
    assert list(average.modules) == ["averaged"]


def test_without_a_share_the_average_is_the_policy_itself():
    learning = policy()
    average = AveragedPolicy(learning, 0.0)
    average.follow()
    assert average.policy is learning
    assert average.modules == {}


@pytest.mark.parametrize("agent", ["ppo", "mappo"])
def test_runs_keep_the_average_and_resume_it(tmp_path: Path, agent: str):
    """The latest checkpoint has both policies, the best one the average; a run in two halves ends with the same."""
    settings = PPOConfig if agent == "ppo" else MAPPOConfig
    learner = settings(**{f.name: getattr(AVERAGED, f.name) for f in dataclasses.fields(PPOConfig)})
    config = dataclasses.replace(
        BASE, agent=agent, learner=learner, total_steps=4 * 256, eval_every=4 * 256, stagger=False
    )
    make = functools.partial(PointMass if agent == "ppo" else TwoPoints, deterministic=True)
    run(tmp_path / "straight", config, make)
    straight, halves = (RunFolder(tmp_path / name) for name in ("straight", "halves"))
    run(halves.path, dataclasses.replace(config, total_steps=2 * 256), make)
    before = read_checkpoint(halves.latest).tensors
    run(halves.path, config, make, resume=True)
    tensors, resumed = (read_checkpoint(folder.latest).tensors for folder in (straight, halves))
    best = read_checkpoint(straight.best).tensors
    averaged = {name.partition("/")[2]: value for name, value in tensors.items() if name.startswith("averaged/")}
    assert averaged
    for name, value in averaged.items():
        assert torch.equal(best[f"actor/{name}"], value), name
        assert torch.equal(resumed[f"averaged/{name}"], value), name
    assert any(not torch.equal(tensors[f"actor/{name}"], value) for name, value in averaged.items())
    assert any(not torch.equal(before[f"averaged/{name}"], value) for name, value in averaged.items())
