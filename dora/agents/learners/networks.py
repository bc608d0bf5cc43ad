"""Networks of the learners: observation normaliser, actors, critics and the policy that acts with them."""

import itertools
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from tensordict import TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn

from dora.agents.agent_columns import Agents

CLIP = 6.0
"""Bound of normalised observations, in standard deviations [1]."""
VARIANCE_FLOOR = 1e-4
"""Smallest variance of an observation, which keeps components that never change finite."""
FIRST_OUTPUT_SCALE = 0.05
"""Factor on the initial weights of the last layer, so that a new network returns about zero [1]."""
LOG_STD_MIN = -4.0
"""Smallest state-dependent log standard deviation, before the tanh [1]."""
LOG_STD_START = 2.0
"""Output of a new actor that stands for a log standard deviation 0.13 below its bound [1]."""
TANH_MARGIN = 1e-6
"""Margin that keeps log(1 - tanh^2) finite [1]."""


def mlp(sizes: Sequence[int], activation: type[nn.Module], layer_norm: bool = False) -> nn.Sequential:
    """Fully connected network with `sizes` = (input, hidden ..., output) and no activation at the end."""
    layers: list[nn.Module] = []
    for width_in, width_out in itertools.pairwise(sizes[:-1]):
        layers.append(nn.Linear(width_in, width_out))
        if layer_norm:
            layers.append(nn.LayerNorm(width_out))
        layers.append(activation())
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


class Normaliser(nn.Module):
    """Shifts and scales observations by their running mean and variance, clipped to +-6.

    Moments are merged by Chan, Golub and LeVeque (1979) in float64 and stop changing after `max_count` rows.
    """

    mean: Tensor
    var: Tensor
    count: Tensor
    shift: Tensor
    scale: Tensor

    def __init__(self, size: int, max_count: int = 300_000):
        super().__init__()
        self.max_count = max_count
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    @property
    def frozen(self) -> bool:
        """Whether the moments have stopped changing."""
        return self.count.item() >= self.max_count

    @torch.no_grad()
    def update(self, observations: Float[Tensor, "*rows o"]) -> None:
        """Merge the moments of a batch, unless frozen."""
        if self.frozen:
            return
        rows = observations.reshape(-1, observations.shape[-1]).double()
        count = self.count + len(rows)
        var, mean = torch.var_mean(rows, 0, correction=0)
        delta = mean - self.mean
        share = len(rows) / count
        self.var.copy_(self.var * (1 - share) + var * share + delta.square() * share * (1 - share))
        self.mean.add_(delta * share)
        self.count.copy_(count)
        self.shift.copy_(self.mean)
        self.scale.copy_((self.var + VARIANCE_FLOOR).rsqrt())

    def forward(self, observations: Float[Tensor, "*rows o"]) -> Float[Tensor, "*rows o"]:
        """Normalised observations."""
        return ((observations - self.shift) * self.scale).clamp(-CLIP, CLIP)


class LatestOutput:
    """Forward hook of an actor: keeps the mean and standard deviation of its latest pass, which losses hide and of
    which penalties on the mean are made. A copy in another process begins without."""

    def __init__(self):
        self.mean, self.std = torch.empty(0), torch.empty(0)

    def __call__(self, module: nn.Module, inputs: object, outputs: tuple[Tensor, Tensor]) -> None:
        self.mean, self.std = outputs

    def __reduce__(self) -> tuple[type["LatestOutput"], tuple[()]]:
        return LatestOutput, ()


