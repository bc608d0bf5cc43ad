"""Small numbers that learners compute, worked out by hand: norms, rates, advantages, noise, and what they log."""

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from test_agents_multi import AGENTS, SIZES, batch_of, learner_of
from test_learner_benchmark import config_of

from dora.agents.config import HAPPOConfig, MAPPOConfig, PPOConfig, RunConfig, SACConfig
from dora.agents.learners import benchmark
from dora.agents.learners.benchmark import made_up_batch, measure
from dora.agents.learners.finite import check_loss, check_tensors
from dora.agents.learners.learner import agents_of
from dora.agents.learners.networks import GaussianActor, LatestOutput, Normaliser, Policy, TanhActor, last_layer
from dora.agents.learners.plain_torch import PlainPPO, PlainSAC, plain_batch
from dora.agents.learners.ppo import PPO, adapted, excess, squared, standardised, transitions
from dora.agents.learners.sac import SAC
from dora.errors import RunFailure

# ------------------------------------------------------------------------ networks


def test_components_that_never_change_stay_finite_and_all_are_bounded():
    normaliser = Normaliser(2)
    normaliser.update(torch.tensor([[3.0, -1.0], [3.0, 1.0]]))
    torch.testing.assert_close(normaliser.scale, torch.tensor([100.0, 1 / math.sqrt(1.0001)]))
    out = normaliser(torch.tensor([[3.01, 1e6], [3.0, -1e6]]))
    torch.testing.assert_close(out, torch.tensor([[1.0, 6.0], [0.0, -6.0]]), atol=1e-3, rtol=0)


def test_a_normaliser_stops_at_its_number_of_rows():
    normaliser = Normaliser(1, max_count=4)
    for rows, frozen in ((3, False), (1, True)):
        assert not normaliser.frozen
        normaliser.update(torch.ones(rows, 1))
        assert normaliser.frozen == frozen


def test_a_greedy_action_has_the_log_probability_zero_and_saturated_ones_are_finite():
    features = torch.zeros(3, 2)
    gaussian, tanh = GaussianActor(2, 1, (4,), -0.7), TanhActor(2, 1, (4,), -0.7)
    for actor in (gaussian, tanh):
        assert actor.act(features, None)[1].tolist() == [0.0] * 3
        assert actor.action_size == 1
    action, log_prob = tanh.act(features, torch.full((3, 1), 100.0))
    assert (action == 1).all()
    assert log_prob.isfinite().all()
    with torch.no_grad():
        last_layer(gaussian.mean).bias.fill_(0.5)
        last_layer(tanh.net).bias[:1] = 0.5
    torch.testing.assert_close(gaussian.act(features, None)[0], torch.full((3, 1), 0.5), atol=0.05, rtol=0)
    torch.testing.assert_close(tanh.act(features, None)[0], torch.full((3, 1), math.tanh(0.5)), atol=0.05, rtol=0)


def test_the_noise_of_a_tanh_actor_is_between_its_bounds():
    actor = TanhActor(2, 1, (4,), -1.1)
    for raw, log_std in ((2.0, -1.1 - math.log1p(math.exp(-2.0))), (-50.0, -4.0), (50.0, -1.1)):
        with torch.no_grad():
            last_layer(actor.net).weight.zero_()
            last_layer(actor.net).bias[1:] = raw
        assert actor(torch.zeros(1, 2))[1].item() == pytest.approx(math.exp(log_std), rel=1e-5)


def test_noise_begins_anew_where_the_number_of_rows_changes():
    policy = Policy(Normaliser(2), GaussianActor(2, 1, (4,), 0.0), noise_correlation=0.9)
    for rows in (4, 3, 3, 5):
        assert policy(TensorDict({"observation": torch.zeros(rows, 2)}, [rows]))["action"].shape == (rows, 1)


def test_what_a_hook_keeps_is_the_latest_output():
    hook = LatestOutput()
    assert hook.mean.numel() == hook.std.numel() == 0
    actor = GaussianActor(2, 1, (4,), -0.5)
    actor.register_forward_hook(hook)
    mean, std = actor(torch.ones(3, 2))
    assert hook.mean is mean
    assert hook.std is std


