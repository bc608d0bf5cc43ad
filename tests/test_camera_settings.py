"""Settings of cameras, what is refused, and the tools that take their pictures."""

import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from mani_skill.envs.utils.observations import parse_obs_mode_to_struct
from mani_skill.utils.structs import Link
from mani_skill.utils.wrappers.flatten import FlattenRGBDObservationWrapper
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from pictures import (
    CAMERAS,
    EVERYTHING,
    ROWS,
    STOCK,
    drawn,
    make,
    run_without_driver,
)

from dora.errors import InputError
from dora.sim import BACKEND
from dora.sim.cameras import camera_configs
from dora.tasks.env.registration import TASKS


@pytest.fixture(scope="module")
def cubes() -> Iterator[Any]:
    env = make("DoraCube-v1", ROWS, obs_mode=EVERYTHING, preset="standard")
    yield env
    env.close()


# ---- settings ------------------------------------------------------------------------------------


@drawn
def test_sizes_and_poses_are_configuration():
    wide = {"front_camera": {"width": 96, "height": 48, "pose": [0.5, 0, 1.5, 0.7071068, 0, 0.7071068, 0]}}
    env = make("DoraCube-v1", 2, obs_mode="rgb", sensor_configs={"height": 64, **wide})
    obs = env.reset(seed=0)[0]
    assert [obs["sensor_data"][name]["rgb"].shape[1:3] for name in CAMERAS] == [(64, 128), (48, 96)]
    position = env.get_sensor_params()["front_camera"]["cam2world_gl"][:, :3, 3]
    torch.testing.assert_close(position, torch.tensor([[0.5, 0, 1.5]]).expand(2, 3))
    env.close()


def test_each_hand_of_several_arms_has_a_camera():
    specs, mode = TASKS["DoraCube-v1"].CAMERAS, parse_obs_mode_to_struct("rgb")
    left, right = Link.__new__(Link), Link.__new__(Link)
    configs = {config.uid: config.mount for config in camera_configs(specs, {"left": left, "right": right}, mode)}
    assert list(configs) == ["left_hand_camera", "right_hand_camera", "front_camera"]
    assert [configs[name] is link for name, link in zip(configs, (left, right, None), strict=True)] == [True] * 3
    assert [config.uid for config in camera_configs(specs, {"arm": left}, mode)] == list(CAMERAS)


@pytest.mark.parametrize(
    ("mode", "shader"),
    [("rgb+depth", "minimal"), ("position+segmentation", "minimal"), ("albedo", "default"), ("rgb+normal", "default")],
)
def test_only_a_mode_that_the_minimal_shader_draws_whole_takes_it(mode: str, shader: str):
    wanted = parse_obs_mode_to_struct(mode)
    configs = camera_configs(TASKS["DoraCube-v1"].CAMERAS, {"arm": Link.__new__(Link)}, wanted)
    assert [config.shader_pack for config in configs] == [shader] * 2


WRONG = [
    ({"sensor_configs": {"hnd_camera": {"width": 64}}}, "no camera 'hnd_camera'.*hand_camera"),
    ({"sensor_configs": {"hand_camera": {"widht": 64}}}, "no 'widht'.*width"),
    ({"sensor_configs": {"hand_camera": {"width": 0}}}, "width of a camera is 0"),
    ({"sensor_configs": {"fov": 4.0}}, "fov of a camera is 4.0"),
    ({"obs_mode": "albedo", "sensor_configs": {"shader_pack": "minimal"}}, "draws no albedo.*'?shader_pack"),
    ({"obs_mode": "rgb", "render_backend": "none"}, "render_backend is 'none'"),
    ({"obs_mode": "rgbd+state"}, "cannot be joined"),
]  # fmt: skip


@drawn
@pytest.mark.parametrize(("options", "says"), WRONG, ids=[says[:20] for _, says in WRONG])
@pytest.mark.parametrize("backend", ["physx_cpu", BACKEND])
def test_what_cannot_be_drawn_is_refused_in_one_sentence(options: dict[str, Any], says: str, backend: str):
    with pytest.raises(InputError, match=says):
        gym.make("DoraCube-v1", **{"sim_backend": backend, "obs_mode": "rgb", **options})


