"""Pictures as observations: what they show, of which row, in which units, and what is said where there are none."""

import os
import subprocess
import sys
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
from mani_skill.utils.structs import Link, Pose
from mani_skill.utils.wrappers.flatten import FlattenRGBDObservationWrapper
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from torch import Tensor

import dora.tasks as tasks
from dora.errors import InputError
from dora.sim import BACKEND, can_render
from dora.sim.cameras import camera_configs
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.registration import TASKS

ROWS = 3
"""Environments of a batch."""
CAMERAS = ("hand_camera", "front_camera")
EVERYTHING = "rgb+depth+segmentation"
SHAPES = {"rgb": (3, torch.uint8), "depth": (1, torch.int16), "segmentation": (1, torch.int16)}
"""Channels and type of each texture."""
MODES = {
    "rgb": ("rgb",), "depth": ("depth",), "rgbd": ("rgb", "depth"), "depth+segmentation": ("depth", "segmentation"),
    EVERYTHING: ("rgb", "depth", "segmentation"), "state_dict+rgb": ("rgb",),
}  # fmt: skip
"""Textures of some modes."""
STOCK = "PickCube-v1"

drawn = pytest.mark.skipif(not can_render(), reason="needs a Vulkan driver: docs/rendering.md")


def make(env_id: str, num_envs: int | None = None, **options: Any) -> Any:
    """An environment, on `physx_cpu_batch` if a number is given, and otherwise a single one of ManiSkill's way."""
    count, backend = (1, "physx_cpu") if num_envs is None else (num_envs, BACKEND)
    return gym.make(env_id, num_envs=count, sim_backend=backend, render_backend="cpu", **options).unwrapped


def observe(env: Any, mode: str) -> Any:
    """What is observed in another mode, of the present state."""
    kept = env._obs_mode, env.obs_mode_struct
    env._obs_mode, env.obs_mode_struct = mode, parse_obs_mode_to_struct(mode)
    try:
        return env.get_obs()
    finally:
        env._obs_mode, env.obs_mode_struct = kept


def pictures(obs: Any) -> dict[str, Tensor]:
    """All pictures by camera and texture."""
    return {f"{c}/{t}": p for c, textures in obs["sensor_data"].items() for t, p in textures.items()}


def number_of(env: Any, name: str) -> int:
    """The number of an object or link in pictures of segmentation."""
    (number,) = (key for key, body in env.segmentation_id_map.items() if body.name == name)
    return number


@pytest.fixture(scope="module")
def cubes() -> Iterator[Any]:
    env = make("DoraCube-v1", ROWS, obs_mode=EVERYTHING, preset="standard")
    yield env
    env.close()


@pytest.fixture(scope="module")
def stock() -> Iterator[Any]:
    env = make(STOCK, ROWS, obs_mode=EVERYTHING)
    yield env
    env.close()


# ---- what is observed ----------------------------------------------------------------------------


@drawn
@pytest.mark.parametrize("mode", MODES)
def test_every_mode_has_pictures_of_both_cameras(cubes: Any, mode: str):
    cubes.reset(seed=0)
    shots = observe(cubes, mode)["sensor_data"]
    assert tuple(shots) == CAMERAS
    for shot in shots.values():
        assert set(shot) == set(MODES[mode])
        for texture, picture in shot.items():
            channels, dtype = SHAPES[texture]
            assert picture.shape == (ROWS, 128, 128, channels)
            assert picture.dtype == dtype
            assert all(len(row.unique()) > 3 for row in picture), "there is something to see"


@drawn
def test_normals_and_albedo_are_drawn_by_another_shader():
    env = make("DoraCube-v1", obs_mode="rgb+normal+albedo")
    shot = env.reset(seed=0)[0]["sensor_data"]["front_camera"]
    assert set(shot) == {"rgb", "normal", "albedo"}
    assert all(len(picture.unique()) > 3 for picture in shot.values())
    env.close()


