"""Soft actor-critic with TorchRL's `SACLoss` and a replay buffer."""

from typing import Any

import torch
from jaxtyping import Float
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators

from dora.agents.config import SACConfig
from dora.agents.learners.finite import check_loss
from dora.agents.learners.networks import Critic, LatestOutput, Normaliser, Policy, TanhActor, for_loss
from dora.agents.learners.replay import Replay
from dora.agents.learners.schedules import pull, rates_left
from dora.agents.learners.stopping import Stop, never

CRITICS = 2
"""Of which the smaller value counts (Fujimoto et al. 2018)."""
ACTOR_PERIOD = 2
"""Gradient steps of the critics per gradient step of actor and temperature."""
FLOAT, OTHERS = 4, 64
"""Size of a number of a transition, and of what it holds besides observations and action, at most [bytes]."""


class FasterLoss(SACLoss):
    """TorchRL's loss, whose critics are evaluated with their stacked parameters as these are.

    TorchRL puts the parameters of one critic after the other into a module and takes them out again, which takes as
    long as the products of matrices. (A batched product, its other way, is slower than two products on one core.)
    """

    def _make_vmap(self) -> None:
        super()._make_vmap()
        net: Any = self.qvalue_network.module.net
        self._layers: list[tuple[str, nn.Module]] = list(net.named_children())
        self._vmap_qnetworkN0 = self._both_values

    def _both_values(self, inputs: TensorDictBase, parameters: TensorDictBase) -> TensorDict:
        """Values (2, B, 1) of features (B, F) and actions (B, A), by parameters (2, ...) of two critics."""
        both = [torch.cat([inputs.get("features"), inputs.get("action")], -1)] * CRITICS
        stacked = parameters.get("module").get("net")
        for name, layer in self._layers:
            if isinstance(layer, nn.Linear | nn.LayerNorm):
                own = stacked.get(name)
                each = zip(both, own.get("weight").unbind(0), own.get("bias").unbind(0), strict=True)
                both = [_through(layer, x, weight, bias) for x, weight, bias in each]
            else:
                both = [layer(x) for x in both]
        return TensorDict({"state_action_value": torch.stack(both)}, [CRITICS, *inputs.batch_size])