class GaussianActor(nn.Module):
    """Mean from a network, standard deviation a parameter: the actor of PPO."""

    def __init__(self, observation: int, action: int, hidden: Sequence[int], log_std: float):
        super().__init__()
        self.mean = mlp((observation, *hidden, action), nn.ELU)
        _start_near_zero(self.mean)
        self.log_std = nn.Parameter(torch.full((action,), log_std))

    def forward(self, features: Float[Tensor, "*n o"]) -> tuple[Float[Tensor, "*n a"], Float[Tensor, "*n a"]]:
        """Mean and standard deviation of the action."""
        mean = self.mean(features)
        return mean, self.log_std.exp().expand_as(mean)

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return self.log_std.shape[0]

    def act(
        self, features: Float[Tensor, "n o"], noise: Float[Tensor, "n a"] | None
    ) -> tuple[Float[Tensor, "n a"], Float[Tensor, " n"]]:
        """Action and its log probability; without noise the mean."""
        mean, std = self(features)
        if noise is None:
            return mean, torch.zeros(len(mean))
        return mean + std * noise, _log_normal(noise, std)


class TanhActor(nn.Module):
    """Mean and standard deviation from a network, squashed by tanh: the actor of SAC.

    The log standard deviation is log_std_max - softplus(-x), which keeps a gradient at its bound, and never falls
    below -4. A new actor is near the bound, so the reward for entropy cannot add noise before critics object.
    """

    def __init__(self, observation: int, action: int, hidden: Sequence[int], log_std_max: float):
        super().__init__()
        self.log_std_max = log_std_max
        self.net = mlp((observation, *hidden, 2 * action), nn.ReLU)
        _start_near_zero(self.net)
        with torch.no_grad():
            last_layer(self.net).bias[action:] = LOG_STD_START

    def forward(self, features: Float[Tensor, "*n o"]) -> tuple[Float[Tensor, "*n a"], Float[Tensor, "*n a"]]:
        """Mean and standard deviation before the tanh."""
        mean, raw = self.net(features).chunk(2, -1)
        return mean, (self.log_std_max - nn.functional.softplus(-raw)).clamp_min(LOG_STD_MIN).exp()

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return last_layer(self.net).out_features // 2

    def act(
        self, features: Float[Tensor, "n o"], noise: Float[Tensor, "n a"] | None
    ) -> tuple[Float[Tensor, "n a"], Float[Tensor, " n"]]:
        """Action and its log probability; without noise the tanh of the mean."""
        mean, std = self(features)
        if noise is None:
            return mean.tanh(), torch.zeros(len(mean))
        action = (mean + std * noise).tanh()
        jacobian = (1 - action.square() + TANH_MARGIN).log().sum(-1)
        return action, _log_normal(noise, std) - jacobian


class JointActor(nn.Module):
    """An actor for each agent of a task: each sees its columns of the observation and gives its columns of the action.

    Args:
        agents: columns of each agent, by name.
        hidden: widths of the hidden layers of each actor.
        log_std: first logarithm of the exploration noise.
    """

    def __init__(self, agents: Agents, hidden: Sequence[int], log_std: float):
        super().__init__()
        self.agents = dict(agents)
        self.actors = nn.ModuleDict(
            {name: GaussianActor(len(c.observation), len(c.action), hidden, log_std) for name, c in agents.items()}
        )

    def of(self, name: str) -> GaussianActor:
        """The actor of an agent."""
        actor = self.actors[name]
        assert isinstance(actor, GaussianActor)
        return actor

    @property
    def action_size(self) -> int:
        """Number of action components, of all agents."""
        return sum(len(columns.action) for columns in self.agents.values())

    def act(
        self, features: Float[Tensor, "n o"], noise: Float[Tensor, "n a"] | None
    ) -> tuple[Float[Tensor, "n a"], Float[Tensor, "n agents"]]:
        """Joint action, and the log probability of each agent's part; without noise the means."""
        action, log_probs = features.new_zeros(len(features), self.action_size), []
        for name, columns in self.agents.items():
            mine = list(columns.action)
            own = None if noise is None else noise[:, mine]
            action[:, mine], log_prob = self.of(name).act(features[:, list(columns.observation)], own)
            log_probs.append(log_prob)
        return action, torch.stack(log_probs, -1)


