"""What a task makes of a snapshot: stages, success, reward and observation. Nothing here reads the simulator."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from mani_skill.envs.sapien_env import BaseEnv
from torch import Tensor

from dora.tasks.env.episode_memory import Episode
from dora.tasks.guidance.grasp_and_lift import Guide
from dora.tasks.mdp.guidance_parts import FILTER, REWARD
from dora.tasks.mdp.observations import OBSERVATIONS, Entry
from dora.tasks.mdp.rewards import Terms
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage, StageMachine

MM = 1000.0
"""Millimetres per metre."""
FALLEN = -0.05
"""Height below which the object has left the table [m]."""
KNOCKED_AWAY = 0.6
"""Horizontal distance from its start at which the object has been knocked out of reach [m]."""


class JudgedEnv(BaseEnv):
    """The part of a task that learners see, computed from `snapshot`, the stage machine and the episode's memory."""

    SUPPORTED_REWARD_MODES = ("dense", "normalized_dense", "sparse", "none", "paper")

    STAGES: ClassVar[Sequence[Stage[Any]]]
    """The sub-tasks, in order."""
    TERMS: ClassVar[Terms[Any]]
    """The reward's terms."""
    PAPER_TERMS: ClassVar[Terms[Any]]
    """The printed reward, corrected (`reward_mode="paper"`)."""
    EXTRA_OBSERVATIONS: ClassVar[Mapping[str, Entry]] = {}
    """Observation entries beyond `OBSERVATIONS`."""
    MAX_STEPS: ClassVar[int]
    """Episode limit [control steps]."""
    PENETRATION_LIMIT: ClassVar[float] = 0.005
    """Penetration that spoils an episode [m]."""

    parts: frozenset[str]
    guide: Guide
    episode: Episode
    machine: StageMachine
    observation_entries: dict[str, Entry]

    @property
    @abstractmethod
    def snapshot(self) -> Snapshot:
        """The state after the last control step or reset."""

    @property
    @abstractmethod
    def observed(self) -> Snapshot:
        """The same state as it is observed, with the preset's noise."""

    def _load_judgement(self) -> None:
        """Chooses reward terms and observation entries, and starts the stages."""
        terms = self.PAPER_TERMS if self._reward_mode == "paper" else self.TERMS
        self._terms = terms if REWARD in self.parts else terms.without_guidance()
        entries = {**OBSERVATIONS, **self.EXTRA_OBSERVATIONS}
        self.observation_entries = {k: e for k, e in entries.items() if e.exists(self.parts)}
        self.machine = StageMachine(self.STAGES, self.num_envs, self.device)

    # ------------------------------------------------ the protocol of learners

    @property
    def max_steps(self) -> int:
        """Episode limit [control steps]."""
        return self.MAX_STEPS

    @property
    def stage_names(self) -> tuple[str, ...]:
        """Names of the stages, in order."""
        return tuple(stage.name for stage in self.STAGES)

    @property
    def logged(self) -> tuple[str, ...]:
        """Names of the (n,) tensors in `step`'s info that are worth a curve."""
        stages = [f"stage/{name}" for name in self.stage_names]
        names = (*(f"reward/{name}" for name in self._terms.terms), *stages, "penetration_mm", "finished")
        return (*names, "unreachable") if FILTER in self.parts else names

    # ---------------------------------------------------- evaluation, reward

    @property
    def over_penetrated(self) -> Tensor:
        """(n,) bool: the episode's deepest penetration is above the task's limit."""
        return self.episode.max_penetration > self.PENETRATION_LIMIT

    @property
    def unreachable(self) -> Tensor:
        """(n,) bool: no candidate could be reached when the episode began. Such an episode fails at once and earns
        nothing (paper, Motion-Feasibility Filtering); never so without that part of guidance."""
        none_left = self.guide.choice.buffers["reachable"] == 0
        return none_left if FILTER in self.parts else torch.zeros_like(none_left)

    def evaluate(self) -> dict[str, Tensor]:
        """Success: all stages done, no overlap above the limit, and no failure now, as of a jug that is dropped again.

        Idempotent: reset and wrappers call it too, so it moves nothing.
        """
        finished, fail = self.machine.finished, self.failed(self.snapshot) | self.unreachable
        info = {
            "success": finished & ~self.over_penetrated & ~fail,
            "fail": fail,
            "unreachable": self.unreachable,
            "finished": finished,
            "stage": self.machine.index.clone(),
            "penetration_mm": self.episode.penetration * MM,
            "penetration_max_mm": self.episode.max_penetration * MM,
        }
        for k, stage in enumerate(self.machine.stages):
            info[f"stage/{stage.name}"] = self.machine.furthest > k
        return info

    def failed(self, s: Snapshot) -> Tensor:
        """(n,) bool: the object has left the table or the robot's reach; nothing can mend the episode."""
        away = (s.object_p[:, :2] - s.start_p[:, :2]).norm(dim=-1)
        return (s.object_p[:, 2] < FALLEN) | (away > KNOCKED_AWAY)

    def compute_dense_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """Sum of the terms (n,); each one's share goes into `info["reward/<name>"]`."""
        total, parts = self._terms(self.snapshot)
        weight = (~self.unreachable).float()
        info.update({f"reward/{name}": weight * value for name, value in parts.items()})
        return weight * total

    def compute_normalized_dense_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """The dense reward over its largest possible value."""
        return self.compute_dense_reward(obs, action, info) / self._terms.upper

    def get_reward(self, obs: Any, action: Any, info: dict) -> Tensor:
        """(n,) reward of the chosen mode; "paper" sums the printed terms."""
        if self._reward_mode == "paper":
            return self.compute_dense_reward(obs, action, info)
        return super().get_reward(obs, action, info) * ~self.unreachable

    # ----------------------------------------------------------- observation

    def _get_obs_agent(self) -> dict[str, Tensor]:
        return {}

    def _get_obs_extra(self, info: dict) -> dict[str, Tensor]:
        s = self.observed
        return {name: entry.value(s) for name, entry in self.observation_entries.items()}

    def _flatten_raw_obs(self, obs: Any) -> Any:
        if self._obs_mode == "state":
            return torch.cat(list(obs["extra"].values()), -1)
        return super()._flatten_raw_obs(obs)
