"""The pull of mean actions towards no correction, the ceiling of the noise, and learning rates over a run."""

import pytest
import torch
from test_agents_multi import SETTINGS, SIZES, batch_of, learner_of

from dora.agents.config import PPOConfig, SACConfig
from dora.agents.learners.networks import last_layer
from dora.agents.learners.ppo import PPO
from dora.agents.learners.schedules import loudest, pull, rates_left
from dora.agents.runs.recommended import recommended


def test_it_falls_geometrically_with_the_steps():
    config = SACConfig(prior=0.05, prior_last=0.0005, prior_steps=1000)
    assert [pull(config, steps) for steps in (0.0, 500.0, 1000.0, 5000.0)] == pytest.approx(
        [0.05, 0.005, 0.0005, 0.0005]
    )
    assert pull(SACConfig(prior=0.05), 5000.0) == 0.05
    assert pull(SACConfig(prior=0.0, prior_last=0.01), 0.0) == 0.0  # of runs that have no prior


def test_learning_rates_of_sac_fall_evenly_after_a_third_of_the_steps():
    config = SACConfig(learning_rate_last=0.1, learning_rate_steps=900)
    assert [rates_left(config, steps) for steps in (0.0, 300.0, 600.0, 900.0, 5000.0)] == pytest.approx(
        [1.0, 1.0, 0.55, 0.1, 0.1]
    )
    assert rates_left(SACConfig(), 1e6) == 1.0


def test_the_prior_pulls_mean_actions_to_no_correction():
    """Where the advantage tells nothing, corrections shrink with it and stay as they are without it. That agents do as
    PPO does is shown by `test_one_agent_is_ppo`."""
    sizes = []
    for prior in (0.0, 0.5):
        torch.manual_seed(0)
        ppo = PPO(PPOConfig(**SETTINGS, prior=prior, entropy=0.0), *SIZES, 1000)
        with torch.no_grad():
            last_layer(ppo.actor.mean).bias.fill_(0.5)
        batch = batch_of(ppo)
        batch["next", "reward"] = torch.zeros_like(batch["next", "reward"])
        with torch.no_grad():
            last_layer(ppo.critic.net).weight.zero_()
            last_layer(ppo.critic.net).bias.zero_()
        sizes.append([ppo.update(batch)["correction"] for _ in range(4)][-1])
    assert sizes[0] == pytest.approx(0.5, abs=0.02)
    assert sizes[1] < 0.95 * sizes[0]


def test_the_pull_of_ppo_and_of_each_agent_falls_with_the_steps_and_is_resumed():
    settings = {**SETTINGS, "prior": 0.02, "prior_last": 0.0002, "prior_steps": 1}
    means = []
    for last in (0.0002, 200.0):
        torch.manual_seed(0)
        ppo = PPO(PPOConfig(**{**settings, "prior_last": last}), *SIZES, 1000)
        batch = batch_of(ppo)
        ppo.update(batch)
        assert ppo.counters()["steps"] == batch.numel()
        means.append(ppo.update(batch)["correction"])
    assert means[1] < 0.9 * means[0]
    again = PPO(PPOConfig(**settings), *SIZES, 1000)
    again.set_counters(ppo.counters())
    assert again.steps == ppo.steps
    learner = learner_of(**settings)
    assert {one.prior for one in learner.updates.values()} == {0.02}
    learner.update(batch_of(learner))
    assert [one.prior for one in learner.updates.values()] == pytest.approx([0.0002] * 2)
    other = learner_of(**settings)
    other.set_counters(learner.counters())
    assert other.steps == learner.steps == batch.numel()
    other.set_counters({})  # of a version that did not count
    assert other.steps == 0


def test_the_ceiling_of_the_noise_falls_evenly_with_the_steps():
    config = PPOConfig(log_std=-0.7, log_std_last=-1.7, log_std_steps=1000)
    assert [loudest(config, steps) for steps in (0.0, 500.0, 1000.0, 5000.0)] == pytest.approx([-0.7, -1.2, -1.7, -1.7])
    assert loudest(PPOConfig(log_std=-0.7), 5000.0) == 0.0


def test_the_noise_of_ppo_and_of_each_agent_stays_below_its_ceiling():
    """However much the bonus for entropy asks for more; twice the steps that the first batch has."""
    settings = {**SETTINGS, "entropy": 1.0, "log_std": -0.7, "log_std_last": -1.7}
    count = batch_of(PPO(PPOConfig(**SETTINGS), *SIZES, 1000)).numel()
    for steps, ceiling in ((2 * count, -1.2), (1, -1.7)):
        ppo = PPO(PPOConfig(**settings, log_std_steps=steps), *SIZES, 1000)
        learner = learner_of(**settings, log_std_steps=steps)
        for one in (ppo, learner):
            one.update(batch_of(one))
        for actor in (ppo.actor, *map(learner.actor.of, learner.agents)):
            torch.testing.assert_close(actor.log_std, torch.full_like(actor.log_std, ceiling))
    free = PPO(PPOConfig(**{**settings, "log_std_last": None}), *SIZES, 1000)
    free.update(batch_of(free))
    assert free.actor.log_std.min() > -0.71


def test_a_preset_may_have_settings_of_its_own():
    learners = {"sac": {"eval_envs": 7, "learner": {"gamma": 0.9}, "presets": {"hard": {"learner": {"prior": 0.01}}}}}
    usual, hard = (recommended("X-v1", "sac", learners, preset=name) for name in (None, "hard"))
    assert (usual.learner.prior, hard.learner.prior) == (0.05, 0.01)
    assert (usual.learner.gamma, hard.learner.gamma, hard.eval_envs, hard.preset) == (0.9, 0.9, 7, "hard")
    given = recommended("X-v1", "sac", learners, preset="hard", learner={"prior": 0.2})
    assert given.learner.prior == 0.2
    assert recommended("X-v1", "sac", learners, preset="hard", guidance="none").learner.prior == 0.0


def test_only_guided_runs_are_pulled():
    learners = {"ppo": {"learner": {"prior": 0.02}}}
    for agent in ("ppo", "happo"):
        guided, free = (recommended("X-v1", agent, learners, guidance=name).learner for name in ("affordance", "none"))
        assert (guided.prior, free.prior) == (0.02, 0.0)
