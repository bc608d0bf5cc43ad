"""Settings of a run: what `config.yaml` holds, and their digest."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

import tyro

from dora.configs import built, overridden, plain
from dora.digests import digest_of
from dora.errors import InputError, shown
from dora.reading import read_yaml

Numbers = TypeVar("Numbers")
"""Numbers of the task: a dict of plain data, or the task's own dataclass on the command line."""
Settings = TypeVar("Settings")
"""Settings of the learner."""
Agent = TypeVar("Agent")
"""Name of the learner."""


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
    """Weight of the value loss. It matters only where `grad_norm` cuts the critic's gradient: actor and critic share no
    parameter, and Adam's steps do not depend on the scale of a loss."""
    bound: float = 5e-3
    """Weight of the penalty on mean actions outside [-1, 1]."""
    prior: float = 0.0
    """Weight of the squared mean action, summed over its components: pulls towards no correction where the advantage
    does not tell actions apart, such as those of an arm that has done its part."""
    prior_last: float | None = None
    """That weight from `prior_steps` on, up to which it falls geometrically; None: it does not change."""
    prior_steps: int = 100_000
    """Environment steps after which `prior_last` is reached."""
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
    log_std_last: float | None = None
    """Largest one from `log_std_steps` on, to which that falls evenly from `log_std`; None: 0 throughout."""
    log_std_steps: int = 1_000_000
    """Environment steps after which `log_std_last` is reached."""
    noise_correlation: float = 0.0
    """Correlation of the exploration noise of successive steps, in [0, 1)."""
    hidden: tuple[int, ...] = (256, 128)
    """Widths of the hidden layers of actor and critic."""


@dataclass(frozen=True)
class MAPPOConfig(PPOConfig):
    """PPO with an actor for each agent of the task and one critic that sees everything (Yu et al. 2022)."""


