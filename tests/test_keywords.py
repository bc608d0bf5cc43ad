"""Keywords of gym.make: typos and values out of range get one sentence, and the back end is what was asked for."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs.types import SimConfig

import dora.sim
from dora.affordance.bundled_sets import load_candidates
from dora.errors import InputError

WRONG = [
    ({"num_env": 4}, "did you mean 'num_envs'"),
    ({"num_envs": 0}, "at least 1"),
    ({"num_envs": -1}, "at least 1"),
    ({"num_envs": 2.5}, "whole number"),
    ({"num_envs": True}, "whole number"),
    ({"num_envs": 1024}, "room for [0-9]+ more environments, and (1024|2048) are needed"),
    ({"num_envs": 100_001}, "from 1 to 100000"),
    ({"num_envs": "4"}, "whole number"),
    ({"sim_backend": "physx_cpu_bach"}, "did you mean 'physx_cpu_batch'"),
    ({"sim_backend": 3}, "must be a text"),
    ({"sim_backend": None}, "must be a text"),
    ({"sim_backend": "physx_cpu:1"}, "no sim_backend"),
    ({"render_backend": "gpuu"}, "did you mean 'gpu'"),
    ({"render_backend": 3}, "must be a text"),
    ({"obs_mode": "stat"}, "did you mean 'state'"),
    ({"obs_mode": 3}, "must be a text"),
    ({"obs_mode": "rgb+dept"}, "did you mean 'depth'"),
    ({"obs_mode": "state+state_dict"}, "exclude each other"),
    ({"obs_mode": "state+state"}, "exclude each other"),
    ({"obs_mode": "none+state"}, "cannot be joined|exclude each other"),
    ({"reward_mode": "dens"}, "did you mean 'dense'"),
    ({"control_mode": "pd_joint_po"}, "pd_joint_pos"),
    ({"control_mode": 3}, "must be a text"),
    ({"render_mode": "rgb"}, "choose one of human"),
    ({"shader_dir": "ray"}, "choose one of minimal"),
    ({"enable_shadow": "yes"}, "True or False"),
    ({"enable_shadow": np.array([1, 2])}, "True or False"),
    ({"enable_shadow": np.zeros((2, 2))}, "True or False"),
    ({"enable_shadow": None}, "True or False"),
    ({"enhanced_determinism": "maybe"}, "True or False"),
    ({"parallel_in_single_scene": True}, "not available"),
    ({"sensor_configs": 3}, "dictionary"),
    ({"human_render_camera_configs": [1]}, "dictionary"),
    ({"viewer_camera_configs": "x"}, "dictionary"),
    ({"reconfiguration_freq": -1}, "must be 0"),
    ({"reconfiguration_freq": 1.5}, "whole number"),
    ({"sim_config": 3}, "dictionary"),
    ({"sim_config": np.array([1, 2])}, "dictionary"),
    ({"robot_uids": "pandaa"}, "robot 'pandaa'"),
    ({"robot_uids": ("panda", 3)}, "robot_uids"),
    ({"robot_uids": []}, "robot_uids"),
    ({"sensor_configs": {"hand_camera": 5}}, "no 'hand_camera'.*dictionary"),
    ({"sensor_configs": {"hand_camera": {"widht": 64}}}, "did you mean 'width'"),
    ({"sensor_configs": {"shader_pack": "foo"}}, "no shader_pack 'foo'"),
    ({"sensor_configs": {"near": -1}}, "near of a camera is -1"),
    ({"sensor_configs": {"fov": "1"}}, "fov of a camera is '1'"),
    ({"sensor_configs": {"width": True}}, "width of a camera is True"),
    ({"human_render_camera_configs": {"width": -5}}, "width of a camera is -5"),
    ({"human_render_camera_configs": {"far": float("nan")}}, "far of a camera is nan"),
    ({"viewer_camera_configs": {"nera": 1}}, "did you mean 'near'"),
    ({"viewer_camera_configs": {"near": 5.0, "far": 1.0}}, "near is 5.0 m and far 1.0 m"),
    ({"sim_config": {"scene_config": {"solver_position_iterations": 2**40}}}, "too large"),
    ({"sim_config": {"sim_freq": 10**12}}, "too large|below 1e"),
    ({"sim_config": {"sim_frq": 100}}, "did you mean 'sim_freq'"),
    ({"sim_config": {"sim_freq": 0}}, "too small"),
    ({"sim_config": {"control_freq": -20}}, "too small"),
    ({"sim_config": {"sim_freq": 100.5}}, "whole number"),
    ({"sim_config": {"sim_freq": 110}}, "a multiple of the control_freq, 20 Hz"),
    ({"sim_config": {"scene_config": {"enable_pmc": False}}}, "did you mean 'enable_pcm'"),
    ({"sim_config": {"scene_config": {"contact_offset": float("nan")}}}, "finite number"),
    ({"sim_config": {"scene_config": {"contact_offset": -0.1}}}, "must not be negative"),
    ({"sim_config": {"scene_config": {"enable_pcm": "yes"}}}, "True or False"),
    ({"sim_config": {"scene_config": {"gravity": [0.0, 0.0, float("nan")]}}}, "three finite numbers"),
    ({"sim_config": {"scene_config": {"gravity": np.array([0, 0, np.inf])}}}, "three finite numbers"),
    ({"sim_config": {"scene_config": {"gravity": [0.0, 0.0]}}}, "three finite numbers"),
    ({"sim_config": {"scene_config": {"gravity": "x"}}}, "three finite numbers"),
    ({"sim_config": {"scene_config": {"gravity": 1e30}}}, "three finite numbers"),
]
"""Arguments that are wrong for every task, and words of the answer."""
CUBE = load_candidates("cube")
NINE_JOINTS = replace(CUBE, **{name: getattr(CUBE, name)[:, :9] for name in ("pregrasp", "grasp", "joints")})
"""Grasps of the task's object, and of another hand."""
OURS = [
    ({"num_envs": 3, "sim_backend": "physx_cpu"}, "use 'physx_cpu_batch' for 3"),
    ({"guidance": 3}, "must be a text"),
    ({"guidance": None}, "must be a text"),
    ({"guidance_parts": 3}, "must be a list"),
    ({"guidance_parts": ["filtr"]}, "filter"),
    ({"guidance_parts": [1, "x"]}, "part 1; choose"),
    ({"guidance_parts": [["prior"]]}, "choose among"),
    ({"config": []}, "config must be a mapping"),
    ({"hand_joints": "20"}, "whole number"),
    ({"preset": None}, "must be a text"),
    ({"config": 3}, "config must be a mapping"),
    ({"grasps": "grasps.safetensors"}, "GraspCandidates.load"),
    ({"grasps": load_candidates("jug")}, "holds grasps of 'jug', not of 'cube'"),
    ({"grasps": replace(CUBE, digest="0" * 64)}, "another shape or labelling of 'cube'"),
    ({"grasps": replace(CUBE, valid=torch.zeros(len(CUBE), dtype=torch.bool))}, "no valid grasp"),
    ({"grasps": NINE_JOINTS}, "9 joints of a hand, and 'diana7_hit' has 20"),
    ({"robot_uids": "diana7_hit_left"}, "for the robot 'diana7_hit', not 'diana7_hit_left'"),
    ({"robot_uids": 3}, "robot_uids"),
    ({"robot_uids": ()}, "one robot for each"),
]
"""Arguments that are wrong for our tasks."""


