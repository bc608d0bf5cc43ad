"""What a task draws at random, restores, builds and lets choose: numbers that are worked out anew."""

import contextlib
from dataclasses import replace
from math import pi
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from invented import invented
from test_guidance import CPU, along_x
from torch import Tensor

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.reach.feasibility_table import Grid
from dora.errors import InputError
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_from_yaw
from dora.tasks.cube import CubeConfig, CubeTask
from dora.tasks.env import options, scene
from dora.tasks.env.episode_start import SCALE_DRAW, drawn_sizes
from dora.tasks.env.options import check_grasps, choose_render_backend, numbers_under_preset, task_config
from dora.tasks.env.perturbations import KEYS, OBJECT_DRAWS, STILL, Perturbations, uniform
from dora.tasks.env.scene import film_camera, freeing_the_old_scene, sim_config
from dora.tasks.env.starts import TRIES, standing, standing_starts
from dora.tasks.env.task import short_name
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.jug import JugConfig, JugTask
from dora.tasks.mdp.randomisation import Randomisation

# ------------------------------------------------------------------------ random numbers

MASK = 2**32 - 1


def mixed(word: int) -> int:
    """MurmurHash3's finaliser."""
    word ^= word >> 16
    word = word * 0x85EBCA6B & MASK
    word ^= word >> 13
    word = word * 0xC2B2AE35 & MASK
    return word ^ word >> 16


def test_random_numbers_are_those_of_murmur_hash():
    golden = 0x9E3779B9
    for key, step in ((0, 0), (5, 3), (KEYS - 1, STILL)):
        row = mixed(mixed(key + golden & MASK) + step)
        expected = [(mixed(row + k * golden & MASK) >> 8) / 2**24 for k in range(1, 5)]
        assert uniform(torch.tensor([key]), torch.tensor([step]), 4)[0].tolist() == pytest.approx(expected, abs=1e-9)


R = Randomisation(
    observed_position=0.01, observed_rotation=0.1, observed_joint=0.2, push=0.3, push_rate=8.0, candidate_position=0.1
)
STEP = torch.tensor([7, 7])


def noise(pose_filter: float = 1.0, hands: dict[str, int] | None = None, r: Randomisation = R) -> Perturbations:
    made = Perturbations(r, 2, 26, hands or {"arm": 20}, 0.05, CPU, pose_filter)
    made.begin(torch.arange(2), torch.tensor([0.25, 0.999]))
    return made


def test_an_episode_has_the_key_of_its_share():
    assert noise().buffers.key.tolist() == [KEYS / 4, float(int(KEYS * np.float32(0.999)))]


def test_errors_of_what_is_observed_are_the_random_numbers_of_the_step():
    made, choice = noise(), CandidateChoice(along_x(0.1), 2, CPU)
    seen = made.observed(invented(2), {"arm": choice}, STEP)
    u = 2 * uniform(made.buffers.key.long(), STEP, 26) - 1
    torch.testing.assert_close(seen.object.p, 0.01 * u[:, :3])
    torch.testing.assert_close(seen.object.q, quaternion_from_rotation_vector(0.1 * u[:, 3:OBJECT_DRAWS]))
    torch.testing.assert_close(seen.hand.q, 0.2 * u[:, OBJECT_DRAWS:])
    assert not made.observed(invented(2), {"arm": choice}, STEP + 1).object.p.equal(seen.object.p)


def test_pushes_come_after_the_numbers_of_the_sensors():
    """With two arms, and two objects of which each is pushed by itself."""
    made = noise(hands={"left": 20, "right": 16})
    u = uniform(made.buffers.key.long(), STEP, 52 + 2 * 4)[:, 48:52].reshape(2, 2, 2)
    size, angle = 0.3 * (u[..., 0] < 8.0 * 0.05), 2 * pi * u[..., 1]
    expected = torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], -1)
    torch.testing.assert_close(made.pushes(STEP, 2), expected)
    assert 0 < int((expected.norm(dim=-1) > 0).sum()) <= 4
    assert noise(r=Randomisation()).pushes(STEP, 2).tolist() == [[[0.0] * 3] * 2] * 2


@pytest.mark.parametrize("name", ["observed_position", "observed_rotation", "observed_joint"])
def test_one_error_is_enough_to_be_noisy(name: str):
    assert replace(Randomisation(), **{name: 0.01}).noisy
    assert not Randomisation().noisy


