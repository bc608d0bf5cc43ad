"""Proximal policy optimisation with TorchRL's `ClipPPOLoss` and generalised advantages."""

import torch
from jaxtyping import Bool, Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from dora.agents.config import PPOConfig
from dora.agents.learners.finite import check_loss
from dora.agents.learners.networks import Critic, GaussianActor, LatestOutput, Normaliser, Policy, for_loss
from dora.agents.learners.schedules import loudest, pull
from dora.agents.learners.stopping import Stop, never

ADAM_EPSILON = 1e-8
"""Adam's epsilon, far below the gradients of values that are mean rewards."""
LEARNING_RATE_DOWN, LEARNING_RATE_UP = 1.3, 1.2
"""Factors by which the adaptive learning rate is divided and multiplied [1]."""
KL_BAND = 2.0
"""The learning rate changes outside target_kl / KL_BAND .. target_kl * KL_BAND [1]."""
ADVANTAGE_FLOOR = 1e-6
"""Smallest standard deviation by which advantages are divided."""


class PPO:
    """Learns from one batch of fresh transitions at a time.

    Values are discounted mean rewards, (1 - gamma) times the usual ones, and the gradients of actor and critic are
    clipped apart: errors of the value, large at first, would otherwise scale the actor's steps down.

    The learning rate falls by 1.3 when the divergence from the old policy exceeds twice its target and
    rises by 1.2 when it is below half of it.
    """

    replay = None

    def __init__(self, config: PPOConfig, observation: int, action: int, normaliser_samples: int):
        self.config = config
        self.rollout = config.rollout
        self.normaliser = Normaliser(observation, normaliser_samples)
        self.actor = GaussianActor(observation, action, config.hidden, config.log_std)
        self.critic = Critic(observation, config.hidden, nn.ELU, layer_norm=False)
        self.policy = Policy(self.normaliser, self.actor, config.noise_correlation)
        self.learning_rate, self.steps = config.learning_rate, 0.0
        self.loss = ClipPPOLoss(
            for_loss(self.actor, IndependentNormal),
            TensorDictModule(self.critic, in_keys=["features"], out_keys=["state_value"]),
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy,
            critic_coeff=config.value,
            loss_critic_type="l2",
            normalize_advantage=False,
            functional=False,
        )
        self._latest = LatestOutput()
        self.actor.register_forward_hook(self._latest)
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimiser = torch.optim.Adam(parameters, lr=self.learning_rate, eps=ADAM_EPSILON, fused=True)

    @property
    def modules(self) -> dict[str, nn.Module]:
        """What a checkpoint holds, by name."""
        return {"normaliser": self.normaliser, "actor": self.actor, "critic": self.critic}

    @property
    def optimisers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimisers, by name."""
        return {"adam": self.optimiser}

    def counters(self) -> dict[str, float]:
        """The adapted learning rate, and environment steps that were learned from."""
        return {"learning_rate": self.learning_rate, "steps": self.steps}

    def set_counters(self, counters: dict[str, float]) -> None:
        """Restore `counters`."""
        self.set_learning_rate(counters["learning_rate"])
        self.steps = counters.get("steps", 0.0)  # earlier versions did not count

    def set_learning_rate(self, value: float) -> None:
        """Use `value` from the next gradient step on."""
        self.learning_rate = value
        for group in self.optimiser.param_groups:
            group["lr"] = value

    def update(self, batch: TensorDictBase, stop: Stop = never) -> dict[str, float]:
        """Learn from a batch (N, T) and return the means of the losses by name; nothing if `stop` said yes.

        The very first batch only sets the normaliser, since unscaled observations would teach nothing good.
        """
        if self.normaliser.count == 0 and not self.normaliser.frozen:
            self.normaliser.update(batch["observation"])
            return {}
        self.steps += batch.numel()
        data = transitions(batch, self.normaliser, self.critic, self.config)
        losses: list[Tensor] = []
        divergences: list[Tensor] = []
        for _ in range(self.config.epochs):
            divergences.clear()
            for index in torch.randperm(len(data)).split(self.config.minibatch):
                if stop():
                    self.normaliser.update(batch["observation"])
                    return {}
                values = self._step(data[index])
                losses.append(values)
                divergences.append(values[-1])
        divergence = float(torch.stack(divergences).mean())
        self.set_learning_rate(adapted(self.learning_rate, divergence, self.config))
        means = torch.stack(losses).mean(0).tolist()
        self.normaliser.update(batch["observation"])
        names = ("policy", "value", "entropy", "bound", "clip_fraction", "grad_norm", "correction")
        return dict(zip(names, means[:-1], strict=True)) | {
            "kl": divergence,
            "learning_rate": self.learning_rate,
            "action_std": float(self.actor.log_std.detach().exp().mean()),
            "explained_variance": float(data["explained"][0]),
        }

    def _step(self, minibatch: TensorDict) -> Float[Tensor, " 8"]:
        """One gradient step; returns the losses, the gradient's norm and the divergence."""
        minibatch["advantage"] = standardised(minibatch["advantage"])
        out = self.loss(minibatch)
        bound = excess(self._latest.mean)
        total = out["loss_objective"] + out["loss_entropy"] + out["loss_critic"]
        total = total + self.config.bound * bound + pull(self.config, self.steps) * squared(self._latest.mean)
        check_loss("loss", total)
        self.optimiser.zero_grad()
        total.backward()
        norm = nn.utils.clip_grad_norm_(self.actor.parameters(), self.config.grad_norm)
        critic_norm = nn.utils.clip_grad_norm_(self.critic.parameters(), self.config.grad_norm)
        check_loss("gradient of the actor", norm)
        check_loss("gradient of the critic", critic_norm)
        self.optimiser.step()
        with torch.no_grad():
            self.actor.log_std.clamp_(self.config.log_std_min, loudest(self.config, self.steps))
        names = ("loss_objective", "loss_critic", "entropy")
        values = [out[name].mean() for name in names] + [bound, out["clip_fraction"].mean(), norm]
        values += [self._latest.mean.detach().square().mean().sqrt()]
        return torch.stack([v.detach() for v in values] + [out["kl_approx"].detach().mean()])