# ----------------------------------------------------------------------------- PPO


def test_advantages_get_the_mean_zero_and_the_deviation_one_and_small_ones_stay_small():
    torch.testing.assert_close(standardised(torch.tensor([[1.0], [5.0]])), torch.tensor([[-1.0], [1.0]]))
    small = standardised(torch.tensor([[-1e-6], [1e-6]]))
    torch.testing.assert_close(small, torch.tensor([[-0.5], [0.5]]))
    assert standardised(torch.ones(3, 1)).tolist() == [[0.0]] * 3


def test_penalties_of_mean_actions_are_sums_over_components_and_means_over_transitions():
    mean = torch.tensor([[2.0, -3.0], [0.5, -1.0]])
    assert excess(mean).item() == pytest.approx((1 + 4 + 0) / 2)
    assert squared(mean).item() == pytest.approx((4 + 9 + 0.25 + 1) / 2)


@pytest.mark.parametrize(
    ("rate", "divergence", "wanted"),
    [
        (1e-3, 0.021, 1e-3 / 1.3), (1e-3, 0.019, 1e-3), (1e-3, 0.0051, 1e-3), (1e-3, 0.0049, 1.2e-3),
        (1.1e-4, 0.021, 1e-4), (1.9e-3, 0.0, 2e-3), (1e-3, -0.5, 1.2e-3),
    ],
)  # fmt: skip
def test_the_learning_rate_follows_the_divergence_within_its_bounds(rate: float, divergence: float, wanted: float):
    config = PPOConfig(target_kl=0.01, learning_rate_min=1e-4, learning_rate_max=2e-3)
    assert adapted(rate, divergence, config) == pytest.approx(wanted)


def test_explained_variance_compares_targets_with_values():
    """With gamma 0 and done episodes the target is the reward."""
    config = PPOConfig(gamma=0.0, hidden=(8,))
    ppo = PPO(config, *SIZES, 1000)
    batch = batch_of(ppo)
    with torch.no_grad():
        torch.nn.init.normal_(last_layer(ppo.critic.net).weight, std=0.1)
        value = ppo.critic(ppo.normaliser(batch["observation"]))
    data = transitions(batch, ppo.normaliser, ppo.critic, config)
    reward = batch["next", "reward"]
    wanted = 1 - float((reward - value).var()) / float(reward.var())
    assert float(data["explained"][0]) == pytest.approx(wanted, rel=1e-4)
    torch.testing.assert_close(data["value_target"], reward.flatten(0, 1))
    with torch.no_grad():
        batch["next", "reward"] = value + 0.5
    assert float(transitions(batch, ppo.normaliser, ppo.critic, config)["explained"][0]) == pytest.approx(1, abs=1e-4)


def test_what_ppo_logs_of_its_policy_is_that_of_the_policy():
    ppo = PPO(PPOConfig(hidden=(8,), learning_rate=1e-9, learning_rate_min=1e-9, log_std=-0.5), *SIZES, 1000)
    with torch.no_grad():
        last_layer(ppo.actor.mean).weight.zero_()
        last_layer(ppo.actor.mean).bias.fill_(1.5)
    values = ppo.update(batch_of(ppo))
    entropy = SIZES[1] * (-0.5 + 0.5 * math.log(2 * math.pi * math.e))
    assert values["entropy"] == pytest.approx(entropy, rel=1e-4)
    assert values["bound"] == pytest.approx(SIZES[1] * 0.25, rel=1e-4)
    assert values["correction"] == pytest.approx(1.5, rel=1e-4)
    assert values["action_std"] == pytest.approx(math.exp(-0.5), rel=1e-4)
    assert values["kl"] == pytest.approx(0, abs=1e-4)
    assert values["learning_rate"] == ppo.learning_rate == pytest.approx(1.2e-9)
    ppo.set_counters({"learning_rate": 3e-4})  # of a version that counted no steps
    assert (ppo.steps, ppo.optimiser.param_groups[0]["lr"]) == (0.0, 3e-4)


