"""MAPPO and HAPPO with TorchRL's `ClipPPOLoss`: an actor for each agent of a task, and a critic that sees everything.

Both learn from the same batch as PPO. Agent i sees o_i, its columns of the normalised observation, and commands a_i,
its columns of the action; the critic sees all columns, and the reward is common. A is the generalised advantage of the
joint action, standardised over the whole batch, and r_i = pi_i(a_i | o_i) / pi_i_old(a_i | o_i). Agent i maximises

    MAPPO   E[min(r_i A, clip(r_i, 1 - eps, 1 + eps) A)]                                    all at once
    HAPPO   E[min(r_i M A, clip(r_i, 1 - eps, 1 + eps) M A)],   M = prod over j before i of r_j    one after the other

HAPPO's order is drawn in each iteration. M > 0, so it can be multiplied into the advantage; MAPPO is the case M = 1.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss

from dora.agents.agent_columns import Agents
from dora.agents.config import HAPPOConfig, MAPPOConfig, PPOConfig
from dora.agents.learners.finite import check_loss
from dora.agents.learners.networks import Critic, GaussianActor, JointActor, LatestOutput, Normaliser, Policy, for_loss
from dora.agents.learners.ppo import ADAM_EPSILON, adapted, excess, squared, standardised, transitions
from dora.agents.learners.schedules import loudest, pull
from dora.agents.learners.stopping import Stop, never

Passes = Sequence[Int[Tensor, " b"]]
"""The order of the transitions in each pass over a batch; the same for all agents and the critic."""


class MultiAgentPPO:
    """MAPPO or HAPPO, as `config` says; with one agent both are PPO, whose advantages are standardised per minibatch.

    The critic takes its gradient steps after the agents, with the mean of the learning rates that they began with; as
    advantages are computed before, its place changes nothing.

    Args:
        config: settings.
        observation: number of observation components.
        action: number of action components.
        normaliser_samples: observations after which the normaliser stays as it is.
        agents: columns of each agent, by name.
    """

    replay = None

    def __init__(
        self, config: MAPPOConfig | HAPPOConfig, observation: int, action: int, normaliser_samples: int, agents: Agents
    ):
        self.config, self.agents, self.in_turn = config, dict(agents), isinstance(config, HAPPOConfig)
        self.rollout = config.rollout
        self.normaliser = Normaliser(observation, normaliser_samples)
        self.actor = JointActor(agents, config.hidden, config.log_std)
        self.critic = Critic(observation, config.hidden, nn.ELU, layer_norm=False)
        self.policy = Policy(self.normaliser, self.actor, config.noise_correlation)
        self.steps = 0.0
        self.updates = {n: AgentUpdate(n, for_loss(self.actor.of(n), IndependentNormal), config) for n in agents}
        self.critic_adam = torch.optim.Adam(
            self.critic.parameters(), lr=config.learning_rate, eps=ADAM_EPSILON, fused=True
        )

    @property
    def modules(self) -> dict[str, nn.Module]:
        """What a checkpoint holds, by name."""
        return {"normaliser": self.normaliser, "actor": self.actor, "critic": self.critic}

    @property
    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimisers, by name: `adam` is that of the critic. They hold the adapted learning rates, too."""
        return {"adam": self.critic_adam, **{f"adam_{name}": one.optimiser for name, one in self.updates.items()}}

    def counters(self) -> dict[str, float]:
        """Environment steps that were learned from."""
        return {"steps": self.steps}

    def set_counters(self, counters: dict[str, float]) -> None:
        """Restore `counters`."""
        self.steps = counters.get("steps", 0.0)  # earlier versions did not count

    def update(self, batch: TensorDictBase, stop: Stop = never) -> dict[str, float]:
        """Learn from a batch (N, T) and return the means of the losses by name, those of an agent as `<name>/<agent>`;
        nothing if `stop` said yes.

        The very first batch only sets the normaliser, as in PPO.
        """
        if self.normaliser.count == 0 and not self.normaliser.frozen:
            self.normaliser.update(batch["observation"])
            return {}
        self.steps += batch.numel()
        for one in self.updates.values():
            one.prior, one.loudest = pull(self.config, self.steps), loudest(self.config, self.steps)
        data = transitions(batch, self.normaliser, self.critic, self.config)
        advantage = standardised(data["advantage"])
        passes = [torch.randperm(len(data)) for _ in range(self.config.epochs)]
        count = len(self.agents)
        order = torch.randperm(count).tolist() if self.in_turn and count > 1 else range(count)
        updates, parts = list(self.updates.values()), self._parts(data)
        found = learn_in_order(updates, parts, advantage, order, passes, compound=self.in_turn, stop=stop)
        value = self._learn_critic(data, passes, stop)
        self.normaliser.update(batch["observation"])
        if stop():
            return {}
        values = {f"{n}/{agent}": v for agent, own in zip(self.agents, found, strict=True) for n, v in own.items()}
        return values | {"value": value, "explained_variance": float(data["explained"][0])}

    def _parts(self, data: TensorDict) -> list[TensorDict]:
        """The transitions as each agent sees them, in the order of the agents."""
        return [
            TensorDict(
                {
                    "features": data["features"][:, list(columns.observation)],
                    "action": data["action"][:, list(columns.action)],
                    "action_log_prob": data["action_log_prob"][:, k],
                },
                batch_size=data.batch_size,
            )
            for k, columns in enumerate(self.agents.values())
        ]

    def _learn_critic(self, data: TensorDict, passes: Passes, stop: Stop) -> float:
        """Gradient steps of the value of the joint observation; the mean loss, NaN if `stop` said yes."""
        losses = []
        for index in (index for one in passes for index in one.split(self.config.minibatch)):
            if stop():
                return float("nan")
            value, target = self.critic(data["features"][index]), data["value_target"][index]
            loss = self.config.value * nn.functional.mse_loss(value, target)
            _descend(self.critic_adam, loss, list(self.critic.parameters()), self.config.grad_norm, "critic")
            losses.append(loss.detach())
        rates = [one.learning_rate for one in self.updates.values()]
        _set_learning_rate(self.critic_adam, sum(rates) / len(rates))
        return float(torch.stack(losses).mean())