@pytest.mark.parametrize(("options", "words"), WRONG + OURS, ids=str)
def test_arguments_of_our_tasks_are_checked_one_by_one(options: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words) as error:
        gym.make("DoraCube-v1", **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("options", "words"), WRONG, ids=str)
def test_arguments_of_maniskills_tasks_on_our_back_end_are_checked_as_well(options: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words) as error:
        gym.make("PickCube-v1", **{"sim_backend": dora.sim.BACKEND, **options})
    assert "\n" not in str(error.value)


def test_numbers_of_numpy_are_taken():
    scene = {"enable_pcm": np.bool_(True), "contact_offset": np.float32(0.02)}
    config = {"sim_freq": np.int64(100), "scene_config": scene}
    options: Any = {"sim_backend": dora.sim.BACKEND, "render_backend": "none", "obs_mode": "state", "num_envs": 2}
    env: Any = gym.make("PickCube-v1", sim_config=config, **options).unwrapped
    found = env.sim_config
    assert (found.sim_freq, found.scene_config.enable_pcm) == (100, True)
    assert found.scene_config.contact_offset == pytest.approx(0.02)
    env.close()


@pytest.mark.parametrize("mode", ["rgbd", "rgb", "pointcloud", "state+pointcloud", "state_dict+rgb+pointcloud"])
def test_observations_of_maniskill_are_only_lacking_a_driver(mode: str):
    with pytest.raises(InputError, match="needs pictures"):
        gym.make("DoraCube-v1", obs_mode=mode, render_backend="none")


