"""The updates of PPO and SAC with torch alone: what TorchRL's losses and tensordicts are timed and tested against.

Same networks, same losses, same minibatches in the same order from the same random numbers. Nothing is logged, kept for
a checkpoint, or checked for NaN.
"""

import copy

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from torch import Tensor, nn

from dora.agents.config import PPOConfig, SACConfig
from dora.agents.learners.networks import TANH_MARGIN, Critic, GaussianActor, Normaliser, TanhActor
from dora.agents.learners.ppo import ADAM_EPSILON, PPO, adapted, excess, squared, standardised
from dora.agents.learners.sac import ACTOR_PERIOD, SAC
from dora.agents.learners.schedules import loudest, pull, rates_left

Batch = dict[str, Tensor]
"""Transitions (N, T, ...): observation, action, log_prob, reward, done, terminated, and next observation as `next`."""


def plain_batch(batch: TensorDictBase) -> Batch:
    """A batch of a collector as tensors."""
    return {
        "observation": batch["observation"], "action": batch["action"], "log_prob": batch["action_log_prob"],
        "next": batch["next", "observation"], "reward": batch["next", "reward"][..., 0],
        "done": batch["next", "done"][..., 0], "terminated": batch["next", "terminated"][..., 0],
    }  # fmt: skip


class PlainPPO:
    """The update of `PPO` in plain torch.

    Args:
        ppo: whose networks are copied.
    """

    def __init__(self, ppo: PPO):
        self.config: PPOConfig = ppo.config
        self.normaliser: Normaliser = copy.deepcopy(ppo.normaliser)
        self.actor, self.critic = GaussianActor(1, 1, (1,), 0.0), copy.deepcopy(ppo.critic)
        self.actor.mean, self.actor.log_std = copy.deepcopy(ppo.actor.mean), nn.Parameter(ppo.actor.log_std.clone())
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.learning_rate, self.steps = ppo.learning_rate, ppo.steps
        self.optimiser = torch.optim.Adam(parameters, lr=self.learning_rate, eps=ADAM_EPSILON, fused=True)

    def update(self, batch: Batch) -> int:
        """Learn from a batch (N, T); the number of gradient steps."""
        c, steps = self.config, 0
        self.steps += batch["reward"].numel()
        features = self.normaliser(batch["observation"])
        with torch.no_grad():
            value, following = (self.critic(x)[..., 0] for x in (features, self.normaliser(batch["next"])))
            advantage = self._advantages(batch, value, following)
        flat = {
            "features": features.flatten(0, 1), "action": batch["action"].flatten(0, 1),
            "log_prob": batch["log_prob"].flatten(), "advantage": advantage.flatten(),
            "target": (advantage + value).flatten(),
        }  # fmt: skip
        divergences: list[Tensor] = []
        for _ in range(c.epochs):
            divergences.clear()
            for index in torch.randperm(len(flat["advantage"])).split(c.minibatch):
                divergences.append(self._step({name: x[index] for name, x in flat.items()}))
                steps += 1
        self.learning_rate = adapted(self.learning_rate, float(torch.stack(divergences).mean()), c)
        for group in self.optimiser.param_groups:
            group["lr"] = self.learning_rate
        self.normaliser.update(batch["observation"])
        return steps

    def _advantages(
        self, batch: Batch, value: Float[Tensor, "n t"], following: Float[Tensor, "n t"]
    ) -> Float[Tensor, "n t"]:
        c = self.config
        reward = batch["reward"] * (1 - c.gamma)
        delta = reward + c.gamma * following * ~batch["terminated"] - value
        advantage, last = torch.empty_like(delta), torch.zeros_like(delta[:, 0])
        for t in reversed(range(delta.shape[1])):
            last = delta[:, t] + c.gamma * c.gae_lambda * last * ~batch["done"][:, t]
            advantage[:, t] = last
        return advantage

    def _step(self, part: Batch) -> Tensor:
        c = self.config
        advantage = standardised(part["advantage"][:, None])[:, 0]
        mean, std = self.actor(part["features"])
        distribution = torch.distributions.Normal(mean, std)
        log_ratio = distribution.log_prob(part["action"]).sum(-1) - part["log_prob"]
        ratio = log_ratio.exp()
        gain = torch.minimum(ratio * advantage, ratio.clamp(1 - c.clip, 1 + c.clip) * advantage).mean()
        value_loss = c.value * nn.functional.mse_loss(self.critic(part["features"])[..., 0], part["target"])
        loss = -gain - c.entropy * distribution.entropy().sum(-1).mean() + value_loss
        loss = loss + c.bound * excess(mean) + pull(c, self.steps) * squared(mean)
        self.optimiser.zero_grad()
        loss.backward()
        for net in (self.actor, self.critic):
            nn.utils.clip_grad_norm_(net.parameters(), c.grad_norm)
        self.optimiser.step()
        with torch.no_grad():
            self.actor.log_std.clamp_(c.log_std_min, loudest(c, self.steps))
        return -log_ratio.detach().mean()