class Critic(nn.Module):
    """Value of its inputs, joined along the last axis: (..., O) for V or (..., O), (..., A) for Q."""

    def __init__(self, size: int, hidden: Sequence[int], activation: type[nn.Module], layer_norm: bool):
        super().__init__()
        self.net = mlp((size, *hidden, 1), activation, layer_norm)
        _start_near_zero(self.net)

    def forward(self, *inputs: Float[Tensor, "*n _"]) -> Float[Tensor, "*n 1"]:
        """The value, in units of reward."""
        return self.net(inputs[0] if len(inputs) == 1 else torch.cat(inputs, -1))


class Policy(TensorDictModuleBase):
    """Normaliser and actor, as collectors and evaluation call them: reads `observation`, writes `action`.

    Under `InteractionType.DETERMINISTIC` it is greedy (mean action), otherwise it samples and also writes
    `action_log_prob`. With `noise_correlation` c > 0 the noise is e_t = c e_(t-1) + sqrt(1 - c^2) x_t,
    whose marginal is standard normal; the log probability is that of the marginal, an approximation
    (as in Hollenstein et al. 2024, Colored Noise in PPO) that ignores what the previous noise tells.

    `action_log_prob` is (n,), or (n, agents) of an actor for each agent.
    """

    def __init__(
        self, normaliser: Normaliser, actor: GaussianActor | TanhActor | JointActor, noise_correlation: float = 0.0
    ):
        super().__init__()
        self.in_keys, self.out_keys = ["observation"], ["action", "action_log_prob"]
        self.normaliser, self.actor, self.noise_correlation = normaliser, actor, noise_correlation
        self._noise: Tensor | None = None

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action of each row of `tensordict`."""
        greedy = interaction_type() is InteractionType.DETERMINISTIC
        features = self.normaliser(tensordict.get("observation"))
        action, log_prob = self.actor.act(features, None if greedy else self._draw(features))
        tensordict.set("action", action)
        tensordict.set("action_log_prob", log_prob)
        return tensordict

    @torch.no_grad()
    def greedy(self, observation: Float[Tensor, "n o"]) -> Float[Tensor, "n a"]:
        """The mean action (for PPO unclipped)."""
        return self.actor.act(self.normaliser(observation), None)[0]

    def _draw(self, features: Float[Tensor, "n o"]) -> Float[Tensor, "n a"]:
        shape = (len(features), self.action_size)
        fresh = torch.randn(shape)
        c = self.noise_correlation
        if c > 0.0:
            if self._noise is not None and self._noise.shape == shape:
                fresh = c * self._noise + math.sqrt(1 - c * c) * fresh
            self._noise = fresh
        return fresh

    @property
    def modules_by_name(self) -> dict[str, nn.Module]:
        """What it takes to act, under the names that checkpoints give."""
        return {"normaliser": self.normaliser, "actor": self.actor}

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return self.actor.action_size


def for_loss(actor: nn.Module, distribution: type) -> ProbabilisticTensorDictSequential:
    """An actor as TorchRL's losses want it: reads `features` (normalised observations), writes `action`."""
    sample = ProbabilisticTensorDictModule(
        in_keys=["loc", "scale"], out_keys=["action"], distribution_class=distribution, return_log_prob=True
    )
    parameters = TensorDictModule(actor, in_keys=["features"], out_keys=["loc", "scale"])
    return ProbabilisticTensorDictSequential(parameters, sample)  # pyright: ignore[reportCallIssue,reportArgumentType]


def _log_normal(noise: Float[Tensor, "n a"], std: Float[Tensor, "n a"]) -> Float[Tensor, " n"]:
    """Log density of mean + std * noise under N(mean, std)."""
    return (-0.5 * noise.square() - std.log() - 0.5 * math.log(2 * math.pi)).sum(-1)


def last_layer(net: nn.Sequential) -> nn.Linear:
    """The output layer of a network made by `mlp`."""
    layer = net[-1]
    assert isinstance(layer, nn.Linear)
    return layer


def _start_near_zero(net: nn.Sequential) -> None:
    with torch.no_grad():
        last_layer(net).weight.mul_(FIRST_OUTPUT_SCALE)
        last_layer(net).bias.zero_()