class AgentUpdate:
    """The clipped surrogate of one agent's actor, with its own optimiser and learning rate.

    Args:
        name: of the agent, for messages.
        policy: its actor as TorchRL's losses want it, see `for_loss`; of any distribution.
        config: settings.
    """

    def __init__(self, name: str, policy: ProbabilisticTensorDictSequential, config: PPOConfig):
        self.name, self.policy, self.config = name, policy, config
        self.prior, self.loudest = pull(config, 0.0), loudest(config, 0.0)
        self.loss = ClipPPOLoss(
            policy,
            None,
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy,
            normalize_advantage=False,
            functional=False,
        )
        self.optimiser = torch.optim.Adam(policy.parameters(), lr=config.learning_rate, eps=ADAM_EPSILON, fused=True)
        self._latest = LatestOutput()  # whose mean is empty where the policy has another distribution
        actor = policy[0].module
        self._gaussian = actor if isinstance(actor, GaussianActor) else None
        if self._gaussian is not None:
            self._gaussian.register_forward_hook(self._latest)

    @property
    def learning_rate(self) -> float:
        """The adapted learning rate."""
        return self.optimiser.param_groups[0]["lr"]

    def learn(self, data: TensorDict, passes: Passes, stop: Stop = never) -> dict[str, float]:
        """Gradient steps on transitions (B,) with `features`, `action`, `action_log_prob` and `advantage` (B, 1).

        Returns:
            Means over the gradient steps by name, and the divergence of the last pass, which adapts the learning rate;
            nothing if `stop` said yes.
        """
        steps: list[list[Tensor]] = []
        for one in passes:
            steps.append([])
            for index in one.split(self.config.minibatch):
                if stop():
                    return {}
                steps[-1].append(self._step(data[index]))
        divergence = float(torch.stack([values[-1] for values in steps[-1]]).mean())
        _set_learning_rate(self.optimiser, adapted(self.learning_rate, divergence, self.config))
        means = torch.stack([values for one in steps for values in one]).mean(0).tolist()
        found = dict(
            zip(("policy", "entropy", "bound", "clip_fraction", "grad_norm", "correction"), means[:-1], strict=True)
        )
        found |= {"kl": divergence, "learning_rate": self.learning_rate}
        std = {} if self._gaussian is None else {"action_std": float(self._gaussian.log_std.detach().exp().mean())}
        return found | std

    @torch.no_grad()
    def ratio(self, data: TensorDict) -> Float[Tensor, "b 1"]:
        """Probability of each action now over that with which it was drawn."""
        log_prob = self.policy.get_dist(data).log_prob(data["action"])
        return (log_prob - data["action_log_prob"]).exp()[:, None]

    def _step(self, minibatch: TensorDict) -> Float[Tensor, " 7"]:
        """One gradient step; returns losses, the gradient's norm and the divergence."""
        out = self.loss(minibatch)
        bound = excess(self._latest.mean)
        pulled = self.config.bound * bound + self.prior * squared(self._latest.mean)
        total = out["loss_objective"] + out["loss_entropy"] + pulled
        parameters = list(self.policy.parameters())
        norm = _descend(self.optimiser, total, parameters, self.config.grad_norm, f"actor of {self.name}")
        if self._gaussian is not None:
            with torch.no_grad():
                self._gaussian.log_std.clamp_(self.config.log_std_min, self.loudest)
        values = [out["loss_objective"], out["entropy"].mean(), bound, out["clip_fraction"].mean(), norm]
        correction = self._latest.mean.detach().square().mean().sqrt()
        values += [correction.nan_to_num()]  # without a mean: it is another distribution
        return torch.stack([v.detach() for v in values] + [out["kl_approx"].detach().mean()])