class PlainSAC:
    """The update of `SAC` in plain torch, with a replay buffer of tensors.

    Args:
        sac: whose networks are copied.
        observation, action: numbers of components.
    """

    def __init__(self, sac: SAC, observation: int, action: int):
        self.config: SACConfig = sac.config
        c = self.config
        self.normaliser: Normaliser = copy.deepcopy(sac.normaliser)
        self.actor = TanhActor(observation, action, c.hidden, c.log_std_max)
        self.actor.load_state_dict(sac.actor.state_dict())
        self.critics = [Critic(observation + action, c.hidden, nn.ReLU, layer_norm=True) for _ in range(2)]
        names = [name for name, _ in self.critics[0].named_parameters()]
        with torch.no_grad():
            for k, critic in enumerate(self.critics):
                for name, stacked in zip(names, sac.critic_parameters, strict=True):
                    critic.get_parameter(name).copy_(stacked[k])
        self.targets = copy.deepcopy(self.critics)
        self.log_alpha = nn.Parameter(torch.tensor(c.alpha).log())
        self.entropy = c.target_entropy * action
        self.adams = {
            "critic": torch.optim.Adam(
                [p for one in self.critics for p in one.parameters()], lr=c.learning_rate, fused=True
            ),
            "actor": torch.optim.Adam(self.actor.parameters(), lr=c.learning_rate_actor, fused=True),
            "alpha": torch.optim.Adam([self.log_alpha], lr=c.learning_rate_alpha, fused=True),
        }
        sizes = {"observation": observation, "action": action, "next": observation, "reward": 1, "discount": 1}
        self.memory = {name: torch.zeros(c.capacity, size) for name, size in sizes.items()}
        self.added, self.updates, self.due = 0, 0, 0.0

    def update(self, batch: Batch) -> int:
        """Store a batch (N, T) and learn from the memory; the number of gradient steps."""
        self._store(batch)
        self.normaliser.update(batch["observation"])
        if self.added < self.config.warmup:
            return 0
        before = self.updates
        self.due += batch["reward"].numel() * self.config.updates_per_step
        left, c = rates_left(self.config, float(self.added)), self.config
        for name, rate in (("critic", c.learning_rate), ("actor", c.learning_rate_actor)):
            self.adams[name].param_groups[0]["lr"] = left * rate
        while self.due >= 1.0:
            self.due -= 1.0
            rows = torch.randint(min(self.added, self.config.capacity), (self.config.batch,))
            part = {name: column[rows] for name, column in self.memory.items()}
            part |= {name: self.normaliser(part[name]) for name in ("observation", "next")}
            self._learn_critics(part)
            if self.updates >= self.config.critic_only and self.updates % ACTOR_PERIOD == 0:
                self._learn_actor(part)
            with torch.no_grad():
                for target, critic in zip(self.targets, self.critics, strict=True):
                    for theirs, ours in zip(target.parameters(), critic.parameters(), strict=True):
                        theirs.lerp_(ours, self.config.polyak)
            self.updates += 1
        return self.updates - before

    def _store(self, batch: Batch) -> None:
        """Append transitions over up to `n_step` control steps; `discount` is what the value after them counts."""
        c, (rows, length) = self.config, batch["reward"].shape
        total, going = batch["reward"].clone(), ~batch["done"]
        last = torch.arange(length).expand(rows, length).clone()
        for k in range(1, min(c.n_step, length)):
            more = going[:, :-k]
            total[:, :-k] += c.gamma**k * batch["reward"][:, k:] * more
            last[:, :-k] += more
            going[:, :-k] &= ~batch["done"][:, k:]
        each = torch.arange(rows)[:, None], last
        count = last - torch.arange(length) + 1
        new = {
            "observation": batch["observation"], "action": batch["action"], "next": batch["next"][each],
            "reward": (total * (1 - c.gamma))[..., None],
            "discount": (c.gamma**count * ~batch["terminated"][each])[..., None],
        }  # fmt: skip
        slots = torch.arange(self.added, self.added + rows * length) % c.capacity
        for name, values in new.items():
            self.memory[name][slots] = values.flatten(0, 1)
        self.added += rows * length

    def _act(self, features: Float[Tensor, "b o"]) -> tuple[Tensor, Tensor, Tensor]:
        """Action, its log probability, and the mean before the tanh."""
        mean, std = self.actor(features)
        noise = torch.randn_like(mean)
        before = mean + std * noise
        action = before.tanh()
        normal = torch.distributions.Normal(mean, std).log_prob(before)
        return action, (normal - (1 - action.square() + TANH_MARGIN).log()).sum(-1), mean

    def _learn_critics(self, part: Batch) -> None:
        with torch.no_grad():
            action, log_prob, _ = self._act(part["next"])
            values = [target(part["next"], action) for target in self.targets]
            value = torch.minimum(*values) - self.log_alpha.exp() * log_prob[:, None]
            wanted = part["reward"] + part["discount"] * value
        found = [critic(part["observation"], part["action"]) for critic in self.critics]
        _descend(self.adams["critic"], sum(nn.functional.mse_loss(one, wanted) for one in found))

    def _learn_actor(self, part: Batch) -> None:
        action, log_prob, mean = self._act(part["observation"])
        for critic in self.critics:
            critic.requires_grad_(False)
        value = torch.minimum(*(critic(part["observation"], action) for critic in self.critics))[:, 0]
        for critic in self.critics:
            critic.requires_grad_(True)
        pulled = pull(self.config, float(self.added)) * mean.square().sum(-1).mean()
        _descend(self.adams["actor"], (self.log_alpha.detach().exp() * log_prob - value).mean() + pulled)
        _descend(self.adams["alpha"], -(self.log_alpha * (log_prob.detach() + self.entropy)).mean())


def _descend(optimiser: torch.optim.Optimizer, loss: Tensor | int) -> None:
    assert isinstance(loss, Tensor)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