@dataclass(frozen=True)
class HAPPOConfig(PPOConfig):
    """MAPPO whose agents learn one after the other, each from what those before it became (Kuba et al. 2022)."""


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
    learning_rate_last: float | None = None
    """Share of the rates of critics and actor that is left from `learning_rate_steps` on; they fall to it evenly from a
    third of these steps on. None: they do not change."""
    learning_rate_steps: int = 300_000
    """Environment steps after which `learning_rate_last` is reached."""
    alpha: float = 1e-3
    """First temperature, in units of mean reward per nat."""
    target_entropy: float = -1.0
    """Target entropy of the policy, nats per action dimension."""
    prior: float = 0.05
    """Weight of the squared mean action (before the tanh), in units of mean reward: pulls towards no correction."""
    prior_last: float | None = None
    """That weight from `prior_steps` on, up to which it falls geometrically; None: it does not change."""
    prior_steps: int = 100_000
    """Environment steps after which `prior_last` is reached."""
    polyak: float = 0.03
    """Share by which the target critics follow the critics at each gradient step."""
    log_std_max: float = -1.1
    """Largest logarithm of the exploration noise before the tanh; a new policy is 0.13 below it."""
    noise_correlation: float = 0.0
    """Correlation of the exploration noise of successive steps, in [0, 1)."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""


NEUTRAL = {
    "definition": 1, "arm_effort": 1.0, "pose_filter": 1.0, "placed_after_overlap": 0.0, "reorient": "wrist",
    "observe_candidate": False, "hand_action": "joints", "overlap_range": 1.0,
    "hand_effort": 1.0, "wrist_speed": 1.0, "hand_speed": 1.0, "overlap_grace": 0.0,
    "misplaced": "candidates", "history": 0, "observe_correction": False,
}  # fmt: skip
"""Numbers of a task that settings of earlier versions lack, with the values at which they change nothing."""
NOT_USUAL = {name: NEUTRAL[name] for name in ("pose_filter", "observe_candidate")}
"""Those of them whose usual value is another one, for some task or preset: stored settings without them mean these."""
WITHOUT_EFFECT = {"turn": ("reorient", "wrist")}
"""The same of numbers that change nothing while another one has such a value."""
OF_A_PART = {"observe_candidate": "observation", "observe_correction": "prior"}
"""The same of numbers that change nothing without this part of guidance."""
UNUSED = {"reward": "dense", "after_success": None, "overlap_share": 1.0, "overlap_steps": 600_000}
"""The same of settings of the run."""
CONSTANT_PULL = {"prior_last": None, "prior_steps": 100_000}
"""Settings of a pull that does not change."""
CONSTANT_NOISE = {"log_std_last": None, "log_std_steps": 1_000_000}
"""Settings of noise that no schedule bounds."""
CONSTANT_RATES = {"learning_rate_last": None, "learning_rate_steps": 300_000}
"""Settings of learning rates that do not change."""
NEUTRAL_LEARNER = {
    **{name: {"prior": 0.0, **CONSTANT_PULL, **CONSTANT_NOISE} for name in ("ppo", "mappo", "happo")},
    "sac": {**CONSTANT_PULL, **CONSTANT_RATES},
}
"""The same of settings of each learner."""
TRAINING = frozenset((
    "stop_success", "eval_every", "eval_episodes", "normaliser_samples", "stagger", "after_success", "overlap_share",
    "overlap_steps",
))  # fmt: skip
"""Settings of a run that change its training or what is chosen of it, beside learner, task and environments."""
DIGITS = 12
"""Hexadecimal digits of a digest of settings."""
LEARNER_CONFIGS: dict[str, type[PPOConfig] | type[SACConfig]] = {
    "ppo": PPOConfig, "sac": SACConfig, "mappo": MAPPOConfig, "happo": HAPPOConfig
}  # fmt: skip
"""Settings of each learner."""


@dataclass(frozen=True)
class RunConfig(Generic[Numbers, Settings, Agent]):
    """Everything that decides the outcome of a run."""

    env: str
    """Task id, for example DoraCube-v1."""
    agent: Agent
    """Learner."""
    guidance: Literal["affordance", "grasps", "none"] = "affordance"
    """Use affordance maps and grasp candidates, candidates of a search that knows no region, or neither."""
    guidance_parts: tuple[Literal["observation", "reward", "filter", "prior"], ...] | None = None
    """Parts of guidance in force, for ablations; None: all of them."""
    preset: Literal["none", "standard", "hard"] = "standard"
    """How much episodes are randomised and perturbed."""
    reward: Literal["dense", "paper"] = "dense"
    """The task's reward, or the equations that the paper prints, with their errors corrected."""
    seed: int = 0
    """Seed of weights, exploration and initial states; with --eval-only of the starts (default: those that every run is
    evaluated on at its end)."""
    total_steps: int = 300_000
    """Budget in environment steps, summed over all environments."""
    num_envs: int = 32
    """Environments in EACH worker."""
    workers: int = 1
    """Worker processes; 0 collects in the main process."""
    learner_threads: int = 1
    """Threads of the learner; more help on idle cores and cost much on busy ones (they wait by spinning)."""
    eval_every: int = 50_000
    """Environment steps between evaluations during training."""
    eval_episodes: int = 64
    """Episodes of a periodic evaluation."""
    final_episodes: Annotated[int, tyro.conf.arg(name="episodes")] = 200
    """Episodes of the last evaluation, which `result.json` reports."""
    eval_envs: int = 32
    """Environments of the evaluation task."""
    stop_success: float | None = None
    """End early when two successive evaluations reach this success rate, 0 to 1."""
    checkpoint_seconds: float = 15.0
    """Wall time between checkpoints [s]."""
    normaliser_samples: int = 300_000
    """Observations after which the observation normaliser stays as it is."""
    stagger: bool = True
    """End the first episodes at random steps, so that resets spread over time."""
    after_success: int | None = None
    """Control steps after its first success at which an episode of the training is truncated, so that the budget goes
    into what has not been learned; None: it goes on to its limit. Evaluations always do."""
    overlap_share: float = 1.0
    """Share of the penalty for overlap that counts at the first step of the training; it grows geometrically to 1."""
    overlap_steps: int = 600_000
    """Environment steps after which all of it counts."""
    task: Numbers = field(default_factory=dict)  # pyright: ignore[reportAssignmentType]
    """Numbers of the task, all of them: weights, thresholds, randomisation, rates."""
    learner: Settings = field(default_factory=PPOConfig)  # pyright: ignore[reportAssignmentType]
    """Settings of the learner."""

    @property
    def has_prior(self) -> bool:
        """Whether actions are residuals of a reference, so that zero actions are a policy worth measuring."""
        return self.guidance != "none" and (self.guidance_parts is None or "prior" in self.guidance_parts)

    @property
    def task_options(self) -> dict[str, Any]:
        """Arguments with which the task is made; without numbers of the task, its own are in force."""
        parts = None if self.guidance_parts is None else list(self.guidance_parts)
        options: dict[str, Any] = {"guidance": self.guidance, "guidance_parts": parts, "preset": self.preset}
        options |= {"reward_mode": self.reward} if self.reward != "dense" else {}
        return options | ({"config": self.task} if self.task else {})

    def digest(self) -> str:
        """Twelve hexadecimal digits that differ between settings; `total_steps` may grow and is left out. So are the
        settings of `UNUSED` and the numbers of `NEUTRAL` and `NEUTRAL_LEARNER` that change nothing, for settings of
        versions that had no other."""
        return digest_of(_digested(plain(self)))[:DIGITS]