def test_a_pose_is_measured_anew_where_it_has_moved_by_three_centimetres():
    """An estimate of poses that are known without an error, but for one of the hand's joints."""
    made, choice = noise(0.5, r=Randomisation(observed_joint=0.1)), {"arm": CandidateChoice(along_x(0.1), 2, CPU)}

    def seen(x: float, y: float) -> list[float]:
        p = torch.tensor([[x, 0.0, 0.0], [y, 0.0, 0.0]])
        found = made.observed(invented(2, object_p=p), choice, STEP)
        made.remember(found)
        return found.object.p[:, 0].tolist()

    assert seen(0.0, 0.0) == [0.0, 0.0]
    assert seen(0.02, 0.031) == pytest.approx([0.01, 0.031])
    assert made.buffers.arm_count.tolist() == [2.0, 1.0]
    assert seen(0.02, 0.041) == pytest.approx([0.015, 0.036])  # shares of 1/2, as 1/3 is below the filter's
    made.begin(torch.tensor([1]), torch.tensor([0.5]))
    assert made.buffers.arm_count.tolist() == [3.0, 0.0]
    assert noise(1.0).buffers.names == ("key", "waiting")


class Stream:
    """Random numbers that are known: those of environment k are k / 10 more than their place / 1000."""

    def uniform(self, size: tuple[int, ...]) -> np.ndarray:
        return np.arange(size[0])[None] / 1000 + np.arange(2)[:, None] / 10


def test_sizes_are_drawn_behind_the_numbers_of_episodes():
    env = SimpleNamespace(
        num_envs=2, _batched_episode_rng=Stream(), device=CPU, task=SimpleNamespace(ONE_SIZE=frozenset({"one"})),
        config=SimpleNamespace(randomisation=Randomisation(size=0.2)),
    )  # fmt: skip
    first = (SCALE_DRAW - 1) / 1000
    expected = [
        [1 + 0.2 * (2 * (first + k / 10) - 1), 1.0, 1 + 0.2 * (2 * (first + 0.002 + k / 10) - 1)] for k in (0, 1)
    ]
    torch.testing.assert_close(drawn_sizes(env, ("a", "one", "c")), torch.tensor(expected))


# ------------------------------------------------------------------------ starts

GRID = Grid((0.5, -0.2), (0.1, 0.3))


def test_objects_stand_where_their_numbers_say():
    u = torch.zeros(1, TRIES, 3)
    u[0, 0] = torch.tensor([0.75, 0.0, 0.25])
    p, q = standing(u.flatten(1), torch.tensor([0.07]), GRID, lambda p, q: torch.ones(len(p), 1, dtype=torch.bool))
    torch.testing.assert_close(p, torch.tensor([[0.55, -0.5, 0.07]]))
    torch.testing.assert_close(q, quaternion_from_yaw(torch.tensor([pi / 2])))


def test_a_start_that_is_chosen_is_told_by_its_pose():
    starts = standing_starts(GRID)
    ranges = [(n.name, n.unit, n.low, n.high) for n in starts.numbers]
    assert ranges == [
        ("x", "m", pytest.approx(0.4), pytest.approx(0.6)), ("y", "m", pytest.approx(-0.5), pytest.approx(0.1)),
        ("yaw", "rad", 0.0, 2 * pi),
    ]  # fmt: skip
    chosen = torch.tensor([0.25, 0.75, 0.875])
    u = starts.draws(chosen)
    assert u.shape == (3 * TRIES,)
    p, q = standing(u[None], torch.tensor([0.07]), GRID, lambda p, q: torch.ones(len(p), 1, dtype=torch.bool))
    torch.testing.assert_close(starts.shares(u, (p[0], q[0])), chosen)
    outside = starts.shares(u, (torch.tensor([0.0, 1.0, 0.0]), torch.tensor([1.0, 0.0, 0.0, 0.0])))
    assert outside.tolist() == [0.0, 1.0, 0.0]


def test_tasks_whose_object_stands_let_choose_its_place():
    starts = CubeTask(CubeConfig()).starts()
    assert starts is not None
    assert [number.name for number in starts.numbers] == ["x", "y", "yaw"]


