"""Controllers of ManiSkill's robots on `physx_cpu_batch`: targets between physics steps, modes, saved and restored."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import pytest
import torch
from mani_skill.agents.registration import REGISTERED_AGENTS, register_agent
from mani_skill.agents.robots import Panda
from mani_skill.utils.wrappers import FrameStack
from mani_skill.utils.wrappers.cached_reset import CachedResetsConfig, CachedResetWrapper

from dora.errors import InputError
from dora.sim import BACKEND
from dora.sim.batch.resets import START, STATES

pytestmark = pytest.mark.usefixtures("materials")
DELTAS = "pd_joint_target_delta_pos"
"""A mode whose targets go on from the last ones."""


def make(backend: str = BACKEND, num_envs: int = 2, **options: Any) -> Any:
    settings: Any = {"sim_backend": backend, "render_backend": "none", "obs_mode": "state", **options}
    return gym.make("PickCube-v1", num_envs=num_envs, **settings)


def interpolating() -> str:
    """Name of a robot whose controllers move their targets in every physics step."""
    if "panda_interpolating" not in REGISTERED_AGENTS:

        class Interpolating(Panda):
            uid = "panda_interpolating"

            @property
            def _controller_configs(self) -> Any:
                configs: Any = super()._controller_configs
                for config in configs.values():
                    if isinstance(config, dict) and hasattr(config["arm"], "interpolate"):
                        config["arm"].interpolate = True
                return configs

        register_agent()(Interpolating)
    return "panda_interpolating"


def test_targets_that_move_between_physics_steps_are_those_of_stock():
    one, other = (make(backend, 1, robot_uids=interpolating()) for backend in ("physx_cpu", BACKEND))
    assert torch.equal(one.reset(seed=1)[0], other.reset(seed=1)[0])
    one.action_space.seed(0)
    for _ in range(5):
        action = one.action_space.sample()
        assert torch.equal(one.step(action)[0], other.step(action)[0])
    one.close()
    other.close()


def moved() -> tuple[Any, torch.Tensor]:
    """Two environments whose arms lag behind their targets, and those targets."""
    env = make(control_mode=DELTAS)
    env.reset(seed=3)
    for _ in range(4):
        env.step(torch.full((2, 8), 0.7))
    return env, targets(env).clone()


def targets(env: Any) -> torch.Tensor:
    return env.unwrapped.agent.controller.get_state()["arm"]["target_qpos"]


def test_a_saved_state_does_not_change_with_the_environment():
    env, wanted = moved()
    state = env.unwrapped.get_state_dict()
    env.reset(seed=5)
    assert torch.equal(state["controller"]["arm"]["target_qpos"], wanted)
    env.close()


@pytest.mark.parametrize(
    "start",
    [
        lambda env: {START: {STATES: env.get_state_dict()}},
        lambda env: {START: {STATES: env.get_state()}},
        lambda env: {START: {STATES: env.get_state_dict()}, "reconfigure": True},
        lambda env: {START: {STATES: env.get_state()}, "reconfigure": True},
    ],
    ids=["dictionary", "rows", "rebuilt", "rows, rebuilt"],
)
def test_an_episode_that_begins_in_a_state_has_its_targets(start: Callable[[Any], dict[str, Any]]):
    env, wanted = moved()
    env.reset(options=start(env.unwrapped))
    torch.testing.assert_close(targets(env), wanted)
    env.close()


def test_rows_without_controllers_leave_the_measured_posture_as_target():
    env, wanted = moved()
    width = sum(
        part.shape[1] for kind in ("actors", "articulations") for part in env.unwrapped.get_state_dict()[kind].values()
    )
    env.reset(options={START: {STATES: env.unwrapped.get_state()[:, :width]}})
    assert (targets(env) - wanted).abs().max() > 0.05
    env.close()


def test_cached_resets_hold_the_targets_of_their_own_episodes():
    env, _ = moved()
    cached: Any = CachedResetWrapper(env, config=CachedResetsConfig(num_resets=4, seed=0))
    states = cached._cached_resets_env_states
    posture = states["articulations"]["panda"][:, 13:20]
    assert (states["controller"]["arm"]["target_qpos"] - posture).abs().max() < 1e-5
    env.close()


def test_actions_fit_the_mode_that_is_in_force():
    env = make(num_envs=1)
    env.reset(seed=0)
    for _ in range(2):
        env.step({"control_mode": "pd_ee_delta_pose", "action": torch.zeros(1, 7)})
    env.step(torch.zeros(1, 7))
    with pytest.raises(InputError, match=r"shape \(1, 8\) but \(1, 7\) is needed"):
        env.step(torch.zeros(1, 8))
    env.step({"control_mode": "pd_joint_delta_pos", "action": torch.zeros(1, 8)})
    env.step(torch.zeros(1, 8))
    env.close()


@pytest.mark.parametrize("backend", ["physx_cpu", BACKEND])
def test_a_robot_with_a_fault_says_it_on_every_back_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backend: str):
    folder = tmp_path / "broken"
    folder.mkdir()
    (folder / "robot.toml").write_text("name = [")
    monkeypatch.setenv("DORA_ROBOTS", str(tmp_path))
    with pytest.raises(InputError, match=r"robot\.toml is not valid TOML"):
        gym.make("Empty-v1", robot_uids="broken", num_envs=1, sim_backend=backend, render_backend="none")  # pyright: ignore[reportArgumentType]


def test_stacked_frames_refuse_a_partial_reset_by_a_mask():
    """They would give the rows that go on the newest frame in the place of their older ones."""
    env = FrameStack(make(), num_stack=2)
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match="partial environment reset"):
        env.reset(options={"env_idx": torch.tensor([True, False])})
    env.reset(options={"env_idx": torch.tensor([True, True])})
    env.close()