@drawn
def test_state_beside_pictures_is_the_state_alone():
    options = {"num_envs": 2, "preset": "hard"}
    both, alone = make("DoraJug-v1", obs_mode="state+rgb", **options), make("DoraJug-v1", obs_mode="state", **options)
    steps = torch.rand(6, 2, both.action_size) * 2 - 1
    for env in (both, alone):
        env.reset(seed=4)
    for action in steps:
        obs, state = both.step(action)[0], alone.step(action)[0]
        assert set(obs) == {"state", "sensor_param", "sensor_data"}
        assert torch.equal(obs["state"], state)
    for env in (both, alone):
        env.close()


@pytest.mark.parametrize("env_id", tasks.task_ids())
def test_the_state_is_the_table_in_its_order(env_id: str):
    env = tasks.make_task(env_id, 2, preset="standard")
    state = env.reset(seed=0)[0]
    assert torch.equal(state, torch.cat([entry.value(env.observed) for entry in env.observation_entries.values()], -1))
    env.close()


@drawn
def test_pictures_without_state_leave_out_what_is_privileged(cubes: Any):
    cubes.reset(seed=0)
    entries, seen = cubes.observation_entries, observe(cubes, "rgb")
    assert set(seen["agent"]) == {name for name, entry in entries.items() if entry.sensed}
    assert seen["extra"] == {}
    everything = observe(cubes, "state_dict+rgb")
    assert set(everything["agent"]) | set(everything["extra"]) == set(entries)


@pytest.mark.parametrize("env_id", tasks.task_ids())
def test_what_is_not_privileged_knows_nothing_of_the_objects(env_id: str):
    env = tasks.make_task(env_id, 2, preset="standard", obs_mode="state_dict")
    env.reset(seed=0)
    before: Any = env.step(env.scripted_action())[0]
    for body in env.objects.values():
        pose = body.pose
        body.set_pose(Pose.create_from_pq(pose.p + 0.05, pose.q[:, [1, 0, 3, 2]]))
        body.set_linear_velocity(body.linear_velocity + 0.1)
    env._snapshot = None
    after: Any = env.get_obs()
    assert before["agent"].keys() == after["agent"].keys() >= {"hand_q", "arm_q", "wrist_p", "touch"}
    for name, value in before["agent"].items():
        assert torch.equal(value, after["agent"][name]), name
    privileged = {"object_p", "object_R", "object_v", "object_rise", "goal", "nearest"}
    assert all(not torch.equal(before["extra"][name], after["extra"][name]) for name in privileged)
    env.close()


# ---- whose picture it is -------------------------------------------------------------------------


def difference(picture: Tensor, other: Tensor) -> Tensor:
    return (picture.float() - other.float()).abs()


@drawn
@pytest.mark.parametrize("env_id", tasks.task_ids())
def test_a_row_shows_what_a_single_environment_shows(env_id: str):
    """Same seed, same actions: the same pictures, pixel for pixel."""
    batch, single = make(env_id, 2, obs_mode=EVERYTHING), make(env_id, obs_mode=EVERYTHING)
    rolled = pictures(roll(batch, [5, 6]))
    for row in range(2):
        alone = roll(single, [5 + row], row)
        assert pictures(alone).keys() == rolled.keys()
        for name, picture in pictures(alone).items():
            assert torch.equal(picture[0], rolled[name][row]), name
    for env in (batch, single):
        env.close()


def roll(env: Any, seeds: list[int], row: int | None = None) -> Any:
    """Observation after some actions, which are the same for a row of a batch and for a single environment."""
    env.reset(seed=seeds)
    actions = torch.rand(4, 2, env.action_size, generator=torch.Generator().manual_seed(1)) * 2 - 1
    for action in actions if row is None else actions[:, [row]]:
        obs = env.step(action)[0]
    return obs


@drawn
def test_a_row_of_a_stock_task_shows_what_a_single_environment_shows(stock: Any):
    """A state that is restored differs in its last bits, so edges may differ by a shade."""
    stock.reset(seed=0)
    stock.action_space.seed(0)
    for _ in range(3):
        batch = stock.step(stock.action_space.sample())[0]
    state, single = stock.get_state_dict(), make(STOCK, obs_mode=EVERYTHING)
    single.reset(seed=0)
    for row in range(ROWS):
        single.set_state_dict(
            {kind: {name: v[row : row + 1] for name, v in state[kind].items()} for kind in ("actors", "articulations")}
        )
        alone = single.get_obs()
        for name, picture in pictures(alone).items():
            off = difference(picture[0], pictures(batch)[name][row])
            assert (off > 0).float().mean() < 0.005, name
            assert off.max() <= (0 if "segmentation" in name else 3), name
        goal = alone["extra"]["goal_pos"]
        torch.testing.assert_close(goal[0], batch["extra"]["goal_pos"][row])
    single.close()