def test_the_noise_never_grows_beyond_the_range_of_actions_and_not_below_its_least():
    for start, least, wanted in ((0.5, -3.0, 0.0), (-2.0, -1.0, -1.0)):
        ppo = PPO(PPOConfig(hidden=(8,), log_std_min=least), *SIZES, 1000)
        learner = learner_of(log_std_min=least)
        with torch.no_grad():
            for actor in (ppo.actor, *(learner.actor.of(name) for name in AGENTS)):
                actor.log_std.fill_(start)
        ppo.update(batch_of(ppo))
        learner.update(batch_of(learner))
        for actor in (ppo.actor, *(learner.actor.of(name) for name in AGENTS)):
            torch.testing.assert_close(actor.log_std, torch.full_like(actor.log_std, wanted), atol=0.05, rtol=0)
            assert actor.log_std.max() <= 0.0
            assert actor.log_std.min() >= least


def test_the_loss_of_the_value_of_several_agents_is_its_mean_error():
    learner = learner_of(value=2.0, learning_rate=1e-9, learning_rate_min=1e-9)
    batch = batch_of(learner)
    data = transitions(batch, learner.normaliser, learner.critic, learner.config)
    with torch.no_grad():
        wanted = 2.0 * (learner.critic(data["features"]) - data["value_target"]).square().mean()
    values = learner.update(batch)
    assert values["value"] == pytest.approx(float(wanted), rel=1e-3)
    assert values["explained_variance"] == pytest.approx(float(data["explained"][0]), rel=1e-4)
    for name, own in AGENTS.items():
        entropy = len(own.action) * (learner.config.log_std + 0.5 * math.log(2 * math.pi * math.e))
        assert values[f"entropy/{name}"] == pytest.approx(entropy, rel=1e-4)


# ----------------------------------------------------------------------------- SAC


def test_what_sac_logs_of_its_policy_is_that_of_the_policy():
    """Of an actor whose mean is 0.5 before the tanh and whose noise is small there: entropy of the squashed normal."""
    config = SACConfig(
        batch=256, updates_per_step=0.1, warmup=1, critic_only=0, hidden=(16, 16), learning_rate_actor=1e-12,
        learning_rate_alpha=1e-12, alpha=0.125, log_std_max=-2.0,
    )  # fmt: skip
    torch.manual_seed(0)
    sac = SAC(config, *SIZES, 1000)
    with torch.no_grad():
        for parameter in sac.actor_parameters[-2:]:
            parameter.zero_()
        sac.actor_parameters[-1][: SIZES[1]] = 0.5
        sac.actor_parameters[-1][SIZES[1] :] = 20.0
    values = sac.update(batch_of(sac))
    squash = math.log(1 - math.tanh(0.5) ** 2)
    wanted = SIZES[1] * (0.5 * math.log(2 * math.pi * math.e) - 2.0 + squash)
    assert values["entropy"] == pytest.approx(wanted, abs=0.3)
    assert values["alpha"] == pytest.approx(0.125, rel=1e-4)
    assert values["action_std"] == pytest.approx(math.exp(-2.0), rel=1e-4)
    assert values["correction"] == pytest.approx(math.tanh(0.5), rel=1e-4)
    assert (values["updates"], values["replay"]) == (12.0, 128.0)  # of 128 transitions a tenth
    assert sac.counters() == {"updates": 12.0, "due": pytest.approx(0.8), "added": 128.0}
    again = SAC(config, *SIZES, 1000)
    again.set_counters(sac.counters())
    assert again.counters() == sac.counters()


def test_before_its_warm_up_sac_only_stores():
    sac = SAC(SACConfig(warmup=129, hidden=(8,), updates_per_step=1.0), *SIZES, 1000)
    batch = batch_of(sac)
    assert sac.update(batch) == {"replay": 128.0}
    assert sac.counters() == {"updates": 0.0, "due": 0.0, "added": 128.0}


# ------------------------------------------------------------------- plain torch, speed