def _digested(content: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that enter a digest."""
    left_out = {"total_steps"} | {name for name, value in UNUSED.items() if content.get(name) == value}
    numbers = content.get("task", {})
    idle = {name for name, (other, value) in WITHOUT_EFFECT.items() if numbers.get(other, value) == value}
    parts = () if content.get("guidance") == "none" else content.get("guidance_parts")
    idle |= {name for name, part in OF_A_PART.items() if parts is not None and part not in parts}
    task = {name: value for name, value in numbers.items() if NEUTRAL.get(name) != value and name not in idle}
    neutral, learner = NEUTRAL_LEARNER.get(content.get("agent", ""), {}), content.get("learner", {})
    learner = {name: value for name, value in learner.items() if neutral.get(name) != value}
    kept = {name: value for name, value in content.items() if name not in left_out}
    return kept | {"task": task, "learner": learner}


def in_effect(numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers of a task with those that earlier versions lack, without those that change nothing beside the others."""
    whole = NEUTRAL | dict(numbers)
    idle = {name for name, (other, value) in WITHOUT_EFFECT.items() if whole.get(other) == value}
    return {name: value for name, value in whole.items() if name not in idle}


def stored_digests(content: Mapping[str, Any]) -> tuple[str, ...]:
    """The digests that settings may have been stored with: that of `RunConfig.digest`, that of versions that left no
    number of the task out, and that of the versions whose `task` held only preset and parts of guidance."""
    settings = _digested(content)
    whole = settings | {"task": content.get("task", {}), "learner": content.get("learner", {})}
    first = {name: value for name, value in settings.items() if name != "task" or value}
    text = json.dumps(first, sort_keys=True).encode()
    return digest_of(settings)[:DIGITS], digest_of(whole)[:DIGITS], hashlib.sha256(text).hexdigest()[:DIGITS]


def of_training(config: RunConfig) -> dict[str, Any]:
    """Settings of a training beside those of its learner and task, which tell runs apart that are no seeds of each
    other; those of the machine and of the last evaluation are left out."""
    names = TRAINING if config.overlap_share < 1 else TRAINING - {"overlap_steps"}
    return {name: getattr(config, name) for name in sorted(names)}


def config_from_dict(content: Any, source: str = "the settings") -> RunConfig:
    """Rebuild a `RunConfig` from what `dora.configs.plain` made of it, also of a version without numbers of the task.

    Args:
        content: plain data, as a file holds them.
        source: names them in messages.

    Raises:
        InputError: if names are missing or unknown, or a value has the wrong type.
    """
    if not isinstance(content, dict) or not all(isinstance(name, str) for name in content):
        raise InputError(f"{source} must be a mapping of names to values, not {shown(content)}.")
    content = upgraded(content, source)
    agent = content.get("agent")
    if not isinstance(agent, str) or agent not in LEARNER_CONFIGS:
        raise InputError(f"{source} name the learner {shown(agent)}; there are {', '.join(LEARNER_CONFIGS)}.")
    fields = dict(content, task={}, learner=None)
    values = {name: value for name, value in fields.items() if name not in ("task", "learner")}
    read: Any = built(RunConfig, values, source)
    learner = overridden(LEARNER_CONFIGS[agent](), content.get("learner", {}), f"learner of {source}")
    task = content.get("task", {})
    if not isinstance(task, dict):
        raise InputError(f"{source} have numbers of the task that are no mapping, but {shown(task)}.")
    if "randomisation" in task:  # all numbers are there, but those that later versions have
        task = NOT_USUAL | task
    return dataclasses.replace(read, task=task, learner=learner)


def upgraded(content: dict[str, Any], source: str = "the settings") -> dict[str, Any]:
    """Settings of a version whose `task` held only preset and parts of guidance, with the numbers that were in force.

    The numbers are those of `first_numbers.yaml`, written down when the tasks' numbers became settings.

    Raises:
        InputError: the preset is unknown.
    """
    if "preset" in content or not isinstance(content.get("task", {}), dict):
        return content
    options = dict(content.get("task", {}))
    preset = options.pop("preset", "standard")
    first = read_yaml(Path(__file__).parent / "first_numbers.yaml", "file of numbers")
    if preset not in list(first["presets"]):
        raise InputError(f"{source} name the preset {shown(preset)}; there are {', '.join(first['presets'])}.")
    env = content.get("env")
    numbers = first["tasks"].get(env) if isinstance(env, str) else None
    task = {} if numbers is None else {**numbers, "randomisation": first["presets"][preset]}
    return {**content, "preset": preset, "guidance_parts": options.pop("guidance_parts", None), "task": task}