@drawn
@pytest.mark.parametrize("name", ["cubes", "stock"])
def test_moving_an_object_changes_the_picture_of_its_row_only(name: str, request: pytest.FixtureRequest):
    env = request.getfixturevalue(name)
    env.reset(seed=0)
    cube = env.target_object if isinstance(env, DoraEnv) else env.cube
    before = pictures(env.get_obs())
    pose = cube.pose
    moved = pose.p.clone()
    moved[1, :2] += 0.06
    cube.set_pose(Pose.create_from_pq(moved, pose.q))
    after = pictures(env.get_obs())
    for key, picture in before.items():
        same = [torch.equal(picture[row], after[key][row]) for row in range(ROWS)]
        assert same == [True, False, True], key


@drawn
@pytest.mark.parametrize("name", ["cubes", "stock"])
def test_a_partial_reset_shows_the_new_episode(name: str, request: pytest.FixtureRequest):
    env = request.getfixturevalue(name)
    env.reset(seed=0)
    for _ in range(8):
        before = pictures(env.step(env.action_space.sample())[0])
    after = env.reset(options={"env_idx": [2]})[0]
    for key, picture in before.items():
        assert all(torch.equal(picture[row], pictures(after)[key][row]) for row in (0, 1)), key
        assert not torch.equal(picture[2], pictures(after)[key][2]), key
    position = (env.target_object if isinstance(env, DoraEnv) else env.cube).pose.p
    expect_at(env, after, list(after["sensor_data"])[-1], "cube", position)


@drawn
def test_hiding_an_actor_moves_nothing(stock: Any):
    """On a GPU ManiSkill moves it 100 km away, where a body that is not kinematic would count as a blow-up."""
    stock.reset(seed=0)
    stock.get_obs()
    goals = np.array([entity.pose.p for entity in stock.goal_site._objs])
    assert np.abs(goals).max() < 1
    assert number_of(stock, "goal_site") not in stock.get_obs()["sensor_data"]["base_camera"]["segmentation"]
    stock.render_mode = "rgb_array"
    shown = stock.render()
    assert (difference(shown[0, ..., 1], shown[0, ..., 0]) > 50).sum() > 20, "the green goal is shown to people"


# ---- numbers that fit the scene ------------------------------------------------------------------


def projected(obs: Any, camera: str, points: Tensor) -> Tensor:
    """Pixels (n, 2) of world points (n, 3), by the camera's parameters in the observation."""
    parameters = obs["sensor_param"][camera]
    points = torch.cat([points, torch.ones(len(points), 1)], -1)
    seen = (parameters["intrinsic_cv"] @ parameters["extrinsic_cv"] @ points[..., None])[..., 0]
    return seen[:, :2] / seen[:, 2:]


def expect_at(env: Any, obs: Any, camera: str, name: str, position: Tensor) -> None:
    """The middle of an object's pixels is where the camera's parameters put it."""
    marked = obs["sensor_data"][camera]["segmentation"][..., 0] == number_of(env, name)
    for row, pixel in enumerate(projected(obs, camera, position)):
        ys, xs = marked[row].nonzero(as_tuple=True)
        assert len(xs) > 10
        middle = torch.stack([xs, ys], -1).float().mean(0) + 0.5
        assert (middle - pixel).norm() < 4, (row, middle, pixel)


@drawn
def test_segmentation_names_what_is_where_the_cameras_parameters_say(cubes: Any):
    obs = cubes.reset(seed=3)[0]
    for camera in CAMERAS:
        expect_at(cubes, obs, camera, "cube", cubes.target_object.pose.p)
    present = {int(k) for k in obs["sensor_data"]["front_camera"]["segmentation"].unique()} - {0}
    names = {cubes.segmentation_id_map[k].name for k in present}
    assert {"cube", "table", "base_link_hithand", "Right_Index_Phadist"} <= names


