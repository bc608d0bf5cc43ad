"""Soft actor-critic: transitions over several steps, and what keeps a new actor at the prior."""

import pickle
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import SoftUpdate
from torchrl.objectives.utils import _vmap_func

from dora.agents.config import SACConfig
from dora.agents.learners.networks import TanhActor
from dora.agents.learners.sac import SAC, _leaves, multi_step
from dora.agents.runs.recommended import recommended

ROWS, LENGTH, OBSERVATION, ACTION = 4, 16, 3, 2
GAMMA = 0.9


def batch(done_share: float = 0.0, reward: float | None = None) -> TensorDict:
    """Random transitions; an episode that ends does so by failure or by its limit, alternately over the rows."""
    done = torch.rand(ROWS, LENGTH, 1) < done_share
    failing = (torch.arange(ROWS) % 2 == 0)[:, None, None]
    rewards = torch.randn(ROWS, LENGTH, 1) if reward is None else torch.full((ROWS, LENGTH, 1), reward)
    return TensorDict(
        {
            "observation": torch.randn(ROWS, LENGTH, OBSERVATION),
            "action": torch.rand(ROWS, LENGTH, ACTION) * 2 - 1,
            "next": {
                "observation": torch.randn(ROWS, LENGTH, OBSERVATION),
                "reward": rewards,
                "done": done,
                "terminated": done & failing,
            },
        },
        batch_size=[ROWS, LENGTH],
    )


def by_hand(data: TensorDict, row: int, first: int, steps: int) -> tuple[Tensor, int]:
    """Discounted sum of rewards and index of the last step, walked one step at a time."""
    total, t = torch.zeros(1), first
    for k in range(steps):
        t = first + k
        total = total + GAMMA**k * data["next", "reward"][row, t]
        if data["next", "done"][row, t] or t == LENGTH - 1:
            break
    return total, t


def test_multi_step_agrees_with_walking_the_episodes():
    torch.manual_seed(0)
    for steps in (1, 5, 3 * LENGTH):
        data = batch(done_share=0.2)
        assert data["next", "terminated"].any()
        assert (data["next", "done"] & ~data["next", "terminated"]).any()
        before = data.clone()
        out = multi_step(data, steps, GAMMA)
        for row in range(ROWS):
            for t in range(LENGTH):
                total, last = by_hand(before, row, t, steps)
                torch.testing.assert_close(out["next", "reward"][row, t], total)
                assert int(out["steps_to_next_obs"][row, t]) == last - t + 1
                for name in ("observation", "done", "terminated"):
                    assert torch.equal(out["next", name][row, t], before["next", name][row, last]), name
        assert torch.equal(out["observation"], before["observation"])
        assert (data == before).all(), "the collector's memory was changed"


def small(**settings: float) -> SAC:
    torch.manual_seed(0)
    config = SACConfig(batch=32, updates_per_step=1.0, warmup=1, hidden=(16, 16), **settings)  # pyright: ignore[reportArgumentType]
    return SAC(config, OBSERVATION, ACTION, 10_000)


def test_actor_and_temperature_wait_for_the_critics():
    learner = small(critic_only=ROWS * LENGTH)
    before = [p.clone() for p in learner.actor_parameters]
    assert "actor" not in learner.update(batch())
    assert all(torch.equal(a, b) for a, b in zip(before, learner.actor_parameters, strict=True))
    assert "actor" in learner.update(batch())
    assert not all(torch.equal(a, b) for a, b in zip(before, learner.actor_parameters, strict=True))


