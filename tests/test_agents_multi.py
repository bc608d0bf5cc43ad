"""MAPPO and HAPPO: surrogates, the compounded ratio, the matrix game, and whole runs of two agents on the fake task."""

import dataclasses
import functools
import itertools
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_task import TwoPoints
from matrix_game import ITERATIONS, SEEDS, Game
from tensordict import TensorDict
from test_agents_logs import events_of
from test_agents_train import BASE, run, weights
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dora.agents.agent_columns import AgentColumns, checked_agents
from dora.agents.config import HAPPOConfig, MAPPOConfig, PPOConfig
from dora.agents.evaluation.play import evaluate_checkpoint
from dora.agents.learners.finite import check_modules
from dora.agents.learners.learner import make_learner
from dora.agents.learners.multi_agent import AgentUpdate, MultiAgentPPO, learn_in_order
from dora.agents.learners.networks import last_layer
from dora.agents.learners.ppo import PPO
from dora.agents.runs.logging import TAGS
from dora.agents.runs.run_folder import RunFolder
from dora.errors import RunFailure

SIZES = (9, 4)
AGENTS = checked_agents(TwoPoints(2).agent_columns, SIZES, "the test")
ALONE = {"all": AgentColumns(tuple(range(9)), tuple(range(4)))}
SETTINGS: dict[str, Any] = {"rollout": 16, "minibatch": 128, "hidden": (32, 32)}
BOTH = {"mappo": MAPPOConfig(**SETTINGS), "happo": HAPPOConfig(**SETTINGS)}
LEARNING = {"gamma": 0.9, "learning_rate": 2e-3, "learning_rate_max": 3e-3, "hidden": (64, 64)}
"""Settings with which two agents learn in seconds: an episode has 16 steps."""
CLIP, FIRST = 0.5, 2
"""Half width of the trust interval of the matrix game, and iterations in which agents that learn at once lose."""


def learner_of(agent: str = "happo", **changes: Any) -> MultiAgentPPO:
    """A learner of the two points with weights of seed 0."""
    torch.manual_seed(0)
    return MultiAgentPPO(dataclasses.replace(BOTH[agent], **changes), *SIZES, 1000, AGENTS)


def batch_of(learner: Any, n: int = 8, t: int = 16, seed: int = 1) -> TensorDict:
    """Transitions (n, t) of a learner's policy, with observations that follow from nothing; its normaliser is set."""
    torch.manual_seed(seed)
    observation = torch.randn(n, t + 1, SIZES[0])
    if learner.normaliser.count == 0:
        learner.normaliser.update(observation)
    data = learner.policy(TensorDict({"observation": observation[:, :-1].flatten(0, 1)}, [n * t]))
    done = torch.zeros(n, t, 1, dtype=torch.bool)
    done[:, -1] = True
    following = {"observation": observation[:, 1:], "reward": torch.randn(n, t, 1), "done": done}
    return TensorDict(
        {
            "observation": observation[:, :-1],
            "action": data["action"].unflatten(0, (n, t)),
            "action_log_prob": data["action_log_prob"].unflatten(0, (n, t)),
            "next": {**following, "terminated": torch.zeros_like(done)},
        },
        [n, t],
    )


def parts_of(learner: MultiAgentPPO, batch: TensorDict) -> list[TensorDict]:
    flat: Any = batch.flatten()
    features = learner.normaliser(flat["observation"])
    return learner._parts(
        TensorDict({"features": features, **{k: flat[k] for k in ("action", "action_log_prob")}}, flat.batch_size)
    )


def test_without_samples_of_a_normaliser_the_first_batch_is_learned_from():
    learner = MultiAgentPPO(BOTH["mappo"], *SIZES, 0, AGENTS)
    assert "policy/left" in learner.update(batch_of(learner))
    assert learner.normaliser.count == 0


# ---- the policy ----------------------------------------------------------------------------------