@pytest.mark.parametrize("gravity", [[0.0, 0.0, -1.6], np.array([0, 0, -1.6]), (0, 0, -1.6)])
def test_gravity_is_that_of_the_sim_config(gravity: Any):
    env: Any = gym.make("DoraCube-v1", num_envs=2, sim_config={"scene_config": {"gravity": gravity}})
    assert env.unwrapped.scene.sub_scenes[0].physx_system.config.gravity[2] == pytest.approx(-1.6)
    assert env.reset(seed=0)[0].isfinite().all()
    env.close()


def test_a_robot_that_is_not_there_gets_the_nearest_one():
    with pytest.raises(InputError, match="no robot 'pandaa': did you mean 'panda'"):
        gym.make("PickCube-v1", sim_backend=dora.sim.BACKEND, robot_uids=("pandaa",))
    options: Any = {"sim_backend": dora.sim.BACKEND, "render_backend": "none", "obs_mode": "state"}
    for robots in (["panda"], "panda", None):
        env: Any = gym.make("PickCube-v1", num_envs=2, robot_uids=robots, **options)
        assert type(env.unwrapped.agent).__name__.startswith("Panda")
        env.close()


def test_every_keyword_of_maniskill_has_a_wrong_value_here():
    import inspect

    tried = {name for options, _ in WRONG for name in options}
    assert set(inspect.signature(BaseEnv.__init__).parameters) - {"self"} <= tried


def test_values_that_are_right_in_another_form_are_taken():
    env = gym.make(
        "DoraCube-v1",
        num_envs=np.int64(2),
        enable_shadow=np.bool_(False),
        enhanced_determinism=np.array(0),
        sensor_configs=None,
        sim_config=None,
        render_backend=None,
        reconfiguration_freq=np.int32(0),
        reward_mode="paper",
        obs_mode=None,
    )
    assert env.unwrapped.num_envs == 2  # pyright: ignore[reportAttributeAccessIssue]
    assert env.unwrapped.backend.sim_backend == dora.sim.BACKEND  # pyright: ignore[reportAttributeAccessIssue]
    settings = SimConfig(sim_freq=60, control_freq=20)
    whole: Any = gym.make("PickCube-v1", sim_backend=dora.sim.BACKEND, sim_config=settings, render_backend="none")
    assert whole.unwrapped.sim_freq == 60


DEFAULT = """
import gymnasium as gym, dora
for env_id in ("PickCube-v1", "PushCube-v1"):
    env = gym.make(env_id, num_envs=4, render_backend="none")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert env.unwrapped.backend.sim_backend == "physx_cpu_batch"
assert gym.make("PickCube-v1", render_backend="none").unwrapped.backend.sim_backend == "physx_cpu"
"""


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="with CUDA ManiSkill's own back end is the default")
def test_several_environments_without_cuda_run_batched_and_it_is_said_once(project_root: Path):
    done = subprocess.run([sys.executable, "-c", DEFAULT], cwd=project_root, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (done.stdout + done.stderr).count('sim_backend="physx_cpu_batch"') == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="with CUDA the back end is there")
def test_a_back_end_that_was_asked_for_is_never_replaced():
    with pytest.raises(RuntimeError, match="multiple environments"):
        gym.make("PickCube-v1", num_envs=4, sim_backend="physx_cpu")
    for env_id in ("PickCube-v1", "DoraCube-v1"):
        for name in ("physx_cuda", "gpu", "cuda:0"):
            with pytest.raises(InputError, match="needs a GPU with CUDA"):
                gym.make(env_id, num_envs=4, sim_backend=name)
