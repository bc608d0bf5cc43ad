"""One environment with somebody who acts in it: begins episodes, does control steps, says how it stands; no clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dora.errors import InputError, shown
from dora.live.players import Player
from dora.live.reading import EpisodeLog, Reader, active_stages, read_setup, verdict
from dora.live.recordings import RecordedEpisode
from dora.live.state import Episode, Poses, Setup
from dora.sim.batch.resets import START
from dora.tasks import make_task
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.scene import TaskScene


@dataclass(frozen=True, kw_only=True)
class Beginning:
    """How an episode begins.

    Attributes:
        player: who acts.
        preset: how much it is randomised.
        seed: of all that is random; of a recording it counts the episodes.
        shares: the start that was chosen by hand, see `Episode.shares`; None for a random one.
        candidate: that was chosen by hand; None for the nearest ones.
    """

    player: Player
    preset: str
    seed: int
    shares: tuple[float, ...] | None = None
    candidate: int | None = None


class LiveTask:
    """An environment that is made anew when a player needs another one.

    Args:
        env_id: id of the task.
        beginning: of the first episode.

    Attributes:
        setup: of the environment.
        reader: of its bodies.
        passed: poses after the physics steps of the last control step, but for the last of them.
        over: the episode has ended, by failure or by time.

    Raises:
        InputError: for an unknown task, or a player whose task cannot be made.
    """

    def __init__(self, env_id: str, beginning: Beginning):
        self._env_id = env_id
        self._env: DoraEnv | None = None
        self._options: dict[str, Any] = {}
        self.setup: Setup
        self.reader: Reader
        self._read: TaskScene | None = None
        self.passed: tuple[Poses, ...] = ()
        self.begin(beginning)

    @property
    def env(self) -> DoraEnv:
        """The environment."""
        assert self._env is not None
        return self._env

    def begin(self, beginning: Beginning) -> None:
        """Begins an episode.

        Raises:
            InputError: a recording is damaged, or its task cannot be made.
        """
        player = beginning.player
        recorded = None
        if player.recording is not None:
            recorded = player.recording.episode(beginning.seed % len(player.recording.names))
        self._make(player.options_with(self._env_id, beginning.preset))
        self.beginning, self._recorded, env = beginning, recorded, self.env
        env.chosen_start = self._placed
        env.narrow = {} if beginning.candidate is None else {env.arm.name: self._only}
        self._observation = self._first_observation(recorded)
        if self._read is not env.task_scene:
            self.reader, self._read = Reader(env), env.task_scene
        self._log, self._info = EpisodeLog(self.setup), env.evaluate()
        self._steps, self._reward, self.over = 0, 0.0, False
        self._reachable, self._shares = self._within_reach(), beginning.shares or self._shares_now()

    def _make(self, options: dict[str, Any]) -> None:
        """Makes the environment, unless the present one is the same."""
        if self._env is not None and options == self._options:
            return
        made = _made(self._env_id, options)
        if self._env is not None:
            self._env.close()
        self._env, self._options = made, options
        self.setup = read_setup(made, self._env_id)

    def _first_observation(self, recorded: RecordedEpisode | None) -> Tensor:
        if recorded is None:
            return self.env.reset(seed=self.beginning.seed)[0]
        observation, _ = self.env.reset(seed=recorded.seed)  # a scene that remembers no contacts
        if recorded.state is not None:
            observation, _ = self.env.reset(options={START: {"env_states": _tensors(recorded.state)}})
        return observation

    def _placed(self, draws: Tensor) -> Tensor:
        """The random numbers of a start (1, d), or those of the chosen one."""
        starts, shares = self.env.task.starts(), self.beginning.shares
        if shares is not None and starts is not None:
            draws = starts.draws(torch.tensor(shares, dtype=draws.dtype))[None].expand_as(draws)
        self._draws = draws[0]
        return draws

    def _only(self, mask: Tensor) -> Tensor:
        """Leaves the chosen candidate alone, whether it can be reached or not."""
        one = torch.zeros_like(mask)
        one[:, self.beginning.candidate] = True
        return one

    def _within_reach(self) -> tuple[int, ...]:
        """Candidates that can be reached from the start; none with several arms."""
        if len(self.env.arms) != 1:
            return ()
        arm = self.env.arm
        pose = self.env.objects[arm.spec.object].pose
        return tuple(self.env.task.reachable(arm, torch.arange(1), pose.p, pose.q)[0].nonzero()[:, 0].tolist())

    def _shares_now(self) -> tuple[float, ...]:
        """The start as shares of the ranges of its numbers."""
        starts = self.env.task.starts()
        if starts is None:
            return ()
        pose = next(iter(self.env.objects.values())).pose
        return tuple(starts.shares(self._draws, (pose.p[0], pose.q[0])).tolist())

    def step(self) -> None:
        """Does a control step."""
        action = self._action()
        self.reader.passed()  # those of a reset
        with torch.no_grad():
            self._observation, reward, _, _, self._info = self.env.step(action)
        self.passed = self.reader.passed()[:-1]
        self._steps, self._reward = self._steps + 1, float(reward[0])
        self._log.add(self._steps * self.setup.dt, self._info)
        length = self.setup.max_steps if self._recorded is None else len(self._recorded.actions)
        self.over = self._steps >= length or bool(self._info["fail"][0])

    def _action(self) -> Tensor:
        if self._recorded is not None:
            return torch.from_numpy(self._recorded.actions[self._steps][None])
        act = self.beginning.player.act
        if act is None:
            return torch.zeros(1, self.env.action_size)
        return torch.as_tensor(act(self._observation)).clamp(-1.0, 1.0)

    def push(self, x: float, y: float) -> None:
        """Gives the first object an impulse [N s], world frame, in the next physics step."""
        impulse = torch.zeros(1, len(self.env.objects), 3)
        impulse[0, 0, :2] = torch.tensor([x, y])
        self.env.task_scene.push(impulse)

    def episode(self) -> Episode:
        """How the episode stands."""
        env, info, stages = self.env, self._info, active_stages(self.env.machine)
        return Episode(
            seed=self.beginning.seed,
            step=self._steps,
            time=self._steps * self.setup.dt,
            stages=stages,
            reward=self._reward,
            verdict=verdict(self.setup, stages, env.mdp.failure, info, self.over),
            success=bool(info["success"][0]),
            over=self.over,
            chosen={name: int(choice.buffers.chosen[0]) for name, choice in env.arms.choices.items()},
            reachable=self._reachable,
            shares=self._shares,
            history=self._log.history,
        )

    def close(self) -> None:
        """Closes the environment."""
        if self._env is not None:
            self._env.close()
            self._env = None


def _made(env_id: str, options: dict[str, Any]) -> DoraEnv:
    """The task of one environment.

    Raises:
        InputError: options, which may come from a file, are of another kind.
    """
    try:
        return make_task(env_id, 1, sim_backend="physx_cpu", **options)
    except InputError:
        raise
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise InputError(f"{env_id} cannot be made with {shown(options)} ({error}): use other options.") from error


def _tensors(state: Mapping[str, Any]) -> dict[str, Any]:
    """A state of arrays as one of tensors."""
    return {
        name: _tensors(part) if isinstance(part, Mapping) else torch.from_numpy(part) for name, part in state.items()
    }
