"""A batched task as a TorchRL environment, with the statistics of its episodes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from dora.agents.agent_columns import AgentColumns, checked_agents
from dora.agents.seeds import seeds_for
from dora.errors import InputError


@runtime_checkable
class Task(Protocol):
    """N environments of one task stepped together; what every learner of Dora is written against.

    `reset` and `step` return observations (N, O) float32. `step` returns reward (N,), terminated (N,),
    truncated (N,) and an info with `success` (N,) bool (whether the episode so far counts as a success),
    optionally `fail` (N,) bool (the episode cannot go on) and every name of `logged`, each (N,).
    Success does not end an episode: it runs to `max_steps` unless it fails. Evaluation understands, if they are
    logged, `raw_success` (success without regard to overlap), `success_at_end` (success, and what was reached still
    holds now), `penetration_mm` and `nonfinite` (the simulator gave NaN or infinity; such an episode ends). A task may
    have an attribute `ranking_steps`: simulated steps that ranking its candidates took; and `agent_columns`: by agent's
    name, the columns of the observation that it sees, and those of the action that it commands, for learners that tell
    agents apart. Without it, one agent sees and commands everything. Evaluation stores `start_numbers`, if the task has
    it: numbers (N,) by name that say how the running episodes began.
    """

    @property
    def num_envs(self) -> int:
        """Number of environments N."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the tensors are."""
        ...

    @property
    def single_action_space(self) -> Any:
        """A gymnasium Box in [-1, 1]."""
        ...

    @property
    def elapsed_steps(self) -> Int[Tensor, " n"]:
        """Control steps since the start of each episode."""
        ...

    @property
    def max_steps(self) -> int:
        """Control steps of an episode that does not fail."""
        ...

    @property
    def logged(self) -> tuple[str, ...]:
        """Names in the info whose (N,) values are worth a curve."""
        ...

    @property
    def stage_names(self) -> tuple[str, ...]:
        """Names of the sub-tasks, in order."""
        ...

    def reset(
        self, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start new episodes, in all rows or in those of `options["env_idx"]` (without a seed)."""
        ...

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor | None, dict[str, Any]]:
        """Advance all rows by one control step with actions (N, A) in [-1, 1]."""
        ...

    def close(self) -> None:
        """Free the simulation."""
        ...


PENALTY = "reward/penetration"
"""Name of what the penalty for overlap adds to the reward, 0 or below."""
NONFINITE = "nonfinite"
"""Name of the column that says in which episodes something was not finite."""
TaskFactory = Callable[[], Task]
"""Makes a task; must be picklable, because worker processes call it."""
MakeTask = Callable[[int], Task]
"""Makes a task with the given number of environments; picklable."""


@dataclass(frozen=True)
class EpisodeColumns:
    """Names of the columns of the statistics that `TaskEnv` keeps of each running episode.

    last: value at the present step (1 for `success` at the end of the episode).
    highest: largest value so far (stage flags, penetration, non-finite states).
    total: sum over the steps so far (return, length, reward terms).
    """

    last: tuple[str, ...]
    highest: tuple[str, ...]
    total: tuple[str, ...]

    @classmethod
    def of(cls, logged: Sequence[str]) -> "EpisodeColumns":
        """Sort the names that a task logs into columns."""
        last = tuple(n for n in logged if n.startswith(("success", "raw_success")) and n != "success")
        highest = tuple(n for n in logged if n.startswith(("stage/", "penetration", "nonfinite")))
        total = tuple(n for n in logged if n not in {*last, *highest, "success"})
        return cls(("success", "whole", *last), highest, ("return", "length", *total))

    @property
    def names(self) -> tuple[str, ...]:
        """All columns in the order in which they are stored."""
        return self.last + self.highest + self.total

    def column(self, statistics: Float[Tensor, "*rows k"], name: str) -> Float[Tensor, "*rows"]:
        """The column `name`; sums of logged terms become means per step.

        Raises:
            ValueError: if there is no such column.
        """
        values = statistics[..., self.names.index(name)]
        if name in self.total and name not in ("return", "length"):
            values = values / statistics[..., self.names.index("length")].clamp_min(1.0)
        return values


@dataclass(frozen=True)
class Easing:
    """A penalty for overlap that grows in the course of a training: a hand that does not grasp yet avoids contact
    altogether where contact costs more than it earns.

    Attributes:
        share: of the penalty that counts at the first step of the run, above 0.
        steps: environment steps of the whole run after which all of it counts; until then it grows geometrically.
        begun: environment steps of the run before this part of it, in which it was interrupted.
        workers: batches that step at the same time.
    """

    share: float = 1.0
    steps: int = 1
    begun: int = 0
    workers: int = 1

    def at(self, own: int) -> float:
        """The share of the penalty that counts after `own` environment steps of a batch: share^(1 - done/steps)."""
        done = (self.begun + self.workers * own) / self.steps
        return self.share ** max(1.0 - done, 0.0)


@dataclass(frozen=True)
class TrainingRules:
    """What episodes of a training have that those of evaluations lack.

    Attributes:
        stagger: end each first episode at a random step, so that resets spread over time. Statistics of such an episode
            have `whole` = 0.
        after_success: control steps after its first success at which an episode is truncated; None: never.
        easing: how much of the penalty for overlap counts.
    """

    stagger: bool = False
    after_success: int | None = None
    easing: Easing = Easing()


class TaskEnv(EnvBase):
    """Steps the bare task; TorchRL resets the ended rows, so ("next", "observation") is always the true one.

    An episode is terminated when the task reports `fail` and truncated at its step limit, so a learner
    bootstraps from the last observation of every other episode. Actions are clipped to the action space.
    ("next", "statistics") (N, K) holds what `EpisodeColumns` names, of the episode up to this step.

    A row that the task reports as `nonfinite`, or whose observation or reward is NaN or infinite, is terminated and
    counted in the column `nonfinite`; it is no success, earns 0, and what is not finite is replaced by 0.

    Args:
        task: the batch to step; closed with this environment.
        seed: gives the rows their seeds in the first reset; later resets go on from there. ManiSkill itself would draw
            them, but for the first row's, from all numbers below 2^31, those of evaluation among them.
        rules: what the episodes of a training have, such as early ends; evaluations leave it out.

    Raises:
        InputError: the penalty for overlap is to be eased, and the task's reward has none.
    """

    def __init__(self, task: Task, *, seed: int | None = None, rules: TrainingRules = TrainingRules()):
        super().__init__(device=task.device, batch_size=torch.Size([task.num_envs]))
        self.task, self.rules, self._own_steps = task, rules, 0
        if rules.easing.share < 1 and PENALTY not in task.logged:
            raise InputError(
                "--overlap-share eases the penalty for overlap, and this reward has none: leave it out, or use "
                "--reward dense."
            )
        self._pending_seed: list[int] | None = None
        self.columns = EpisodeColumns.of(tuple(dict.fromkeys((*task.logged, NONFINITE))))
        self._limit = torch.full((task.num_envs,), task.max_steps, device=task.device)
        if rules.stagger:
            generator = torch.Generator().manual_seed(0 if seed is None else seed)
            self._limit[:] = torch.randint(1, task.max_steps + 1, self._limit.shape, generator=generator)
        self._whole = self._limit == task.max_steps
        self._statistics = torch.zeros(task.num_envs, len(self.columns.names), device=task.device)
        self._last, self._highest, self._total = self._statistics.split(
            [len(self.columns.last), len(self.columns.highest), len(self.columns.total)], dim=1
        )
        self._not_success = torch.tensor([float(name == "whole") for name in self.columns.last], device=task.device)
        self._low = torch.as_tensor(task.single_action_space.low, device=task.device)
        self._high = torch.as_tensor(task.single_action_space.high, device=task.device)
        self._set_seed(seed)
        self._set_specs(task.reset(seed=self._pending_seed)[0])
        self.is_closed = False  # TorchRL says so of the environments alone that it makes itself

    def _set_specs(self, observation: Tensor) -> None:
        n, device = self.batch_size[0], self.device

        def flag() -> Binary:
            return Binary(1, shape=torch.Size([n, 1]), dtype=torch.bool, device=device)

        self.observation_spec = Composite(
            observation=Unbounded(observation.shape, device=device),
            statistics=Unbounded(self._statistics.shape, device=device),
            shape=(n,),
            device=device,
        )
        self.action_spec = Bounded(self._low.expand(n, -1), self._high.expand(n, -1), device=device)
        self.reward_spec = Unbounded(torch.Size([n, 1]), device=device)
        self.done_spec = Composite(done=flag(), terminated=flag(), truncated=flag(), shape=(n,), device=device)

    @property
    def sizes(self) -> tuple[int, int]:
        """Numbers of observation and action components."""
        return self.observation_spec["observation"].shape[-1], self.action_spec.shape[-1]

    @property
    def agents(self) -> dict[str, AgentColumns]:
        """The agents that the task names, with their columns; none if it names none.

        Raises:
            InputError: a column is none, or the actions of all agents are not each column of the action once.
        """
        return checked_agents(getattr(self.task, "agent_columns", {}), self.sizes, "agent_columns of the task")

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """What `EnvBase` does, for this environment's few keys: several times less Python per step."""
        after = self._step(tensordict)
        tensordict.set("next", after)
        done = after.get("done")
        if done.any():
            return tensordict, self._restart_rows(done[:, 0])
        names = ("observation", "statistics", "done", "terminated", "truncated")
        root = {name: after.get(name) for name in names}
        return tensordict, TensorDict(root, batch_size=self.batch_size, device=self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        rows = None if tensordict is None else tensordict.get("_reset", None)
        if rows is not None:
            return self._restart_rows(rows.reshape(-1))
        seed, self._pending_seed = self._pending_seed, None
        self._statistics.zero_()
        return self._first(self.task.reset(seed=seed)[0])

    def _restart_rows(self, rows: Bool[Tensor, " n"]) -> TensorDictBase:
        index = rows.nonzero()[:, 0]
        self._statistics[index] = 0.0
        self._limit[index], self._whole[index] = self.task.max_steps, True
        return self._first(self.task.reset(options={"env_idx": index})[0])

    def _first(self, observation: Tensor) -> TensorDictBase:
        """All rows after a reset of some; the others go on."""
        no = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        return TensorDict(
            {
                "observation": _zeroed(observation, None),
                "statistics": self._statistics.clone(),
                "done": no,
                "terminated": no.clone(),
                "truncated": no.clone(),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action").clamp(self._low, self._high)
        observation, reward, _, _, info = self.task.step(action)
        fail = info.get("fail")
        if self.rules.after_success is not None and "success" in info:
            self._shorten(info["success"].to(torch.bool).reshape(-1), self.rules.after_success)
        truncated = self.task.elapsed_steps >= self._limit
        terminated = torch.zeros_like(truncated) if fail is None else fail.to(torch.bool).reshape(-1)
        reward = self._eased(reward, info)
        bad = _bad_rows(observation, reward, info)
        if bad.any():
            observation, reward = _zeroed(observation, bad), torch.where(bad, torch.zeros_like(reward), reward)
            terminated, truncated = terminated | bad, truncated & ~bad
        self._count(reward, info | {NONFINITE: bad})
        if bad.any():
            self._last[bad] = self._last[bad] * self._not_success
        return TensorDict(
            {
                "observation": observation.clone(),
                "statistics": self._statistics.clone(),
                "reward": reward.reshape(-1, 1).float(),
                "terminated": terminated.unsqueeze(1).clone(),
                "truncated": truncated.unsqueeze(1),
                "done": (terminated | truncated).unsqueeze(1),
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _eased(self, reward: Float[Tensor, "*n"], info: dict[str, Any]) -> Float[Tensor, "*n"]:
        """The reward with the share of the penalty for overlap that counts now; counts the steps."""
        share = self.rules.easing.at(self._own_steps)
        self._own_steps += self.batch_size[0]
        return reward if share == 1 else reward - (1 - share) * info[PENALTY].reshape(reward.shape)

    def _shorten(self, success: Bool[Tensor, " n"], after: int) -> None:
        """Lets the episodes that have succeeded end some steps from now, unless they end before."""
        end = torch.where(success, self.task.elapsed_steps + after, self._limit)
        torch.minimum(self._limit, end, out=self._limit)

    def _count(self, reward: Float[Tensor, " n"], info: dict[str, Any]) -> None:
        """Bring the statistics of the running episodes up to date with one step."""
        one = torch.ones_like(self._limit, dtype=torch.float32)
        given: dict[str, Tensor] = info | {
            "whole": self._whole.float(),
            "return": reward,
            "length": one,
        }
        values = torch.stack([given[name].reshape(-1).float() for name in self.columns.names], 1)
        values = values.nan_to_num(0.0, 0.0, 0.0)
        last, highest, total = values.split([self._last.shape[1], self._highest.shape[1], self._total.shape[1]], dim=1)
        self._last.copy_(last)
        torch.maximum(self._highest, highest, out=self._highest)
        self._total.add_(total)

    def _set_seed(self, seed: int | None) -> None:
        self._pending_seed = None if seed is None else seeds_for(seed, 0, self.task.num_envs)

    @property
    def start_numbers(self) -> dict[str, Float[Tensor, " n"]]:
        """How the running episodes began, by name; nothing if the task does not say."""
        return dict(getattr(self.task, "start_numbers", {}))

    def restart(self, seeds: list[int]) -> TensorDictBase:
        """Reset every row, row i with seeds[i]."""
        self._pending_seed = seeds
        self._limit[:] = self.task.max_steps
        return self.reset()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the task and this environment."""
        if not self.is_closed:
            self.task.close()
        super().close(raise_if_closed=raise_if_closed)


def _bad_rows(observation: Tensor, reward: Tensor, info: dict[str, Any]) -> Bool[Tensor, " n"]:
    """Rows of a step in which something is not finite, by its numbers or by what the task says."""
    bad = ~(observation.isfinite().all(-1) & reward.reshape(-1).isfinite())
    return bad | info[NONFINITE].bool().reshape(-1) if NONFINITE in info else bad


def _zeroed(observation: Float[Tensor, "n o"], rows: Bool[Tensor, " n"] | None) -> Float[Tensor, "n o"]:
    """A copy with 0 for NaN and infinity, in some rows or all."""
    finite = observation.nan_to_num(0.0, 0.0, 0.0)
    return finite if rows is None else torch.where(rows[:, None], finite, observation)


def ended_episodes(
    done: Bool[Tensor, "*rows 1"], statistics: Float[Tensor, "*rows k"], columns: EpisodeColumns
) -> Float[Tensor, "episodes k"]:
    """Statistics of the episodes that ended in a batch; those cut short by staggering are left out."""
    ended = statistics[done[..., 0]]
    return ended[columns.column(ended, "whole") > 0]