@drawn
def test_depth_is_the_distance_along_the_view(cubes: Any):
    obs = cubes.reset(seed=3)[0]
    marked = obs["sensor_data"]["front_camera"]["segmentation"] == number_of(cubes, "cube")
    to_camera = obs["sensor_param"]["front_camera"]["extrinsic_cv"]
    centre = torch.cat([cubes.target_object.pose.p, torch.ones(ROWS, 1)], -1)
    for row in range(ROWS):
        depth = obs["sensor_data"]["front_camera"]["depth"][row][marked[row]] / 1000
        away = (to_camera[row] @ centre[row])[2]
        corner = cubes.task_scene.half[row, 0] * 3**0.5 + 0.002
        assert away - corner < depth.min() < away - 0.02, "its front is nearer than its middle"
        assert depth.max() < away + corner


@drawn
def test_the_point_cloud_is_in_the_world_in_metres(cubes: Any):
    cubes.reset(seed=3)
    cloud = observe(cubes, "pointcloud")["pointcloud"]
    assert cloud["xyzw"].shape == (ROWS, 2 * 128 * 128, 4)
    for row in range(ROWS):
        which = cloud["segmentation"][row, :, 0]
        points = cloud["xyzw"][row]
        cube = points[which == number_of(cubes, "cube"), :3] - cubes.target_object.pose.p[row]
        half = cubes.task_scene.half[row, 0]
        assert len(cube) > 50
        assert cube.norm(dim=-1).max() < half * 3**0.5 + 0.003
        assert cube.norm(dim=-1).min() > half - 0.003
        table = points[which == number_of(cubes, "table"), :3]
        on_top = table[(table[:, 2] > -0.03) & (table[:, 0] > 0.2)]
        assert on_top[:, 2].abs().max() < 0.025
        assert on_top[:, 2].abs().median() < 0.002


@drawn
def test_the_hand_camera_moves_with_the_hand_and_the_front_camera_stays(cubes: Any):
    def frames() -> tuple[Tensor, Tensor, Tensor]:
        wrist = cubes.arm.agent.wrist.pose
        camera, front = (cubes.get_sensor_params()[name]["cam2world_gl"].clone() for name in CAMERAS)
        return torch.linalg.solve(wrist.to_transformation_matrix(), camera), camera, front

    cubes.reset(seed=0)
    in_hand, start, front = frames()
    for _ in range(15):
        cubes.step(cubes.scripted_action())
    again, now, front_again = frames()
    assert (now[:, :3, 3] - start[:, :3, 3]).norm(dim=-1).min() > 0.05
    torch.testing.assert_close(again, in_hand, atol=1e-5, rtol=0)
    assert torch.equal(front, front_again)
    eye = torch.tensor(TASKS["DoraCube-v1"].CAMERAS["hand_camera"].eye)
    torch.testing.assert_close(in_hand[:, :3, 3], eye.expand(ROWS, 3), atol=1e-5, rtol=0)


@drawn
@pytest.mark.parametrize("env_id", tasks.task_ids())
def test_the_cameras_of_a_task_see_hand_and_object_at_work(env_id: str):
    env = make(env_id, obs_mode="segmentation", preset="none")
    env.reset(seed=0)
    seen: dict[str, int] = dict.fromkeys(CAMERAS, 0)
    (name,) = env.objects
    hand = [number for number, body in env.segmentation_id_map.items() if body.name.startswith("Right_")]
    for step in range(1, 49):
        obs = env.step(env.scripted_action())[0]
        for camera in CAMERAS if step % 6 == 0 else ():
            picture = obs["sensor_data"][camera]["segmentation"]
            both = (picture == number_of(env, name)).sum() > 20 and torch.isin(picture, torch.tensor(hand)).sum() > 100
            seen[camera] += bool(both)
    assert all(count >= 4 for count in seen.values()), seen
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
    environment = os.environ | {"VK_ICD_FILENAMES": "/dev/null", "VK_DRIVER_FILES": "/dev/null"}
    result = subprocess.run(
        [sys.executable, "-c", NO_DRIVER], env=environment, capture_output=True, text=True, timeout=120
    )
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
