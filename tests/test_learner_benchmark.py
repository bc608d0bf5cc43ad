"""The updates in plain torch are those of the learners, and both are timed."""

import copy
import json
from typing import Any

import pytest
import torch
from commands import call

from dora.agents.config import PPOConfig, RunConfig, SACConfig
from dora.agents.learners import benchmark
from dora.agents.learners.benchmark import made_up_batch, measure
from dora.agents.learners.plain_torch import PlainPPO, PlainSAC, plain_batch
from dora.agents.learners.ppo import PPO
from dora.agents.learners.sac import SAC
from dora.commands import bench
from dora.errors import InputError

SIZES = (7, 3)
SMALL: dict[str, Any] = {"hidden": (16, 16)}


def config_of(agent: str, **learner: Any) -> RunConfig:
    kind: Any = PPOConfig if agent == "ppo" else SACConfig
    return RunConfig("x", agent, num_envs=8, workers=0, learner=kind(**SMALL | {"rollout": 16} | learner))


def largest_difference(ours: torch.nn.Module, theirs: torch.nn.Module) -> float:
    other = dict(theirs.named_parameters())
    return max(float((value - other[name]).abs().max()) for name, value in ours.named_parameters())


def test_ppo_in_plain_torch_takes_the_same_steps():
    """With a pull and a ceiling of the noise that fall meanwhile; a batch has 128 transitions."""
    schedules = {"prior": 0.05, "prior_last": 1e-3, "prior_steps": 600, "log_std_last": -1.5, "log_std_steps": 400}
    config = config_of("ppo", minibatch=48, entropy=1e-2, **schedules)
    torch.manual_seed(0)
    ppo = PPO(config.learner, *SIZES, 1000)
    ppo.update(made_up_batch(config, *SIZES))
    plain, first = PlainPPO(ppo), copy.deepcopy(ppo.actor.mean)
    for seed in range(1, 4):
        batch = made_up_batch(config, *SIZES, seed)
        for one, data in ((ppo, batch.clone()), (plain, plain_batch(batch))):
            torch.manual_seed(seed)
            one.update(data)
    assert largest_difference(ppo.actor.mean, plain.actor.mean) < 1e-5 < largest_difference(ppo.actor.mean, first)
    assert largest_difference(ppo.critic, plain.critic) < 1e-5
    assert float((ppo.actor.log_std - plain.actor.log_std).abs().max()) < 1e-6
    assert ppo.learning_rate == plain.learning_rate != config.learner.learning_rate


def test_sac_in_plain_torch_takes_the_same_steps():
    """With a pull and learning rates that fall meanwhile."""
    pull = {"prior": 0.5, "prior_last": 1e-3, "prior_steps": 600}
    rates = {"learning_rate_last": 0.1, "learning_rate_steps": 500}
    config = config_of("sac", warmup=64, critic_only=4, updates_per_step=1 / 8, batch=32, n_step=3, **pull, **rates)
    torch.manual_seed(0)
    sac = SAC(config.learner, *SIZES, 1000)
    plain, first = PlainSAC(sac, *SIZES), copy.deepcopy(sac.actor)
    for seed in range(1, 4):
        batch = made_up_batch(config, *SIZES, seed)
        for one, data in ((sac, batch.clone()), (plain, plain_batch(batch))):
            torch.manual_seed(seed)
            one.update(data)
    assert sac.updates == plain.updates == 48
    assert largest_difference(sac.actor, plain.actor) < 1e-4 < largest_difference(sac.actor, first)
    for k, critic in enumerate(plain.critics):
        for theirs, ours in zip(critic.parameters(), sac.critic_parameters, strict=True):
            torch.testing.assert_close(theirs, ours[k], atol=2e-4, rtol=1e-3)
    log_alpha: Any = sac.loss.log_alpha
    assert float(plain.log_alpha.detach()) == pytest.approx(float(log_alpha.detach()), abs=1e-5)


@pytest.mark.parametrize("agent", ["ppo", "sac"])
def test_both_are_timed(agent: str):
    learner = {"minibatch": 64} if agent == "ppo" else {"warmup": 64, "batch": 32, "updates_per_step": 1 / 32}
    speed = measure(config_of(agent, **learner), *SIZES, seconds=0.05)
    assert speed.ratio == pytest.approx(speed.updates_per_second / speed.reference_updates_per_second)
    assert speed.samples_per_second == pytest.approx(speed.updates_per_second * (64 if agent == "ppo" else 32))
    assert (speed.observation, speed.action, speed.transitions) == (*SIZES, 128)


def test_every_update_of_sac_that_is_counted_takes_all_its_steps(monkeypatch: pytest.MonkeyPatch):
    """Also with the settings of the tasks, whose warm-up is longer than the updates that are not counted."""
    learners, taken = list[SAC](), list[int]()

    def made(*given: Any) -> SAC:
        learners.append(SAC(given[0].learner, *given[1:], normaliser_samples=1000))
        return learners[0]

    def counted(update: Any, seconds: float, before: int) -> float:
        steps = learners[0].updates
        update()
        taken.append(learners[0].updates - steps)
        return 1.0

    monkeypatch.setattr(benchmark, "make_learner", made)
    monkeypatch.setattr(benchmark, "_updates_per_second", counted)
    speed = measure(config_of("sac", warmup=4000, critic_only=500, updates_per_step=1 / 8), *SIZES, 1.0)
    assert taken == [speed.transitions / 8, 0] * benchmark.TURNS  # the other side's updates are not the learner's
    assert speed.updates_per_second == speed.transitions / 8


def test_the_command_prints_the_agreed_keys(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    assert call(bench, monkeypatch, "learner", "--agent", "ppo", "--seconds", "0.1", "--json") == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    wanted = {"agent", "updates_per_second", "samples_per_second", "reference_updates_per_second", "ratio"}
    assert wanted <= set(found)
    assert found["updates_per_second"] > 0


def test_learners_without_a_reference_are_refused():
    with pytest.raises(InputError, match="There is no reference of happo: use --agent with one of ppo, sac"):
        bench.bench_learner("DoraCube-v1", "happo", 0.1)