def test_the_update_in_plain_torch_says_how_many_steps_it_took():
    config = config_of("ppo", minibatch=48, epochs=3)
    ppo = PPO(config.learner, *SIZES, 1000)
    ppo.update(made_up_batch(config, *SIZES))
    assert PlainPPO(ppo).update(plain_batch(made_up_batch(config, *SIZES, 1))) == 3 * 3  # of 128: 48, 48, 32
    config = config_of("sac", warmup=200, updates_per_step=1 / 8, batch=16)
    plain = PlainSAC(SAC(config.learner, *SIZES, 1000), *SIZES)
    batch = plain_batch(made_up_batch(config, *SIZES))
    assert [plain.update(batch) for _ in range(3)] == [0, 16, 16]


def test_a_batch_that_is_made_up_has_the_shape_and_the_numbers_of_one():
    config = RunConfig("x", "ppo", num_envs=50, workers=3, learner=PPOConfig(rollout=40))
    batch = made_up_batch(config, 5, 2)
    assert batch.shape == (150, 40)
    assert made_up_batch(RunConfig("x", "ppo", num_envs=8, workers=0, learner=PPOConfig(rollout=4)), 5, 2).shape == (
        8,
        4,
    )
    action = batch["action"]
    assert action.abs().max() < 1
    assert float(action.std()) == pytest.approx(0.3, rel=0.02)
    log_prob = (-0.5 * (action / 0.3).square() - math.log(0.3 * math.sqrt(2 * math.pi))).sum(-1)
    torch.testing.assert_close(batch["action_log_prob"], log_prob)
    assert float(batch["next", "done"].float().mean()) == pytest.approx(0.01, rel=0.3)
    assert not batch["next", "terminated"].any()
    assert torch.equal(made_up_batch(config, 5, 2)["observation"], batch["observation"])


def test_the_best_turn_of_each_side_counts(monkeypatch: pytest.MonkeyPatch):
    rates, warm = iter([1.0, 10.0, 3.0, 40.0, 2.0, 20.0]), list[int]()

    def timed(update: Any, seconds: float, before: int) -> float:
        warm.append(before)
        return next(rates)

    monkeypatch.setattr(benchmark, "_updates_per_second", timed)
    speed = measure(config_of("ppo", minibatch=48, epochs=2), *SIZES, 1.0)
    assert warm == [2, 2, 0, 0, 0, 0]
    steps = 2 * 3
    assert (speed.updates_per_second, speed.reference_updates_per_second) == (3.0 * steps, 40.0 * steps)
    assert speed.ratio == pytest.approx(3 / 40)
    assert speed.samples_per_second == 3.0 * steps * 48


def test_updates_are_counted_until_the_time_is_over(monkeypatch: pytest.MonkeyPatch):
    clock, calls = iter(range(10, 100)), list[int]()
    monkeypatch.setattr(benchmark.time, "perf_counter", lambda: float(next(clock)))
    rate = benchmark._updates_per_second(lambda: calls.append(1), 3.0, 2)
    assert len(calls) == 4  # two of them before the time is taken
    assert rate == pytest.approx(2 / 3)


# ---------------------------------------------------------------------------- checks


def test_agents_are_told_apart_by_learners_of_several_alone():
    two, one = AGENTS, {"left": AGENTS["left"]}
    mappo, happo, ppo = (
        RunConfig("x", name, learner=settings)
        for name, settings in (("mappo", MAPPOConfig()), ("happo", HAPPOConfig()), ("ppo", PPOConfig()))
    )
    assert agents_of(mappo, two) == agents_of(happo, two) == two
    assert agents_of(ppo, two) == agents_of(mappo, one) == agents_of(happo, {}) == {}


def test_one_number_that_is_not_finite_is_enough():
    check_loss("loss", torch.ones(3))
    check_tensors({"a": torch.ones(2), "b": torch.arange(2)})
    with pytest.raises(RunFailure, match="the loss is inf"):
        check_loss("loss", torch.tensor([1.0, math.inf]))
    with pytest.raises(RunFailure, match="b contains NaN"):
        check_tensors({"a": torch.ones(2), "b": torch.tensor([1.0, math.nan])})
