"""Pictures as observations: what they show, of which row, and in which units."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.utils.structs import Actor, Pose
from pictures import CAMERAS, EVERYTHING, MODES, ROWS, SHAPES, STOCK, drawn, make, number_of, observe, pictures
from torch import Tensor

import dora.tasks as tasks
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.registration import TASKS


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
    moved = {name: body for name, body in env.objects.items() if isinstance(body, Actor)}  # the others are links
    for body in moved.values():
        pose = body.pose
        body.set_pose(Pose.create_from_pq(pose.p + 0.05, pose.q[:, [1, 0, 3, 2]]))
        body.set_linear_velocity(body.linear_velocity + 0.1)
    env._snapshot = None
    after: Any = env.get_obs()
    arms = [name for name, arm in env.arms.items() if arm.spec.object in moved]
    own = [f"{arm}/" for arm in arms] if len(env.arms) > 1 else [""]
    sensed = {f"{arm}{name}" for arm in own for name in ("hand_q", "arm_q", "wrist_p", "touch")}
    assert before["agent"].keys() == after["agent"].keys() >= sensed
    for name, value in before["agent"].items():
        assert torch.equal(value, after["agent"][name]), name
    privileged = {"object_p", "object_R", "object_v", "object_rise", "goal", "nearest"}
    for name in (f"{arm}{name}" for arm in own for name in privileged):
        assert not torch.equal(before["extra"][name], after["extra"][name]), name
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
@pytest.mark.parametrize("env_id", [name for name in tasks.task_ids() if len(TASKS[name].ARMS) == 1])
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