def test_each_actor_sees_its_columns_and_the_critic_sees_all():
    learner = learner_of()
    observation = torch.randn(5, SIZES[0])
    action, value = learner.policy.greedy(observation), learner.critic(learner.normaliser(observation))
    observation[:, 6] += 1.0  # seen by the right agent alone
    moved, other = learner.policy.greedy(observation), learner.critic(learner.normaliser(observation))
    assert torch.equal(moved[:, :2], action[:, :2])
    assert (moved[:, 2:] != action[:, 2:]).any(1).all()
    assert (value != other).all()
    observation[:, 8] += 1.0  # seen by both
    assert ((learner.policy.greedy(observation) != moved).reshape(5, 2, 2).any(-1)).all()


def test_actions_and_log_probabilities_are_those_of_the_actors():
    learner = learner_of()
    agents = {"b": AgentColumns((0, 5, 1), (3, 0)), "a": AgentColumns((8,), (1, 2))}
    torch.manual_seed(0)
    learner = MultiAgentPPO(BOTH["mappo"], *SIZES, 1000, agents)
    observation = torch.randn(7, SIZES[0])
    torch.manual_seed(3)
    data = learner.policy(TensorDict({"observation": observation}, [7]))
    torch.manual_seed(3)
    noise = torch.randn(7, SIZES[1])
    assert data["action_log_prob"].shape == (7, 2)
    for k, (name, columns) in enumerate(agents.items()):
        mean, std = learner.actor.of(name)(observation[:, list(columns.observation)])
        log_prob = torch.distributions.Normal(mean, std).log_prob(data["action"][:, list(columns.action)]).sum(-1)
        torch.testing.assert_close(data["action_log_prob"][:, k], log_prob)
        torch.testing.assert_close(data["action"][:, list(columns.action)], mean + std * noise[:, list(columns.action)])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = learner.policy(TensorDict({"observation": observation}, [7]))
    assert torch.equal(greedy["action"], learner.policy.greedy(observation))
    assert greedy["action"].abs().max() < 0.2
    assert learner.policy.action_size == 4


# ---- the update ----------------------------------------------------------------------------------


def test_policies_that_do_not_move_have_the_ratio_one_and_compound_nothing():
    """Both agents take all their gradient steps, at a rate of 0."""
    learner = learner_of("happo", learning_rate=0.0, learning_rate_min=0.0, learning_rate_max=0.0)
    batch = batch_of(learner)
    parts, updates = parts_of(learner, batch), list(learner.updates.values())
    passes = [torch.randperm(128) for _ in range(2)]
    found = learn_in_order(updates, parts, torch.randn(128, 1), [0, 1], passes, compound=True)
    for update, part, values in zip(updates, parts, found, strict=True):
        assert values["grad_norm"] > 0
        torch.testing.assert_close(update.ratio(part), torch.ones(128, 1), rtol=0, atol=1e-5)
        assert values["factor_std"] == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1]])
def test_an_advantage_is_multiplied_by_the_ratios_of_those_before(order: list[int]):
    """Kuba et al. 2022: M of agent i_m+1 is M of agent i_m times pi_new / pi_old of agent i_m; hand-made policies."""

    class Fixed(AgentUpdate):
        """An agent whose policy becomes what it is told, and which keeps the advantages that it was given."""

        def __init__(self, ratio: list[float]):
            self.after, self.seen = torch.tensor(ratio)[:, None], torch.empty(0)

        def learn(self, data: TensorDict, passes: Any, stop: Any = None) -> dict[str, float]:
            self.seen = data["advantage"].clone()
            return {}

        def ratio(self, data: TensorDict) -> Tensor:
            return self.after

    ratios = [[0.5, 2.0], [3.0, 1.0], [0.1, 4.0]]
    agents = [Fixed(ratio) for ratio in ratios]
    advantage = torch.tensor([[1.0], [-2.0]])
    parts = [TensorDict({}, [2]) for _ in agents]
    learn_in_order(agents, parts, advantage, order, [], compound=True)
    wanted = advantage
    for k in order:
        torch.testing.assert_close(agents[k].seen, wanted)
        wanted = wanted * torch.tensor(ratios[k])[:, None]
    learn_in_order(agents, parts, advantage, order, [], compound=False)
    assert all(torch.equal(agent.seen, advantage) for agent in agents)


