"""ManiSkill's vector environment for Stable-Baselines3 runs our tasks and ManiSkill's on `physx_cpu_batch`."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import dora.sim

LIMIT, STEPS, COUNT = 6, 15, 3
"""Length of an episode and of the run [control steps]; number of environments."""


@pytest.mark.parametrize("env_id", ["DoraCube-v1", "PickCube-v1"])
def test_what_gym_makes_has_what_its_wrapper_reads(env_id: str):
    """Gymnasium's wrappers forward no attributes any more."""
    env: Any = gym.make(env_id, num_envs=COUNT, sim_backend=dora.sim.BACKEND, render_backend="none", obs_mode="state")
    assert env.num_envs == COUNT
    assert env.single_action_space == env.unwrapped.single_action_space
    assert env.single_observation_space == env.unwrapped.single_observation_space


@pytest.mark.filterwarnings("ignore:The `render_mode` attribute")
@pytest.mark.parametrize("env_id", ["DoraCube-v1", "PickCube-v1"])
def test_ppo_learns_on_it(env_id: str):
    sb3 = pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
    from mani_skill.vector.wrappers.sb3 import ManiSkillSB3VectorEnv

    settings: dict[str, Any] = {"sim_backend": dora.sim.BACKEND, "render_backend": "none", "obs_mode": "state"}
    made: Any = gym.make(env_id, num_envs=COUNT, max_episode_steps=LIMIT, **settings)
    env: Any = ManiSkillSB3VectorEnv(made)
    env.seed(3)
    obs, ends = env.reset(), np.zeros(COUNT, int)
    for _ in range(STEPS):
        obs, reward, done, infos = env.step(np.stack([env.action_space.sample() for _ in range(COUNT)]))
        assert obs.shape == (COUNT, *env.observation_space.shape)
        assert np.isfinite(obs).all()
        assert reward.shape == done.shape == (COUNT,)
        assert all(("terminal_observation" in info) == end for info, end in zip(infos, done, strict=True))
        ends += done
    assert (ends == STEPS // LIMIT).all()
    model = sb3.PPO("MlpPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu")
    model.learn(2 * 8 * COUNT)
    assert model.num_timesteps == 2 * 8 * COUNT
    env.close()