@drawn
def test_a_task_without_cameras_observes_no_empty_pictures(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(TASKS["DoraCube-v1"], "CAMERAS", {})
    with pytest.raises(InputError, match="CubeEnv has no camera"):
        make("DoraCube-v1", obs_mode="pointcloud")
    env = make("DoraCube-v1", obs_mode="state", render_mode="sensors")
    with pytest.raises(InputError, match="no camera to show"):
        env.render()


NO_DRIVER = """
import gymnasium as gym, dora
from dora.errors import InputError
batch = {"num_envs": 2, "sim_backend": "physx_cpu_batch"}
for env_id, options in (
    ("DoraCube-v1", {}), ("DoraCube-v1", {"render_backend": "cpu"}), ("DoraCube-v1", batch), ("PickCube-v1", batch),
    ("DoraCube-v1", {"obs_mode": "state", "render_mode": "human"}),
    ("PickCube-v1", batch | {"obs_mode": "state", "render_mode": "human"}),
):
    try:
        gym.make(env_id, **{"obs_mode": "state+rgb", **options})
    except InputError as error:
        print("refused:", error)
env = gym.make("DoraCube-v1", obs_mode="state", render_backend="cpu", render_mode="sensors")
env.reset(seed=0)
try:
    env.render()
except InputError as error:
    print("refused:", error)
"""


def test_without_a_driver_one_sentence_says_so():
    result = run_without_driver(NO_DRIVER)
    assert result.returncode == 0, result.stderr
    lines = [line for line in result.stdout.splitlines() if line.startswith("refused:")]
    assert len(lines) == 7
    assert all("no Vulkan driver" in line and "docs/rendering.md" in line for line in lines), lines


# ---- tools that use pictures ---------------------------------------------------------------------


@drawn
@pytest.mark.parametrize("mode", ["state", "rgb", "pointcloud"])
def test_sensors_and_all_are_rendered(cubes: Any, mode: str):
    cubes.reset(seed=0)
    cubes.scene.rendered_environments = [0, 1, 2]
    kept = cubes._obs_mode, cubes.obs_mode_struct, cubes.render_mode
    cubes._obs_mode, cubes.obs_mode_struct = mode, parse_obs_mode_to_struct(mode)
    try:
        shots = []
        for cubes.render_mode in ("sensors", "all"):
            shots.append(cubes.render())
    finally:
        cubes._obs_mode, cubes.obs_mode_struct, cubes.render_mode = kept
    sensors, everything = shots
    assert sensors.shape[0] == everything.shape[0] == ROWS
    assert sensors.shape[1] == 128
    assert everything.shape[1] == 640
    assert everything.shape[2] >= 640 + 128
    assert sensors.float().std() > 5


@drawn
def test_sensors_that_observe_nothing_are_not_shown(cubes: Any, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cubes, "render_mode", "sensors")
    monkeypatch.setattr(cubes, "_obs_mode", "none")
    monkeypatch.setattr(cubes, "obs_mode_struct", parse_obs_mode_to_struct("none"))
    with pytest.raises(InputError, match="obs_mode 'none' has none of"):
        cubes.render()


@drawn
@pytest.mark.skipif("DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ, reason="there is a display")
def test_a_window_without_a_display_is_refused_in_one_sentence():
    with pytest.raises(InputError, match="opens a window"):
        make("DoraCube-v1", render_mode="human")


@drawn
@pytest.mark.parametrize("env_id", ["DoraCube-v1", STOCK])
def test_maniskills_wrappers_take_pictures_of_a_batch(env_id: str, tmp_path: Path):
    env: Any = gym.make(env_id, num_envs=2, sim_backend=BACKEND, obs_mode="rgb+depth", render_mode="all",
                   render_backend="cpu", human_render_camera_configs={"width": 64, "height": 64})  # fmt: skip
    recorder = RecordEpisode(env, str(tmp_path), trajectory_name="recorded", max_steps_per_video=3)
    flat = FlattenRGBDObservationWrapper(recorder)
    vector = ManiSkillVectorEnv(flat, auto_reset=True, ignore_terminations=False)
    obs, _ = vector.reset(seed=0)
    cameras = len(recorder.unwrapped._sensors)  # pyright: ignore[reportAttributeAccessIssue]
    assert obs["rgb"].shape == (2, 128, 128, 3 * cameras)
    assert obs["depth"].shape == (2, 128, 128, cameras)
    assert vector.single_observation_space["rgb"].shape == (128, 128, 3 * cameras)  # pyright: ignore
    for _ in range(4):
        obs = vector.step(vector.action_space.sample())[0]
    assert obs["state"].shape == (2, vector.single_observation_space["state"].shape[0])  # pyright: ignore
    vector.close()
    films = list(tmp_path.glob("*.mp4"))
    assert films
    assert all(film.stat().st_size > 1000 for film in films)
    with h5py.File(tmp_path / "recorded.h5") as file:
        stored: Any = file["traj_0/obs/sensor_data"]
        assert len(stored) == cameras
        assert all(np.ptp(camera["rgb"][-1]) > 50 for camera in stored.values())


@drawn
@pytest.mark.skipif(find_spec("moviepy") is None, reason="RecordVideo needs moviepy: pip install 'gymnasium[other]'")
def test_gymnasium_films_a_single_environment(tmp_path: Path):
    env = gym.make("DoraCube-v1", obs_mode="rgb", render_mode="sensors")
    film: Any = gym.wrappers.RecordVideo(CPUGymWrapper(env), str(tmp_path), video_length=4)
    obs, _ = film.reset(seed=0)
    assert obs["sensor_data"]["front_camera"]["rgb"].shape == (128, 128, 3)
    assert film.observation_space.contains(obs)
    for _ in range(5):
        film.step(film.action_space.sample())
    film.close()
    (path,) = tmp_path.glob("*.mp4")
    assert path.stat().st_size > 1000
