"""Settings of a run: what `config.yaml` holds, and their digest."""

import dataclasses
import hashlib
import json
from dataclasses import dataclass, field
from typing import Any

AGENTS = ("ppo", "sac", "mappo", "happo")
"""Names of the learners."""
SINGLE_ARM_AGENTS = ("ppo", "sac")
"""Names of the learners for tasks with one arm."""
GUIDANCES = ("affordance", "none")
"""Values of the switch guidance."""


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation (Schulman et al. 2017) with an adaptive learning rate."""

    rollout: int = 32
    """Control steps per environment and iteration."""
    epochs: int = 4
    """Passes over each batch."""
    minibatch: int = 512
    """Transitions per gradient step."""
    gamma: float = 0.98
    """Discount per control step."""
    gae_lambda: float = 0.95
    """Decay of the generalised advantage estimate."""
    clip: float = 0.2
    """Half width of the trust interval of the probability ratio."""
    entropy: float = 1e-3
    """Weight of the entropy bonus."""
    value: float = 1.0
    """Weight of the value loss."""
    bound: float = 5e-3
    """Weight of the penalty on mean actions outside [-1, 1]."""
    grad_norm: float = 1.0
    """The gradients of actor and critic are each scaled down to this norm."""
    learning_rate: float = 5e-4
    """First learning rate of Adam."""
    learning_rate_min: float = 1e-5
    """Smallest learning rate that the adaptation chooses."""
    learning_rate_max: float = 1e-3
    """Largest learning rate that the adaptation chooses."""
    target_kl: float = 0.015
    """Divergence of successive policies, nats, at which the learning rate is kept."""
    log_std: float = -0.7
    """First logarithm of the exploration noise, in units of the action range's half width."""
    log_std_min: float = -3.0
    """Smallest logarithm of the exploration noise."""
    noise_correlation: float = 0.0
    """Correlation of the exploration noise of successive steps, in [0, 1)."""
    hidden: tuple[int, ...] = (256, 128)
    """Widths of the hidden layers of actor and critic."""


@dataclass(frozen=True)
class SACConfig:
    """Soft actor-critic (Haarnoja et al. 2018) with layer-normalised critics and learned temperature."""

    rollout: int = 16
    """Control steps per environment and iteration."""
    batch: int = 256
    """Transitions per gradient step."""
    updates_per_step: float = 1 / 32
    """Gradient steps per environment step."""
    warmup: int = 4000
    """Environment steps before the first gradient step."""
    critic_only: int = 500
    """Gradient steps of the critics before the first one of actor and temperature."""
    capacity: int = 400_000
    """Transitions in the replay buffer."""
    gamma: float = 0.97
    """Discount per control step."""
    n_step: int = 5
    """Control steps over which targets sum rewards before they bootstrap."""
    learning_rate: float = 5e-4
    """Learning rate of the critics."""
    learning_rate_actor: float = 3e-4
    """Learning rate of the actor."""
    learning_rate_alpha: float = 1e-3
    """Learning rate of the temperature."""
    alpha: float = 1e-3
    """First temperature, in units of mean reward per nat."""
    target_entropy: float = -1.0
    """Target entropy of the policy, nats per action dimension."""
    prior: float = 0.05
    """Weight of the squared mean action (before the tanh), in units of mean reward: pulls towards no correction."""
    polyak: float = 0.03
    """Share by which the target critics follow the critics at each gradient step."""
    log_std_max: float = -1.1
    """Largest logarithm of the exploration noise before the tanh; a new policy is 0.13 below it."""
    noise_correlation: float = 0.0
    """Correlation of the exploration noise of successive steps, in [0, 1)."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides the outcome of a run."""

    env: str
    """Task id."""
    agent: str
    """Learner."""
    guidance: str
    """`affordance` or `none`."""
    seed: int = 0
    """Seed of everything random."""
    total_steps: int = 300_000
    """Environment steps, summed over all environments."""
    num_envs: int = 32
    """Environments in each worker."""
    workers: int = 1
    """Worker processes; 0 collects in the main process."""
    learner_threads: int = 1
    """Threads of the learner; more help on idle cores and cost much on busy ones (they wait by spinning)."""
    eval_every: int = 50_000
    """Environment steps between evaluations."""
    eval_episodes: int = 64
    """Episodes of a periodic evaluation."""
    final_episodes: int = 200
    """Episodes of the last evaluation, which `result.json` reports."""
    eval_envs: int = 32
    """Environments of the evaluation task."""
    stop_success: float | None = None
    """End when two successive evaluations reach this success rate."""
    checkpoint_seconds: float = 15.0
    """Wall time between checkpoints, s."""
    normaliser_samples: int = 300_000
    """Observations after which the observation normaliser stays as it is."""
    stagger: bool = True
    """End the first episodes at random steps, so that resets spread over time."""
    task: dict[str, Any] = field(default_factory=dict)
    """Further arguments of the task, such as `preset` and `guidance_parts`."""
    learner: PPOConfig | SACConfig = field(default_factory=PPOConfig)
    """Settings of the learner."""

    @property
    def has_prior(self) -> bool:
        """Whether actions correct a reference, so that zero actions are a policy worth measuring."""
        parts = self.task.get("guidance_parts")
        return self.guidance == "affordance" and (parts is None or "prior" in parts)

    def digest(self) -> str:
        """Twelve hexadecimal digits that differ between settings; `total_steps` may grow and is left out."""
        content = dataclasses.asdict(self)
        del content["total_steps"]
        if not content["task"]:
            del content["task"]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:12]


LEARNER_CONFIGS: dict[str, type[PPOConfig] | type[SACConfig]] = {"ppo": PPOConfig, "sac": SACConfig}
"""Settings by name of the learner."""


def config_from_dict(content: dict[str, Any]) -> RunConfig:
    """Rebuild a `RunConfig` from what `dataclasses.asdict` made of it.

    Raises:
        TypeError, KeyError: if names are missing or unknown.
    """
    fields: dict[str, Any] = dict(content)
    learner: dict[str, Any] = dict(fields["learner"])
    learner["hidden"] = tuple(learner["hidden"])
    fields["learner"] = LEARNER_CONFIGS[fields["agent"]](**learner)
    return RunConfig(**fields)