def _through(layer: nn.Linear | nn.LayerNorm, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """What a layer with other parameters makes of an input."""
    if isinstance(layer, nn.Linear):
        return nn.functional.linear(x, weight, bias)
    return nn.functional.layer_norm(x, layer.normalized_shape, weight, bias, layer.eps)


class SAC:
    """Adds each batch to the replay buffer, then takes `updates_per_step` gradient steps per transition.

    Observations are stored as they are and normalised when sampled. Truncated episodes bootstrap from their
    true last observation, because targets look at `terminated` only. Rewards are multiplied by 1 - gamma, so that
    a value is a discounted mean of rewards, whose size does not depend on the horizon. The actor is left alone
    until the critics have taken `critic_only` gradient steps on data of the first policy, and `prior` times the
    squared mean correction (before the tanh) is added to its loss.
    """

    def __init__(self, config: SACConfig, observation: int, action: int, normaliser_samples: int):
        self.config = config
        self.rollout = config.rollout
        self.normaliser = Normaliser(observation, normaliser_samples)
        self.actor = TanhActor(observation, action, config.hidden, config.log_std_max)
        self.policy = Policy(self.normaliser, self.actor, config.noise_correlation)
        self.loss = FasterLoss(
            for_loss(self.actor, TanhNormal),
            TensorDictModule(
                Critic(observation + action, config.hidden, nn.ReLU, layer_norm=True),
                in_keys=["features", "action"],
                out_keys=["state_action_value"],
            ),
            loss_function="l2",
            alpha_init=config.alpha,
            target_entropy=config.target_entropy * action,
            deactivate_vmap=True,
        )
        self.loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        self._soft_update = SoftUpdate(self.loss, tau=config.polyak)  # makes the targets, and says how they follow
        self.actor_parameters = _leaves(self.loss.actor_network_params)
        self.critic_parameters = _leaves(self.loss.qvalue_network_params)
        self._targets = _leaves(self.loss.target_qvalue_network_params)
        log_alpha: Any = self.loss.log_alpha
        self.optimisers: dict[str, torch.optim.Optimizer] = {
            "actor_adam": torch.optim.Adam(self.actor_parameters, lr=config.learning_rate_actor, fused=True),
            "critic_adam": torch.optim.Adam(self.critic_parameters, lr=config.learning_rate, fused=True),
            "alpha_adam": torch.optim.Adam([log_alpha], lr=config.learning_rate_alpha, fused=True),
        }
        self.replay = Replay(config.capacity, config.batch, FLOAT * (2 * observation + action) + OTHERS)
        self._latest = LatestOutput()
        self.actor.register_forward_hook(self._latest)
        self.updates, self.due = 0, 0.0

    @property
    def modules(self) -> dict[str, nn.Module]:
        """What a checkpoint holds, by name."""
        return {"normaliser": self.normaliser, "actor": self.actor, "loss": self.loss}

    @property
    def prior(self) -> float:
        """Weight of the pull towards no correction at this moment."""
        return pull(self.config, float(self.replay.added))

    def counters(self) -> dict[str, float]:
        """Gradient steps taken and due, transitions seen."""
        return {"updates": float(self.updates), "due": self.due, "added": float(self.replay.added)}

    def set_counters(self, counters: dict[str, float]) -> None:
        """Restore `counters`."""
        self.updates, self.due = int(counters["updates"]), counters["due"]
        self.replay.added = int(counters["added"])

    def update(self, batch: TensorDictBase, stop: Stop = never) -> dict[str, float]:
        """Store a batch (N, T), learn from the replay buffer and return the means of the losses by name.

        Gradient steps that are left when `stop` says yes stay due, and are taken after the next batch.
        """
        stored = multi_step(batch, self.config.n_step, self.config.gamma)
        stored["next", "reward"] *= 1 - self.config.gamma
        self.replay.extend(stored.reshape(-1))
        self.normaliser.update(batch["observation"])
        if self.replay.added < self.config.warmup:
            return {"replay": float(len(self.replay))}
        self.due += batch.numel() * self.config.updates_per_step
        self._set_rates()
        critic: list[Tensor] = []
        actor: list[Tensor] = []
        while self.due >= 1.0 and not stop():
            self.due -= 1.0
            sample = self._sample()
            critic.append(self._learn_critic(sample))
            if self.updates >= self.config.critic_only and self.updates % ACTOR_PERIOD == 0:
                actor.append(self._learn_actor(sample))
            self._follow()
            self.updates += 1
        values = {"updates": float(self.updates), "replay": float(len(self.replay))}
        values["learning_rate"] = float(self.optimisers["actor_adam"].param_groups[0]["lr"])
        if critic:
            values["qvalue"] = float(torch.stack(critic).mean())
        if actor:
            names = ("actor", "alpha", "entropy", "action_std", "correction")
            values |= dict(zip(names, torch.stack(actor).mean(0).tolist(), strict=True))
        return values

    def _set_rates(self) -> None:
        left = rates_left(self.config, float(self.replay.added))
        rates = {"actor_adam": self.config.learning_rate_actor, "critic_adam": self.config.learning_rate}
        for name, rate in rates.items():
            for group in self.optimisers[name].param_groups:
                group["lr"] = left * rate

    @torch.no_grad()
    def _sample(self) -> TensorDict:
        sample = self.replay.sample()
        sample["features"] = self.normaliser(sample["observation"])
        sample["next", "features"] = self.normaliser(sample["next", "observation"])
        return sample

    def _learn_critic(self, sample: TensorDict) -> Tensor:
        loss, _ = self.loss.qvalue_v2_loss(sample)
        _descend(self.optimisers["critic_adam"], loss, "loss of the critics")
        return loss.detach()

    @torch.no_grad()
    def _follow(self) -> None:
        """Move the targets towards the critics, as `SoftUpdate.step` does, without its tensordicts."""
        for theirs, ours in zip(self._targets, self.critic_parameters, strict=True):
            theirs.lerp_(ours, 1 - self._soft_update.eps)

    def _alpha(self) -> Tensor:
        log_alpha: Any = self.loss.log_alpha
        return log_alpha.detach().exp()

    def _learn_actor(self, sample: TensorDict) -> Tensor:
        loss, metadata = self.loss.actor_loss(sample)
        mean, std = self._latest.mean, self._latest.std
        total = loss + self.prior * mean.square().sum(-1).mean()
        _descend(self.optimisers["actor_adam"], total, "loss of the actor")
        log_prob = metadata["log_prob"]
        alpha_loss = self.loss.alpha_loss(log_prob).mean()
        _descend(self.optimisers["alpha_adam"], alpha_loss, "loss of the temperature")
        size = mean.detach().tanh().square().mean().sqrt()
        return torch.stack([loss.detach(), self._alpha(), -log_prob.mean(), std.detach().mean(), size])


def multi_step(batch: TensorDictBase, steps: int, gamma: float) -> TensorDict:
    """Transitions over up to `steps` control steps, from a batch (N, T) of single ones.

    The reward is sum_k gamma^k r_(t+k) over k < n, where n is `steps` or less if the episode or the batch ends
    before; `next` is what follows the n-th step, and `steps_to_next_obs` (N, T, 1) is n. (TorchRL's `MultiStep`
    keeps the `terminated` of the first step and would bootstrap beyond a failure.)
    """
    rows, length = batch.shape
    reward, done = batch["next", "reward"], batch["next", "done"]
    total: Float[Tensor, "n t 1"] = reward.clone()
    last = torch.arange(length).expand(rows, length).clone()
    going = ~done
    for k in range(1, min(steps, length)):
        more = going[:, :-k]
        total[:, :-k] += gamma**k * reward[:, k:] * more
        last[:, :-k] += more[..., 0]
        going[:, :-k] &= ~done[:, k:]
    each = torch.arange(rows)[:, None], last
    names = ("observation", "done", "terminated")
    following = TensorDict({name: batch["next", name][each] for name in names}, batch_size=batch.shape)
    return TensorDict(
        {
            "observation": batch["observation"].clone(),
            "action": batch["action"].clone(),
            "steps_to_next_obs": (last - torch.arange(length) + 1)[..., None],
            "next": following.set("reward", total),
        },
        batch_size=batch.shape,
    )


def _leaves(parameters: Any) -> list[Any]:
    return list(parameters.values(include_nested=True, leaves_only=True))


def _descend(optimiser: torch.optim.Optimizer, loss: Tensor, name: str) -> None:
    check_loss(name, loss)
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
