"""TorchRL: a batch of environments as its `EnvBase`.

from dora.integrations.torchrl import make
from torchrl.collectors import Collector

env = make("DoraCube-v1", num_envs=64, ignore_terminations=True)
collector = Collector(env, frames_per_batch=1024, total_frames=300_000)
"""

from typing import Any

import gymnasium as gym
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from dora.integrations.batches import make_batch

ENDS = ("terminated", "truncated")
"""Names of the two ways in which an episode ends."""


def make(env_id: str, num_envs: int = 16, ignore_terminations: bool = False, **options: Any) -> "BatchEnv":
    """A batch as a TorchRL environment of `batch_size` (num_envs,).

    Args:
        env_id: id of Dora or ManiSkill.
        num_envs: environments in the batch.
        ignore_terminations: let an episode last until its time is over. Otherwise a success ends it, and as nothing is
            counted after that, a learner with a dense reward would rather not succeed.
        options: further arguments of `gym.make`, such as `guidance="none"` or `max_episode_steps=50`.

    Raises:
        InputError: if observations or actions are no array.
    """
    return BatchEnv(make_batch(env_id, num_envs, options), ignore_terminations)


class BatchEnv(EnvBase):
    """A batch of environments that are stepped together. TorchRL resets the rows whose episodes have ended.

    Keys: `observation` (n, o), `action` (n, a), `reward`, `done`, `terminated`, `truncated` and `success` (n, 1), which
    is False where a task knows no success.

    Args:
        env: a batched environment with arrays as observations and actions, see `make_batch`.
        ignore_terminations: episodes end when their time is over, and not by success or failure.
    """

    def __init__(self, env: gym.Env, ignore_terminations: bool = False):
        base: Any = env.unwrapped
        super().__init__(device=base.device, batch_size=torch.Size([base.num_envs]))
        self.env, self._seed, self._ignore = env, None, ignore_terminations
        actions, observations = (env.get_wrapper_attr(f"single_{what}_space") for what in ("action", "observation"))
        n, device = base.num_envs, base.device
        low, high = (torch.as_tensor(x, device=device).expand(n, -1) for x in (actions.low, actions.high))
        flags = {
            name: Binary(1, shape=torch.Size([n, 1]), dtype=torch.bool, device=device)
            for name in ("done", *ENDS, "success")
        }
        success = flags.pop("success")
        size = torch.Size([n, *observations.shape])
        self.observation_spec = Composite(
            observation=Unbounded(size, device=device), success=success, shape=(n,), device=device
        )
        self.action_spec = Bounded(low, high, device=device)
        self.reward_spec = Unbounded(torch.Size([n, 1]), device=device)
        self.done_spec = Composite(flags, shape=(n,), device=device)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        rows = None if tensordict is None else tensordict.get("_reset", None)
        if rows is None:
            seed, self._seed = self._seed, None
            observation, _ = self.env.reset(seed=seed)
        else:
            observation, _ = self.env.reset(options={"env_idx": rows.reshape(-1).nonzero()[:, 0]})
        none = torch.zeros(*self.batch_size, 1, dtype=torch.bool, device=self.device)
        values = {name: none.clone() for name in ("done", *ENDS, "success")}
        return self._of(values | {"observation": observation})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, *values, info = self.env.step(tensordict.get("action"))
        n = self.batch_size[0]
        reward, terminated, truncated = (torch.as_tensor(x, device=self.device).reshape(n, 1) for x in values)
        success = info.get("success", torch.zeros_like(terminated)).reshape(n, 1)
        terminated = terminated & (not self._ignore)
        ends = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        return self._of({"observation": observation, "reward": reward, "success": success, **ends})

    def _of(self, values: dict[str, Tensor]) -> TensorDictBase:
        return TensorDict(
            {name: value.clone() for name, value in values.items()}, batch_size=self.batch_size, device=self.device
        )

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the simulation."""
        super().close(raise_if_closed=raise_if_closed)
        self.env.close()
