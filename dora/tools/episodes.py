"""Playing the episodes of a batch to their ends, for tools that compare what becomes of them."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor


def play_out(
    env: Any, act: Callable[[Any], Tensor], obs: Any = None
) -> tuple[Bool[Tensor, " n"], Bool[Tensor, " n"], dict[str, Any]]:
    """Steps a batch until the time of its episodes, which have been reset together, is over.

    Args:
        env: a Dora task, or a wrapper around one, of n environments; it does not reset what has ended.
        act: gives the action of each step from what was observed last.
        obs: what the reset observed.

    Returns:
        Which episodes succeed at the end without a failure on the way, which failed on the way, and the last info.
    """
    task = env.unwrapped
    failed, info = torch.zeros(task.num_envs, dtype=torch.bool, device=task.device), dict[str, Any]()
    for _ in range(task.max_steps):
        obs, *_, info = env.step(act(obs))
        failed |= info["fail"]
    return info["success"] & ~failed, failed, info