def test_one_step_follows_the_gradient_of_the_clipped_surrogate():
    """Of a hand-computed M A: the second agent's gradient is that of min(r M A, clip(r) M A)."""
    learner = learner_of(epochs=1, minibatch=10**6, entropy=0.0, bound=0.0, grad_norm=1e9)
    batch = batch_of(learner)
    parts, advantage = parts_of(learner, batch), torch.randn(128, 1)
    before = {name: [p.detach().clone() for p in learner.actor.of(name).parameters()] for name in AGENTS}
    left, right = learner.updates["left"], learner.updates["right"]
    left.optimiser.param_groups[0]["lr"] = 0.05  # far enough for ratios beyond the clip's half width
    passes = [torch.arange(128)]
    learn_in_order([left, right], parts, advantage, [0, 1], passes, compound=True)

    def log_prob(name: str, values: list[Tensor]) -> Tensor:
        actor = learner.actor.of(name)
        names = [n for n, _ in actor.named_parameters()]
        features = parts[list(AGENTS).index(name)]["features"]
        mean, std = torch.func.functional_call(actor, dict(zip(names, values, strict=True)), (features,))
        action = parts[list(AGENTS).index(name)]["action"]
        return torch.distributions.Normal(mean, std).log_prob(action).sum(-1, keepdim=True)

    now = [p.detach() for p in learner.actor.of("left").parameters()]
    factor = (log_prob("left", now) - log_prob("left", before["left"])).exp()
    assert factor.std() > 0.01
    start = [p.requires_grad_() for p in before["right"]]
    ratio = (log_prob("right", start) - parts[1]["action_log_prob"][:, None]).exp()
    clipped = ratio.clamp(0.8, 1.2)
    loss = -torch.minimum(ratio * factor * advantage, clipped * factor * advantage).mean()
    grads = torch.autograd.grad(loss, start)
    for parameter, grad in zip(learner.actor.of("right").parameters(), grads, strict=True):
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, grad, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
def test_in_the_matrix_game_agents_in_turn_never_lose_and_agents_at_once_do():
    """Over six seeds, by more than .02 in any of twelve iterations and by more than .5 in one of the first two."""
    falls = {}
    for compound, iterations in ((True, ITERATIONS), (False, FIRST)):
        runs = [Game(seed, compound, CLIP).run(iterations) for seed in range(SEEDS)]
        falls[compound] = max(before - after for one in runs for before, after in itertools.pairwise(one))
    assert falls[True] < 0.02
    assert falls[False] > 0.5


def test_the_order_of_agents_is_drawn_anew_only_where_it_matters(monkeypatch: pytest.MonkeyPatch):
    seen: list[list[int]] = []

    def keep(updates: Any, parts: Any, advantage: Tensor, order: Any, passes: Any, *, compound: bool, stop: Any) -> Any:
        seen.append(list(order))
        assert float(advantage.mean()) == pytest.approx(0, abs=1e-5)
        assert float(advantage.std(correction=0)) == pytest.approx(1, abs=1e-3)
        return [{} for _ in updates]

    monkeypatch.setattr("dora.agents.learners.multi_agent.learn_in_order", keep)
    for agent, wanted in (("mappo", {(0, 1)}), ("happo", {(0, 1), (1, 0)})):
        learner = learner_of(agent)
        batch = batch_of(learner)
        seen.clear()
        for _ in range(20):
            learner.update(batch)
        assert {tuple(order) for order in seen} == wanted


def test_agents_that_learn_at_once_do_not_depend_on_each_other():
    """An agent of MAPPO ends where it would alone; of HAPPO only the one that learns first."""
    learner, other = learner_of("mappo"), learner_of("mappo")
    batch = batch_of(learner)
    other.normaliser.load_state_dict(learner.normaliser.state_dict())
    passes, advantage = [torch.randperm(128) for _ in range(4)], torch.randn(128, 1)
    learn_in_order(list(learner.updates.values()), parts_of(learner, batch), advantage, [0, 1], passes, compound=False)
    learn_in_order(list(other.updates.values()), parts_of(other, batch), advantage, [1, 0], passes, compound=False)
    for name, value in learner.actor.state_dict().items():
        assert torch.equal(value, other.actor.state_dict()[name])


