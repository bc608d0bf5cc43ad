"""Point masses on a plane that have to reach goals: the task interface without a simulator."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor

STEP = 0.15  # largest displacement per step, m
NEAR = 0.15  # distance to the goal that counts as reached, m


class PointMass:
    """N points; observation (N, 4) = position and goal, action (N, 2) = displacement / STEP.

    Success is to be near the goal at the present step. With `deterministic` all episodes start alike.
    """

    device = torch.device("cpu")
    stage_names: tuple[str, ...] = ("approach", "reach")
    logged: tuple[str, ...] = (
        "reward/distance",
        "reward/reach",
        "stage/approach",
        "stage/reach",
        "penetration_mm",
        "action_norm",
    )

    def __init__(self, num_envs: int = 8, max_steps: int = 16, deterministic: bool = False, fail_at: int = -1):
        self.num_envs, self.max_steps, self.deterministic, self.fail_at = (
            num_envs,
            max_steps,
            deterministic,
            fail_at,
        )
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.elapsed_steps = torch.zeros(num_envs, dtype=torch.int64)
        self.position, self.goal = torch.zeros(num_envs, 2), torch.zeros(num_envs, 2)
        self.generators = [np.random.default_rng(row) for row in range(num_envs)]
        self.closed = False

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Tensor, dict[str, Any]]:
        options = options or {}
        if seed is not None and "env_idx" in options:
            raise ValueError("a seed reseeds every environment and cannot come with env_idx")
        seeds = seed if isinstance(seed, list) else [seed + row for row in range(self.num_envs)] if seed else None
        if seeds is not None:
            self.generators = [np.random.default_rng(s) for s in seeds]
        index = options.get("env_idx", torch.arange(self.num_envs))
        self.position[index], self.goal[index] = self.draw(index)
        self.elapsed_steps[index] = 0
        return self.observe(), {}

    def draw(self, index: Any) -> tuple[Tensor, Tensor]:
        draws = torch.tensor(np.array([self.generators[i].uniform(-1, 1, 4) for i in index]), dtype=torch.float32)
        draws = torch.full_like(draws, 0.5) if self.deterministic else draws
        return draws[:, :2] * 0.2, draws[:, 2:]

    def observe(self) -> Tensor:
        return torch.cat([self.position, self.goal], 1)

    def step(self, action: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        self.elapsed_steps += 1
        self.position += STEP * action
        gaps = self.gaps()
        distance, near = gaps.mean(1), (gaps < NEAR).all(1)
        terms = {"reward/distance": -distance, "reward/reach": near.float()}
        fail = self.elapsed_steps == self.fail_at
        info = terms | {
            "success": near,
            "fail": fail,
            "stage/approach": distance < 0.5,
            "stage/reach": near,
            "penetration_mm": torch.zeros(self.num_envs),
            "action_norm": action.norm(dim=1),
        }
        return self.observe(), terms["reward/distance"] + terms["reward/reach"], fail, fail & False, info

    def gaps(self) -> Tensor:
        return (self.position - self.goal).norm(dim=1, keepdim=True)

    def render(self) -> Tensor:
        return torch.full((1, 32, 32, 3), 128, dtype=torch.uint8)

    def close(self) -> None:
        self.closed = True


class TwoPoints(PointMass):
    """N pairs of points, each moved by an agent of its own; observation (N, 9) = positions, goals, time.

    `left` sees and moves the first point, `right` the second one. The reward is common: the mean distance, and success,
    which is that both are near their goals, so it takes both agents.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.agent_columns: Any = {"left": ([0, 1, 4, 5, 8], [0, 1]), "right": ([2, 3, 6, 7, 8], [2, 3])}
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.position, self.goal = torch.zeros(self.num_envs, 4), torch.zeros(self.num_envs, 4)

    def draw(self, index: Any) -> tuple[Tensor, Tensor]:
        draws = torch.tensor(np.array([self.generators[i].uniform(-1, 1, 8) for i in index]), dtype=torch.float32)
        draws = torch.full_like(draws, 0.5) if self.deterministic else draws
        return draws[:, :4] * 0.2, draws[:, 4:]

    def observe(self) -> Tensor:
        return torch.cat([self.position, self.goal, self.elapsed_steps[:, None] / self.max_steps], 1)

    def gaps(self) -> Tensor:
        return (self.position - self.goal).unflatten(1, (2, 2)).norm(dim=-1)
