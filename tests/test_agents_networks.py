"""Normaliser, policies and advantages against hand computations."""

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dora.agents.config import PPOConfig, SACConfig
from dora.agents.learners.networks import GaussianActor, Normaliser, Policy, TanhActor
from dora.agents.learners.ppo import PPO, advantages
from dora.agents.learners.sac import SAC


def test_normaliser_agrees_with_numpy():
    rng = np.random.default_rng(0)
    parts = [rng.normal(3.0, 2.0, (n, 5)).astype(np.float32) for n in (7, 100, 1)]
    normaliser = Normaliser(5)
    for part in parts:
        normaliser.update(torch.from_numpy(part))
    rows = np.concatenate(parts)
    np.testing.assert_allclose(normaliser.mean, rows.mean(0), rtol=1e-6)
    np.testing.assert_allclose(normaliser.var, rows.var(0), rtol=1e-6)
    out = normaliser(torch.from_numpy(rows)).numpy()
    np.testing.assert_allclose(out.std(0), 1.0, rtol=1e-3)
    assert normaliser(torch.full((1, 5), 1e6)).max() == 6.0


def test_normaliser_freezes():
    normaliser = Normaliser(2, max_count=10)
    normaliser.update(torch.randn(10, 2))
    before = normaliser.mean.clone()
    normaliser.update(torch.randn(10, 2) + 100)
    assert normaliser.frozen
    assert torch.equal(normaliser.mean, before)


def test_new_policies_start_near_zero_and_greedy_draws_nothing():
    observation = torch.randn(32, 6)
    for actor in (GaussianActor(6, 3, (64, 32), -0.7), TanhActor(6, 3, (64, 32), -0.7)):
        policy = Policy(Normaliser(6), actor)
        data = TensorDict({"observation": observation}, [32])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            greedy = policy(data)["action"]
        assert greedy.abs().max() < 0.2
        assert torch.equal(greedy, policy.greedy(observation))
        sampled = policy(data)["action"]
        assert (sampled - greedy).std() > 0.2


def test_log_probabilities_agree_with_torch():
    observation = torch.randn(16, 6)
    gaussian, tanh = GaussianActor(6, 3, (8,), -0.7), TanhActor(6, 3, (8,), -0.7)
    noise = torch.randn(16, 3)
    mean, std = gaussian(observation)
    action, log_prob = gaussian.act(observation, noise)
    torch.testing.assert_close(log_prob, torch.distributions.Normal(mean, std).log_prob(action).sum(-1))
    mean, std = tanh(observation)
    action, log_prob = tanh.act(observation, noise)
    squashed = torch.distributions.TransformedDistribution(
        torch.distributions.Normal(mean, std), torch.distributions.TanhTransform()
    )
    torch.testing.assert_close(log_prob, squashed.log_prob(action).sum(-1), rtol=1e-3, atol=1e-3)


def test_correlated_noise_has_unit_variance_and_the_asked_correlation():
    torch.manual_seed(0)
    policy = Policy(Normaliser(2), GaussianActor(2, 1, (4,), 0.0), noise_correlation=0.8)
    data = TensorDict({"observation": torch.zeros(512, 2)}, [512])
    noise = torch.stack([policy(data)["action"][:, 0] for _ in range(200)])
    noise = noise - noise.mean()
    assert abs(noise.var() - 1) < 0.05
    assert abs((noise[1:] * noise[:-1]).mean() / noise.var() - 0.8) < 0.02


def test_only_critics_that_bootstrap_from_themselves_are_normalised():
    """Layer normalisation keeps SAC's targets from running away; PPO's are returns (docs/agents.md)."""
    ppo, sac = PPO(PPOConfig(), 4, 2, 1000), SAC(SACConfig(), 4, 2, 1000)
    linear, normalised = 2 * 3, 2 * 3 + 2 * 2  # weights and biases of three layers, and of two that normalise
    assert len(list(ppo.critic.parameters())) == linear
    assert len(sac.critic_parameters) == normalised


def test_truncation_bootstraps_from_the_last_observation_and_termination_does_not():
    gamma, lam = 0.9, 0.5
    value = torch.tensor([[[1.0], [2.0], [3.0]]]).expand(2, 3, 1)
    following = torch.tensor([[[2.0], [7.0], [4.0]]]).expand(2, 3, 1)  # 7: value of the true last observation
    reward = torch.ones(2, 3, 1)
    done = torch.tensor([[[False], [True], [False]]]).expand(2, 3, 1)
    terminated = torch.zeros(2, 3, 1, dtype=torch.bool)
    terminated[1, 1] = True
    advantage, target = advantages(gamma, lam, value, following, reward, done, terminated)
    for row, last in ((0, 1 + gamma * 7 - 2), (1, 1.0 - 2)):
        first = 1 + gamma * 2 - 1 + gamma * lam * last
        expected = torch.tensor([[first], [last], [1 + gamma * 4 - 3]])
        torch.testing.assert_close(advantage[row], expected)
        torch.testing.assert_close(target[row], expected + value[row])