def test_a_gradient_step_is_that_of_torchrl_to_the_last_digit():
    """The critics' values by their stacked parameters, and targets without tensordicts, change nothing."""
    torch.manual_seed(0)
    ours = SAC(
        SACConfig(hidden=(8, 8), batch=16, warmup=0, critic_only=0, updates_per_step=0.5), OBSERVATION, ACTION, 0
    )
    torch.manual_seed(0)
    theirs = SAC(ours.config, OBSERVATION, ACTION, 0)
    net = theirs.loss.qvalue_network
    plain: Any = _vmap_func(net, (None, 0), randomness="different", pseudo_vmap=True)
    theirs.loss._vmap_qnetworkN0 = plain
    theirs._follow = SoftUpdate(theirs.loss, tau=ours.config.polyak).step
    data = [batch(done_share=0.1) for _ in range(3)]
    for sac in (ours, theirs):
        for seed, part in enumerate(data):
            torch.manual_seed(seed)
            sac.update(part.clone())
    assert ours.updates == 96
    states = [
        {f"{n}/{k}": v for n, m in sac.modules.items() for k, v in m.state_dict().items()} for sac in (ours, theirs)
    ]
    moved = [name for name, value in states[0].items() if not torch.equal(value, states[1][name])]
    assert moved == []
    targets = _leaves(ours.loss.target_qvalue_network_params)
    assert not any(torch.equal(*pair) for pair in zip(targets[-2:], ours.critic_parameters[-2:], strict=True))


def test_values_are_discounted_mean_rewards():
    """With a reward of 2 at every step and no end, every value is 2, whatever the horizon."""
    learner = small(critic_only=10**6, polyak=0.2, learning_rate=3e-3, gamma=GAMMA, alpha=1e-9)
    for _ in range(12):
        learner.update(batch(reward=2.0))
    sample = learner._sample()
    network = learner.loss.qvalue_network
    with torch.no_grad(), learner.loss.qvalue_network_params[0].to_module(network):
        values = network(sample)["state_action_value"]
    assert (values - 2.0).abs().mean() < 0.1


def test_noise_stays_below_its_bound_and_can_always_shrink():
    actor = TanhActor(OBSERVATION, ACTION, (16,), -1.1)
    _, std = actor(torch.randn(100, OBSERVATION))
    assert ((std.log() > -1.3) & (std.log() < -1.1)).all()
    with torch.no_grad():
        actor.net[-1].bias[ACTION:] = 8.0  # pyright: ignore[reportIndexIssue,reportArgumentType]
    _, std = actor(torch.randn(100, OBSERVATION))
    assert (std.log() < -1.1 + 1e-6).all()
    std.sum().backward()
    gradient = actor.net[-1].bias.grad
    assert isinstance(gradient, Tensor)
    assert (gradient[ACTION:] > 0).all()


def test_prior_pulls_the_mean_towards_no_correction():
    sizes = []
    for weight in (0.0, 10.0):
        learner = small(critic_only=0, prior=weight, learning_rate_actor=1e-2)
        for _ in range(3):
            values = learner.update(batch())
        sizes.append(values["correction"])
    assert sizes[1] < 0.3 * sizes[0]


def test_a_worker_gets_the_policy_alone_at_any_time():
    """Collectors send it by pickle; what the loss keeps of its passes stays here."""
    learner = small(critic_only=0)
    learner.update(batch())
    learner.update(batch())
    assert learner.updates > 0
    content = pickle.dumps(learner.policy)
    policy = pickle.loads(content)
    assert len(content) < 4 * sum(8 * p.numel() for p in learner.policy.parameters()) + 100_000
    observation = torch.randn(3, OBSERVATION)
    assert torch.equal(policy.greedy(observation), learner.policy.greedy(observation))


def test_a_pull_that_fell_lets_the_mean_go():
    sizes = []
    for last in (10.0, 1e-9):
        learner = small(critic_only=0, prior=10.0, prior_last=last, prior_steps=1, learning_rate_actor=1e-2)
        for _ in range(3):
            values = learner.update(batch())
        sizes.append(values["correction"])
    assert sizes[0] < 0.3 * sizes[1]


def test_only_guided_runs_are_pulled_to_the_prior():
    prior = {name: recommended("DoraCube-v1", "sac", guidance=name).learner for name in ("affordance", "none")}
    assert prior["affordance"] == SACConfig()
    assert prior["none"] == SACConfig(prior=0.0)
    assert recommended("DoraCube-v1", "sac", guidance_parts=("observation",)).learner == SACConfig(prior=0.0)
    assert recommended("DoraCube-v1", "sac", guidance="none", learner={"prior": 0.2}).learner == SACConfig(prior=0.2)