def test_masses_are_nominal_times_a_share_or_from_empty_to_full():
    u, nominal = torch.tensor([0.0, 0.5, 1.0]), torch.tensor([2.0, 2.0, 2.0])
    config = task_config(CubeConfig, "none", {"randomisation": {"mass": 0.25}})
    assert CubeTask(config).masses("cube", nominal, u).tolist() == [1.5, 2.0, 2.5]
    jug = JugTask(task_config(JugConfig, "standard", {"mass": [0.3, 0.7]}))
    assert jug.masses("jug", nominal, u).tolist() == pytest.approx([0.3, 0.5, 0.7])
    assert JugTask(task_config(JugConfig, "none", None)).masses("jug", nominal, u).tolist() == [2.0] * 3
    assert [short_name(name) for name in ("DoraCube-v1", "DoraMicrowave-v1")] == ["cube", "microwave"]


# ------------------------------------------------------------------------ options

TAKEN: list[dict[str, Any]] = [
    {"randomisation": {"size": 0.99}}, {"randomisation": {"friction": [0.0, 0.0]}}, {"randomisation": {"delay": 1000}},
    {"control_frequency": 1, "physics_frequency": 1}, {"arm_effort": 0.01}, {"pose_filter": 0.01},
    {"hand_speed": 0.01}, {"hand_speed": 1.0}, {"hand_effort": 0.01}, {"wrist_speed": 0.01}, {"overlap_grace": 0.0},
    {"solver_iterations": 255}, {"control_frequency": 50}, {"history": 100},
]  # fmt: skip
REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"randomisation": {"size": 1.0}}, "size is 1.0; it is a share"),
    ({"randomisation": {"mass": 1.0}}, "mass is 1.0; it is a share"),
    ({"randomisation": {"friction": [0.6, 0.5]}}, "friction"), ({"control_frequency": 30}, "multiple"),
    ({"randomisation": {"friction": [-0.1, 0.5]}}, "friction"), ({"definition": 0}, "definition"),
    ({"randomisation": {"delay": 1001}}, "delay"), ({"lift": float("nan")}, "lift"),
    ({"definition": 2}, "definition"), ({"arm_effort": 0.009}, "arm_effort"), ({"arm_effort": 1.01}, "arm_effort"),
    ({"solver_iterations": 256}, "solver_iterations"), ({"control_frequency": 0}, "control_frequency"),
    ({"residual": {"position": -0.1}}, "residual"), ({"hold_time": -0.1}, "hold_time"),
    ({"hand_speed": 0.009}, "hand_speed"), ({"hand_speed": 1.01}, "hand_speed"),
    ({"hand_effort": 1.01}, "hand_effort"), ({"wrist_speed": 0.0}, "wrist_speed"),
    ({"overlap_grace": -0.1}, "overlap_grace"), ({"history": -1}, "history"), ({"history": 101}, "history"),
]  # fmt: skip


@pytest.mark.parametrize("changes", TAKEN, ids=str)
def test_numbers_at_their_limits_are_taken(changes: dict[str, Any]):
    config = task_config(CubeConfig, "none", changes)
    assert config.dt == 1 / config.control_frequency


@pytest.mark.parametrize(("changes", "words"), REFUSED, ids=str)
def test_numbers_beyond_their_limits_are_refused(changes: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words):
        task_config(CubeConfig, "none", changes)


@pytest.mark.parametrize(
    ("given", "rates"),
    [
        ({"sim_freq": 200}, (200, 20)), ({"control_freq": 50}, (100, 50)),
        ({"sim_freq": 240, "control_freq": 40}, (240, 40)),
        ({"sim_freq": 110}, (100, 20)), ({"control_freq": 0}, (100, 20)), ({"sim_freq": 0}, (100, 20)),
        ({"sim_freq": True}, (100, 20)), ({"control_freq": -20}, (100, 20)), (None, (100, 20)), (3, (100, 20)),
    ],
)  # fmt: skip
def test_rates_of_maniskill_that_fit_are_the_tasks(given: Any, rates: tuple[int, int]):
    config = task_config(CubeConfig, "none", None, given)
    assert (config.physics_frequency, config.control_frequency) == rates