def learn_in_order(
    updates: Sequence[AgentUpdate],
    parts: Sequence[TensorDict],
    advantage: Float[Tensor, "b 1"],
    order: Sequence[int],
    passes: Passes,
    *,
    compound: bool,
    stop: Stop = never,
) -> list[dict[str, float]]:
    """Let each agent learn from the advantage of the joint action.

    Args:
        updates: of the agents.
        parts: `features`, `action` and `action_log_prob` of each agent.
        advantage: of the joint action, the same for all.
        order: in which the agents learn, as places in `updates`.
        passes: over the transitions, with which each of them learns.
        compound: HAPPO: the advantage of an agent is multiplied by M, the product of the probability ratios of those
            that have learned before it. Otherwise it stays as it is, and the order is of no consequence.
        stop: asked before every gradient step; once it says yes, none is taken.

    Returns:
        What `AgentUpdate.learn` returned for each agent, in the order of `updates`; with `compound` also the deviation
        of its M over the transitions.
    """
    found: list[dict[str, float]] = [{} for _ in updates]
    factor = torch.ones_like(advantage)
    for k in order:
        data = parts[k].set("advantage", factor * advantage)
        found[k] = updates[k].learn(data, passes, stop)
        if stop():
            break
        if compound:
            found[k]["factor_std"] = float(factor.std())
            factor = factor * updates[k].ratio(data)
    return found


def _descend(
    optimiser: torch.optim.Optimizer, loss: Tensor, parameters: list[nn.Parameter], most: float, name: str
) -> Tensor:
    """One gradient step with the gradient scaled down to the norm `most`; returns its norm before."""
    check_loss(f"loss of the {name}", loss)
    optimiser.zero_grad()
    loss.backward()
    norm = nn.utils.clip_grad_norm_(parameters, most)
    check_loss(f"gradient of the {name}", norm)
    optimiser.step()
    return norm


def _set_learning_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    for group in optimiser.param_groups:
        group["lr"] = rate
