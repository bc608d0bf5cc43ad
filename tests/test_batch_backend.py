"""The back end beside its physics: resets, errors, machines without a renderer, closing."""

import subprocess
import sys
from typing import Any

import gymnasium as gym
import mani_skill.envs  # noqa: F401
import numpy as np
import psutil
import pytest
import sapien
import torch
from mani_skill.envs.tasks.empty_env import EmptyEnv
from mani_skill.utils.wrappers.record import RecordEpisode
from pictures import run_without_driver

import dora.sim
from dora.errors import InputError
from dora.sim.batch.rendering import NOTE


@pytest.fixture
def env():
    env = make("PickCube-v1", 4)
    env.reset(seed=0)
    yield env
    env.close()


def make(env_id: str, num_envs: Any, **kwargs) -> Any:
    settings = {"render_backend": "none", "obs_mode": "state", **kwargs}
    return gym.make(env_id, num_envs=num_envs, sim_backend=dora.sim.BACKEND, **settings)


def state(env) -> torch.Tensor:
    return env.unwrapped.get_state()


def test_partial_reset_leaves_the_others_alone(env):
    for _ in range(5):
        env.step(env.action_space.sample())
    before = state(env)
    env.reset(options={"env_idx": torch.tensor([1, 3])})
    after = state(env)
    assert torch.equal(before[[0, 2]], after[[0, 2]])
    assert not torch.equal(before[[1, 3]], after[[1, 3]])


@pytest.mark.parametrize(
    "action",
    [
        np.zeros((3, 8)),
        np.zeros(8),
        np.full((4, 8), np.nan),
        np.full((4, 8), np.inf),
        {"a": np.zeros((4, 8))},
    ],
)
def test_bad_actions_are_refused_before_anything_happens(env, action):
    before, steps = state(env), env.unwrapped.elapsed_steps.clone()
    with pytest.raises(InputError):
        env.step(action)
    assert torch.equal(before, state(env))
    assert torch.equal(steps, env.unwrapped.elapsed_steps)


@pytest.mark.parametrize("num_envs", [0, -1, 2.5])
def test_bad_numbers_of_environments_are_refused(num_envs):
    with pytest.raises(InputError, match="num_envs"):
        make("PickCube-v1", num_envs)


def test_tables_read_what_was_written_and_know_their_limits(env):
    robot, cube = env.unwrapped.agent.robot, env.unwrapped.cube
    table = env.unwrapped.scene.px.cuda_rigid_body_data
    qf = torch.arange(36.0).view(4, 9) / 100
    robot.set_qf(qf)
    assert torch.equal(robot.get_qf(), qf)
    cube.set_linear_velocity(torch.tensor([0.1, 0.2, 0.3]))
    assert torch.allclose(cube.linear_velocity, torch.tensor([0.1, 0.2, 0.3]))
    targets = torch.rand(4, 9)
    robot.set_joint_drive_targets(targets, robot.active_joints)
    assert torch.equal(robot.drive_targets, targets)
    assert torch.equal(torch.zeros_like(table.torch()), torch.zeros(table.shape))
    assert robot.qacc.shape == (4, 9)
    with pytest.raises(TypeError, match="copy"):
        table.torch().zero_()


def test_forces_push(env):
    for _ in range(3):
        env.step(None)
    env.unwrapped.cube.apply_force(torch.tensor([[0.0, 0.0, 20.0]]))
    env.unwrapped.scene.step()
    assert (env.unwrapped.cube.linear_velocity[:, 2] > 0.1).all()


def test_reconfiguration_gives_new_scenes():
    env = make("PegInsertionSide-v1", 2, reconfiguration_freq=1)
    env.reset(seed=0)
    first = env.unwrapped.scene
    env.reset(seed=1)
    assert env.unwrapped.scene is not first
    env.step(env.action_space.sample())


def test_substep_hooks_see_every_step(env):
    """Also when they look at sapien objects, which know nothing of steps that wait."""
    articulation, seen = env.unwrapped.agent.robot._objs[0], []
    env.unwrapped._after_simulation_step = lambda: seen.append(float(articulation.qpos[0]))
    env.step(np.ones((4, 8), np.float32))
    assert len(set(seen)) == env.unwrapped._sim_steps_per_control


def test_record_episode_writes_trajectories(env, tmp_path):
    recorder = RecordEpisode(env, str(tmp_path), save_video=False, max_steps_per_video=5)
    recorder.reset(seed=0)
    for _ in range(5):
        recorder.step(recorder.action_space.sample())
    recorder.flush_trajectory()
    assert list(tmp_path.glob("*.h5"))


NO_DRIVER = """
import gymnasium as gym, mani_skill.envs, sapien, dora.sim
from dora.errors import InputError
from dora.sim.batch.rendering import NoMaterial
material = sapien.render.RenderMaterial
assert not dora.sim.can_render()
gym.make("Empty-v1", sim_backend="physx_cpu", render_backend="none").close()
assert sapien.render.RenderMaterial is material, "a question has changed SAPIEN"
for env_id in ("PickCube-v1", "MS-HopperHop-v1", "RotateValveLevel2-v1"):
    env = gym.make(env_id, num_envs=2, sim_backend="physx_cpu_batch", obs_mode="state")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert sapien.render.RenderMaterial is NoMaterial
try:
    gym.make("PickCube-v1", num_envs=2, sim_backend="physx_cpu_batch", obs_mode="rgb")
except InputError as error:
    print("refused:", error)
"""


def test_works_without_a_vulkan_driver():
    result = run_without_driver(NO_DRIVER)
    assert result.returncode == 0, result.stderr
    assert "refused: obs_mode 'rgb' needs pictures" in result.stdout
    assert "svulkan" not in result.stderr
    assert result.stderr.count(NOTE) == 1


def test_the_import_says_nothing():
    """Not even that SAPIEN takes its own Vulkan loader, where the system has none."""
    result = subprocess.run([sys.executable, "-c", "import dora"], capture_output=True, text=True, check=True)
    assert (result.stdout, result.stderr) == ("", "")


def test_the_ground_carries_objects_in_every_environment():
    """ManiSkill builds a plane in the first environment only, for those that share one physics scene."""

    class Ball(EmptyEnv):
        def _load_scene(self, options: dict) -> None:
            super()._load_scene(options)
            builder: Any = self.scene.create_actor_builder()
            builder.add_sphere_collision(radius=0.1)
            builder.initial_pose = sapien.Pose([2.0, 0.0, 0.2])
            self.ball = builder.build("ball")

    env = Ball(num_envs=3, sim_backend=dora.sim.BACKEND, render_backend="none", obs_mode="none", reward_mode="none")
    for _ in range(20):
        env.step(None)
    assert (env.ball.pose.p[:, 2] - 0.1).abs().max() < 0.01
    env.close()


@pytest.mark.slow
def test_closing_leaks_nothing():
    process = psutil.Process()

    def cycle():
        env = make("PickCube-v1", 4)
        env.reset(seed=0)
        env.step(env.action_space.sample())
        env.close()

    for _ in range(3):
        cycle()
    memory, files = process.memory_info().rss, process.num_fds()
    for _ in range(8):
        cycle()
    assert process.num_fds() == files
    assert process.memory_info().rss - memory < 8 * 2**20


def test_a_step_after_close_is_refused():
    closed = make("PickCube-v1", 2)
    closed.reset(seed=0)
    closed.close()
    with pytest.raises(InputError, match=r"step\(\) after close\(\)"):
        closed.step(closed.action_space.sample())