@pytest.mark.parametrize("agent", BOTH)
def test_one_agent_is_ppo(agent: str):
    """The class itself, where PPO's minibatch is the whole batch and advantages are standardised over the same."""
    settings = {**SETTINGS, "minibatch": 10**6, "prior": 0.02}
    torch.manual_seed(0)
    ppo = PPO(PPOConfig(**settings), *SIZES, 1000)
    with torch.no_grad():
        last_layer(ppo.actor.mean).bias.fill_(1.5)  # beyond the range of actions, where the penalty is
    learner = MultiAgentPPO(dataclasses.replace(BOTH[agent], **settings), *SIZES, 1000, ALONE)
    learner.actor.of("all").load_state_dict(ppo.actor.state_dict())
    learner.critic.load_state_dict(ppo.critic.state_dict())
    for k in range(3):
        batch = batch_of(ppo, seed=k)
        learner.normaliser.load_state_dict(ppo.normaliser.state_dict())
        joint = batch.clone()
        joint["action_log_prob"] = joint["action_log_prob"][..., None]
        found = []
        for one, data in ((ppo, batch), (learner, joint)):
            torch.manual_seed(10 + k)
            found.append(one.update(data))
        for name in ("policy", "kl", "learning_rate", "entropy", "bound", "clip_fraction", "grad_norm", "action_std",
                     "correction"):  # fmt: skip
            assert found[1][f"{name}/all"] == pytest.approx(found[0][name], rel=1e-3, abs=1e-5), name
        for name in ("value", "explained_variance"):
            assert found[1][name] == pytest.approx(found[0][name], rel=1e-3, abs=1e-5), name
    assert learner.critic_adam.param_groups[0]["lr"] == ppo.learning_rate != PPOConfig().learning_rate
    for ours, theirs in ((learner.actor.of("all"), ppo.actor), (learner.critic, ppo.critic)):
        for name, value in theirs.state_dict().items():
            torch.testing.assert_close(ours.state_dict()[name], value, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize("agent", BOTH)
def test_a_task_of_one_agent_is_learned_by_ppo_itself(tmp_path: Path, agent: str):
    config = dataclasses.replace(BASE, agent=agent, learner=BOTH[agent], total_steps=768)
    plain = dataclasses.replace(config, agent="ppo", learner=PPOConfig(**SETTINGS))
    assert isinstance(make_learner(config, 4, 2), PPO)
    assert isinstance(make_learner(config, *SIZES, ALONE), PPO)
    assert isinstance(make_learner(plain, *SIZES, AGENTS), PPO)
    run(tmp_path / "one", config)
    run(tmp_path / "plain", plain)
    one, other = weights(tmp_path / "one"), weights(tmp_path / "plain")
    assert one.keys() == other.keys()
    assert all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize("ended", ["truncated", "terminated"])
def test_time_limits_bootstrap_and_failures_do_not(ended: str, monkeypatch: pytest.MonkeyPatch):
    """Of the episode that ends in the last step, as the update sees it: A = r (1 - gamma) + gamma V(next) - V."""
    learner = learner_of()
    batch = batch_of(learner)
    batch["next", "terminated"][:, -1] = ended == "terminated"
    kept: list[Tensor] = []

    def keep(updates: Any, parts: Any, advantage: Tensor, *_: Any, **__: Any) -> Any:
        kept.append(advantage)
        return [{} for _ in updates]

    monkeypatch.setattr("dora.agents.learners.multi_agent.learn_in_order", keep)
    monkeypatch.setattr("dora.agents.learners.multi_agent.standardised", lambda advantage: advantage)
    with torch.no_grad():
        torch.nn.init.normal_(last_layer(learner.critic.net).weight)
        value = learner.critic(learner.normaliser(batch["observation"][:, -1]))
        following = learner.critic(learner.normaliser(batch["next", "observation"][:, -1]))
    gamma, left = learner.config.gamma, 0.0 if ended == "terminated" else 1.0
    wanted = (1 - gamma) * batch["next", "reward"][:, -1] + left * gamma * following - value
    learner.update(batch)
    torch.testing.assert_close(kept[0].unflatten(0, (8, 16))[:, -1], wanted, rtol=1e-4, atol=1e-5)


def test_learning_rates_are_adapted_for_each_agent():
    """The slow agent moves by less than half the target, the other one by more than twice as much as the target."""
    learner = learner_of(target_kl=3e-4)
    batch = batch_of(learner)
    slow = learner.updates["left"].optimiser.param_groups[0]
    slow["lr"] = 1e-5
    values = learner.update(batch)
    assert values["learning_rate/left"] == pytest.approx(1.2e-5)
    assert values["learning_rate/right"] == pytest.approx(5e-4 / 1.3)
    mean = (values["learning_rate/left"] + values["learning_rate/right"]) / 2
    assert learner.critic_adam.param_groups[0]["lr"] == pytest.approx(mean)


def test_what_is_not_finite_ends_the_run_and_names_the_agent():
    learner = learner_of("mappo")
    batch = batch_of(learner)
    batch["action"][0, 0, 2] = float("nan")
    with pytest.raises(RunFailure, match="loss of the actor of right is nan"):
        learner.update(batch)
    check_modules({"left": learner.actor.of("left")})


# ---- whole runs ----------------------------------------------------------------------------------


@pytest.mark.parametrize("agent", BOTH)
def test_two_agents_learn_what_needs_both(tmp_path: Path, agent: str):
    learner = dataclasses.replace(BOTH[agent], rollout=32, **LEARNING)
    config = dataclasses.replace(BASE, agent=agent, learner=learner, total_steps=12_000, eval_every=4_000)
    result = run(tmp_path / "run", config, TwoPoints)
    assert result["success_rate"] > 0.9
    assert result["zero_success_rate"] < 0.1
    best = RunFolder(tmp_path / "run").best
    _, evaluation, _ = evaluate_checkpoint(best, config, TwoPoints)
    assert evaluation.success_rate == result["success_rate"]


@pytest.mark.parametrize("agent", BOTH)
def test_resuming_goes_on_exactly(tmp_path: Path, agent: str):
    """As for PPO: episodes end with the rollout and all start alike."""
    config = dataclasses.replace(
        BASE, agent=agent, learner=BOTH[agent], total_steps=4 * 256, eval_every=512, stagger=False
    )
    make = functools.partial(TwoPoints, deterministic=True)
    run(tmp_path / "straight", config, make)
    run(tmp_path / "halves", dataclasses.replace(config, total_steps=2 * 256), make)
    run(tmp_path / "halves", config, make, resume=True)
    straight, halves = weights(tmp_path / "straight"), weights(tmp_path / "halves")
    assert straight.keys() == halves.keys()
    for name, value in straight.items():
        assert torch.equal(value, halves[name]), name
    rate = straight["adam_left/learning_rate"]
    assert rate != BOTH[agent].learning_rate


@pytest.mark.slow
def test_workers_learn_and_repeat(tmp_path: Path):
    config = dataclasses.replace(BASE, agent="happo", learner=BOTH["happo"], workers=2, num_envs=8, total_steps=1024)
    for name in "ab":
        run(tmp_path / name, config, TwoPoints)
    a, b = weights(tmp_path / "a"), weights(tmp_path / "b")
    assert all(torch.equal(value, b[name]) for name, value in a.items())


def test_every_value_is_logged_under_a_tag_that_is_explained(tmp_path: Path):
    config = dataclasses.replace(BASE, agent="happo", learner=BOTH["happo"], total_steps=512)
    run(tmp_path / "run", config, TwoPoints)
    tags = events_of(tmp_path / "run").Tags()["scalars"]
    own = [tag for tag in tags if tag.startswith(("loss/", "learner/"))]
    assert {"loss/policy/left", "loss/bound/right", "loss/value", "learner/kl/right", "learner/factor_std/left"} <= {
        *own
    }
    words = re.search("HAPPO: (.*) of one", TAGS["learner/<value>/<agent>"])
    assert words is not None
    explained = {tag.replace("<value>", value) for tag in TAGS for value in words[1].split(", ")}
    assert set(own) <= {tag.replace("<agent>", name) for tag in explained for name in AGENTS}