def test_under_another_preset_what_was_changed_by_hand_stays():
    """The jug's filter is that of preset `hard`, unless it has been set."""
    hard = numbers_under_preset(JugConfig, {"pose_filter": 1.0, "lift": 0.2, "randomisation": {}}, "standard", "hard")
    assert (hard["pose_filter"], hard["lift"], hard["randomisation"]["delay"]) == (0.15, 0.2, 1)
    assert numbers_under_preset(JugConfig, {"pose_filter": 0.5}, "standard", "hard") == {"pose_filter": 0.5}
    assert numbers_under_preset(JugConfig, {"pose_filter": 0.15}, "hard", "none") == {"pose_filter": 1.0}
    assert numbers_under_preset(JugConfig, {}, "hard", "none") == {}


def test_grasps_are_given_for_the_only_arm_or_by_name():
    grasps = load_candidates("cube")
    assert check_grasps(None, ("arm",)) == {}
    assert list(check_grasps(grasps, ("arm",))) == ["arm"]
    assert list(check_grasps({"right": grasps}, ("left", "right"))) == ["right"]
    for wrong, arms in ((grasps, ("left", "right")), ({"middle": grasps}, ("left", "right")), ({"arm": 3}, ("arm",))):
        with pytest.raises(InputError, match="grasps"):
            check_grasps(wrong, arms)


@pytest.mark.parametrize(
    ("asked", "mode", "observed", "chosen"),
    [
        ("auto", None, "state", "none"), ("auto", "rgb_array", "state", "auto"), ("cpu", None, "state", "cpu"),
        ("auto", None, "rgb", "auto"), ("none", "rgb_array", "state", "none"), (None, None, "state", "none"),
        ("auto", "human", "state", "auto"),
    ],
)  # fmt: skip
def test_pictures_are_drawn_where_they_can_be_asked_for(
    asked: str | None, mode: str | None, observed: str, chosen: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(options, "can_render", lambda: True)
    default = "gpu" if torch.cuda.is_available() else "cpu"
    assert choose_render_backend(asked, mode, observed) == (default if chosen == "auto" else chosen)
    monkeypatch.setattr(options, "can_render", lambda: False)
    if observed == "rgb" or mode == "human":
        with pytest.raises(InputError):
            choose_render_backend(asked, mode, observed)
    else:
        assert choose_render_backend(asked, mode, observed) == "none"


def test_pictures_without_a_back_end_are_refused():
    with pytest.raises(InputError):
        choose_render_backend("none", None, "rgb")


# ------------------------------------------------------------------------ the scene


def test_the_physics_is_that_of_the_numbers():
    config = task_config(CubeConfig, "none", {"contact_offset": 0.004, "solver_iterations": 7, "control_frequency": 25})
    made = sim_config(config)
    assert (made.sim_freq, made.control_freq) == (100, 25)
    scene, material = made.scene_config, made.default_materials_config
    assert (scene.contact_offset, scene.solver_position_iterations, scene.solver_velocity_iterations) == (0.004, 7, 1)
    assert (scene.sleep_threshold, scene.enable_pcm) == (0.0, False)
    assert (material.static_friction, material.dynamic_friction) == (0.9, 0.9)


@pytest.mark.parametrize(
    ("before", "after", "collected"), [("a", "a", 0), ("a", "b", 1), ("a", None, 1), (None, "b", 0), (None, None, 0)]
)
@pytest.mark.parametrize("fails", [False, True])
def test_an_old_scene_is_collected_once_it_is_no_longer_the_tasks(
    before: str | None, after: str | None, collected: int, fails: bool, monkeypatch: pytest.MonkeyPatch
):
    calls: list[None] = []
    monkeypatch.setattr(scene.gc, "collect", lambda: calls.append(None))
    env = SimpleNamespace(scene=before)
    with contextlib.suppress(KeyError), freeing_the_old_scene(env):
        env.scene = after
        if fails:
            raise KeyError
    assert len(calls) == collected


def test_films_are_square_and_look_from_the_eye_at_the_target():
    camera: Any = film_camera((1.0, 0.0, 0.5), (0.0, 0.0, 0.5))
    assert (camera.width, camera.height, camera.fov, camera.near, camera.far) == (640, 640, 0.8, 0.01, 10)
    pose: Tensor = camera.pose.raw_pose[0]
    torch.testing.assert_close(pose[:3], torch.tensor([1.0, 0.0, 0.5]))
    torch.testing.assert_close(pose[3:].abs(), torch.tensor([0.0, 0.0, 0.0, 1.0]), atol=1e-5, rtol=0)