@torch.no_grad()
def transitions(batch: TensorDictBase, normaliser: Normaliser, critic: Critic, config: PPOConfig) -> TensorDict:
    """A batch (N, T) as transitions (B,) with normalised observations, advantages and targets of the value."""
    features = normaliser(batch["observation"])
    following = normaliser(batch["next", "observation"])
    value, next_value = critic(features), critic(following)
    advantage, target = advantages(
        config.gamma,
        config.gae_lambda,
        value,
        next_value,
        batch["next", "reward"] * (1 - config.gamma),
        batch["next", "done"],
        batch["next", "terminated"],
    )
    explained = 1 - (target - value).var() / target.var().clamp_min(ADVANTAGE_FLOOR)
    return TensorDict(
        {
            "features": features,
            "action": batch["action"],
            "action_log_prob": batch["action_log_prob"],
            "advantage": advantage,
            "value_target": target,
            "explained": explained.expand_as(value[..., 0]),
        },
        batch_size=batch.shape,
    ).flatten()


def standardised(advantage: Float[Tensor, "b 1"]) -> Float[Tensor, "b 1"]:
    """Advantages with mean 0 and deviation 1."""
    return (advantage - advantage.mean()) / (advantage.std(correction=0) + ADVANTAGE_FLOOR)


def excess(mean: Float[Tensor, "*b a"]) -> Float[Tensor, ""]:
    """Mean over the transitions of the squared excess of mean actions over [-1, 1]."""
    return (mean.abs() - 1).clamp_min(0).square().sum(-1).mean()


def squared(mean: Float[Tensor, "*b a"]) -> Float[Tensor, ""]:
    """Mean over the transitions of the squared mean actions, summed over their components."""
    return mean.square().sum(-1).mean()


def adapted(rate: float, divergence: float, config: PPOConfig) -> float:
    """The next learning rate, from the present one and the divergence [nats] that it led to."""
    if divergence > config.target_kl * KL_BAND:
        return max(rate / LEARNING_RATE_DOWN, config.learning_rate_min)
    if divergence < config.target_kl / KL_BAND:
        return min(rate * LEARNING_RATE_UP, config.learning_rate_max)
    return rate


def advantages(
    gamma: float,
    gae_lambda: float,
    value: Float[Tensor, "n t 1"],
    next_value: Float[Tensor, "n t 1"],
    reward: Float[Tensor, "n t 1"],
    done: Bool[Tensor, "n t 1"],
    terminated: Bool[Tensor, "n t 1"],
) -> tuple[Float[Tensor, "n t 1"], Float[Tensor, "n t 1"]]:
    """Generalised advantages and value targets (Schulman et al. 2016).

    A truncated episode bootstraps from `next_value` of its true last observation, a terminated one does not.
    """
    advantage, target = generalized_advantage_estimate(
        gamma, gae_lambda, value, next_value, reward, done=done, terminated=terminated
    )
    return advantage, target
