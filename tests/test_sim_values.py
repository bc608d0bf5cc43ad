"""Contacts, overlap, hinges, bodies and checks of cameras on invented contacts and bodies, in numbers."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from mani_skill.envs.scene import ManiSkillScene
from scipy.spatial.transform import Rotation

from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.robot.shapes import Shape
from dora.sim.actors import CONTACT_OFFSET, object_entity
from dora.sim.cameras import MOST_PIXELS, CameraSpec, check_cameras, check_names, check_settings, check_shown
from dora.sim.contacts import ContactMonitor
from dora.sim.hinged import FRICTION_SPEED, HingedObject, _turning_x_to
from dora.sim.keywords import check_names as check_keywords
from dora.sim.keywords import on_gpu
from dora.sim.overlap import OverlapMonitor
from dora.sim.robots import class_name
from dora.sim.shapes import drawn_box
from dora.tasks.env.env import DoraEnv


class Scene(ManiSkillScene):
    """A scene of one environment whose contacts are invented, one list of them for each physics step."""

    gpu_sim_enabled: Any = False
    num_envs: Any = 1
    device: Any = torch.device("cpu")

    def __init__(self, *steps: list[Any]):
        self.steps, self.now = steps, -1
        self.px: Any = SimpleNamespace(get_contacts=lambda: self.steps[self.now])

    def step(self) -> None:
        self.now += 1


def body(name: str) -> Any:
    return SimpleNamespace(name=name, _bodies=[SimpleNamespace(entity=SimpleNamespace(name=name))])


def contact(one: Any, other: Any, *points: tuple[tuple[float, ...], float, tuple[float, ...]]) -> Any:
    """A contact with points of an impulse on the first body, a separation and a position."""
    made = [
        SimpleNamespace(impulse=np.array(i, np.float32), separation=s, position=np.array(p, np.float32))
        for i, s, p in points
    ]
    return SimpleNamespace(bodies=[one._bodies[0], other._bodies[0]], points=made)


A, B, C, D = (body(name) for name in "abcd")
PUSH, TWIST = (0.0, 0.0, 2.0), (1.0, 0.0, 0.0)
FIRST = [
    contact(A, B, (PUSH, -0.002, (0.0, 0.0, 0.0)), (TWIST, 0.001, (3.0, 0.0, 0.0))),
    contact(C, A, (PUSH, -0.001, (1.0, 1.0, 1.0))),
    contact(B, D, (PUSH, -0.9, (0.0, 0.0, 0.0))),
]
SECOND = [contact(B, A, (PUSH, -0.004, (0.0, 6.0, 0.0)), ((0.0, 0.0, 0.0), 0.003, (9.0, 9.0, 9.0)))]
GROUPS = {"a": [A], "b": [B], "c": [C]}


def test_impulses_are_on_the_first_group_by_the_second():
    scene = Scene(FIRST, SECOND)
    monitor = ContactMonitor(scene, GROUPS)
    scene.step()
    found = monitor.read()
    expected = torch.zeros(1, 3, 3, 3)
    expected[0, 0, 1], expected[0, 1, 0] = torch.tensor([1.0, 0.0, 2.0]), torch.tensor([-1.0, 0.0, -2.0])
    expected[0, 2, 0], expected[0, 0, 2] = torch.tensor(PUSH), -torch.tensor(PUSH)
    torch.testing.assert_close(found.impulse, expected)
    nothing = math.inf
    separations = [[nothing, -0.002, -0.001], [-0.002, nothing, nothing], [-0.001, nothing, nothing]]
    torch.testing.assert_close(found.separation[0], torch.tensor(separations))
    assert found.point is None
    scene.step()
    torch.testing.assert_close(monitor.take().impulse[0, 1, 0], torch.tensor(PUSH))


def test_contacts_of_all_steps_are_summed_and_the_deepest_is_kept():
    """Points count by their impulses: 2, 1 and 2 Ns at the origin, at x = 3 and at y = 6."""
    scene = Scene(FIRST, SECOND, [])
    monitor = ContactMonitor(scene, GROUPS, every_step=True)
    monitor.keep_points()
    for _ in range(2):
        scene.step()
    found = monitor.take()
    torch.testing.assert_close(found.impulse[0, 0, 1], torch.tensor([1.0, 0.0, 0.0]))
    assert found.separation[0, 0, 1] == found.separation[0, 1, 0] == pytest.approx(-0.004)
    assert found.point is not None
    middle = torch.tensor([0.6, 2.4, 0.0])
    torch.testing.assert_close(found.point[0, 0, 1], middle)
    torch.testing.assert_close(found.point[0, 1, 0], middle)
    assert found.point[0, 1, 2].tolist() == [0.0] * 3
    scene.step()
    again = monitor.take()
    assert not again.impulse.any()
    assert again.separation.isinf().all()


def test_only_pairs_that_are_asked_for_are_read_and_unknown_groups_refused():
    scene = Scene(FIRST)
    monitor = ContactMonitor(scene, GROUPS, pairs=[("b", "a")])
    scene.step()
    found = monitor.read().impulse[0]
    assert found[0, 1].any()
    assert not found[0, 2].any()
    with pytest.raises(InputError, match="unknown group d"):
        ContactMonitor(scene, GROUPS, pairs=[("a", "d")])
    with pytest.raises(InputError, match="b is in group b and in another one"):
        ContactMonitor(scene, {"a": [A, B], "b": [B]})
    pair = SimpleNamespace(name="pair", _bodies=[A._bodies[0], D._bodies[0]])
    with pytest.raises(InputError, match="pair is in group b and in another one"):
        ContactMonitor(scene, {"a": [A], "b": [pair]})


class OnGpu(Scene):
    """A scene of two environments that tells sums of impulses alone."""

    gpu_sim_enabled, num_envs = True, 2

    def get_pairwise_contact_impulses(self, one: Any, other: Any) -> torch.Tensor:
        return torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]) * (3.0 if other is D else 1.0)


def test_on_a_gpu_impulses_are_known_and_separations_and_points_are_not():
    monitor = ContactMonitor(OnGpu(), GROUPS | {"d": [D]}, pairs=[("d", "b"), ("b", "c")])
    found = monitor.take()
    expected = torch.zeros(2, 4, 4, 3)
    for first, second, share in ((1, 2, 1.0), (1, 3, 3.0)):
        expected[:, first, second] = share * torch.tensor([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
        expected[:, second, first] = -expected[:, first, second]
    torch.testing.assert_close(found.impulse, expected)
    assert found.separation.isnan().all()
    position, group = monitor.points(2)
    assert (position.shape, group.tolist()) == ((2, 2, 3), [[-1, -1]] * 2)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_points_of_a_located_pair_that_carry_an_impulse_come_first(count: int):
    scene = Scene([*FIRST, *SECOND])
    monitor = ContactMonitor(scene, GROUPS, located=[("b", "a")])
    scene.step()
    position, group = monitor.points(count)
    places = [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, 6.0, 0.0)][: min(count, 3)]
    assert [tuple(p) for p in position[0, : len(places)].tolist()] == places
    assert group[0].tolist() == [1] * len(places) + [-1] * (count - len(places))
    assert position.shape == (1, count, 3)


def test_the_largest_overlap_of_watched_bodies_is_taken_once():
    scene = Scene(FIRST, SECOND, [], [contact(C, D, (PUSH, -0.5, (0.0, 0.0, 0.0)))])
    monitor = OverlapMonitor(scene, [A])
    assert monitor.known
    assert monitor.max_penetration_pair(0) is None
    for _ in range(3):
        scene.step()
    assert monitor.take().tolist() == pytest.approx([0.004])
    assert monitor.max_penetration_pair(0) == ("b", "a")
    scene.step()
    assert monitor.take().tolist() == [0.0]
    assert OverlapMonitor(SimpleNamespace(gpu_sim_enabled=True, num_envs=2, device="cpu"), []).take().isnan().all()


# ------------------------------------------------------------------------ hinges and bodies


@pytest.mark.parametrize(("speed", "angle", "latch"), [(0.02, 0.1, 0), (0.02, 0.04, 1.5), (-0.5, 0.06, 0), (0, 0, 1.5)])
def test_a_hinge_resists_its_motion_and_is_latched_near_its_end(speed: float, angle: float, latch: float):
    told: list[float] = []
    door = HingedObject.__new__(HingedObject)
    door._latch_angle = 0.05
    door.resistance = {name: np.array([7.0, x], np.float32) for name, x in (("friction", 0.4), ("latch", 1.5))}
    one: Any = SimpleNamespace(qvel=np.array([speed]), qpos=np.array([angle]), set_qf=lambda f: told.extend(f.tolist()))
    door._bodies = [one, one]
    door._resist(1)
    assert told == pytest.approx([-0.4 * math.tanh(speed / FRICTION_SPEED) - latch])


@pytest.mark.parametrize("axis", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0, -1), (0.6, 0.0, 0.8), (-0.6, -0.8, 0.0)])
def test_joints_turn_about_the_axis_of_their_hinge(axis: tuple[float, ...]):
    q = _turning_x_to(np.array(axis, float))
    np.testing.assert_allclose(Rotation.from_quat(q, scalar_first=True).apply([1.0, 0.0, 0.0]), axis, atol=1e-12)
    assert np.linalg.norm(q) == pytest.approx(1)


def test_a_body_has_the_numbers_of_its_object_unless_others_are_given():
    cube = load_object("cube")
    made: Any = object_entity(cube).components[0]
    assert made.mass == pytest.approx(cube.mass)
    for shape in made.collision_shapes:
        assert shape.contact_offset == pytest.approx(CONTACT_OFFSET)
        material = shape.physical_material
        assert (material.static_friction, material.dynamic_friction) == pytest.approx((cube.friction, cube.friction))
        assert material.restitution == 0
    wrongs: list[dict[str, Any]] = [{"mass": 0.0}, {"scale": 0.0}, {"friction": -0.1}]
    for wrong in wrongs:
        with pytest.raises(InputError, match=f"{next(iter(wrong))} is .*must be positive"):
            object_entity(cube, **wrong)
    drawn = drawn_box((1.0, 2.0, 3.0), (0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 1.0))
    assert drawn.shape == Shape("box", (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), (0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("folder", "name"), [("diana7_hit", "Diana7Hit"), ("a-b c", "ABC"), ("7axis", "Robot7axis"), ("x__y", "XY")]
)
def test_a_robot_has_a_class_that_is_named_after_its_folder(folder: str, name: str):
    assert class_name(folder) == name


# ------------------------------------------------------------------------ cameras and keywords


TAKEN: list[dict[str, Any]] = [
    {"width": 1, "height": MOST_PIXELS}, {"width": np.int64(64)}, {"fov": None}, {"fov": 3.14}, {"fov": np.float32(1)},
    {"near": 1e-3, "far": 1e6}, {"hand_camera": {"near": 0.5, "far": 0.6}}, {"shader_pack": "default"}, {"mount": None},
]  # fmt: skip


@pytest.mark.parametrize("settings", TAKEN, ids=str)
def test_settings_of_cameras_at_their_limits_are_taken(settings: dict[str, Any]):
    check_settings(settings)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"width": MOST_PIXELS + 1}, "width"), ({"height": 0}, "height"), ({"width": 64.0}, "width"),
        ({"width": True}, "width"), ({"fov": 0}, "fov"), ({"fov": math.pi}, "fov"), ({"fov": math.nan}, "fov"),
        ({"near": 0}, "near"), ({"far": 1.1e6}, "far"), ({"far": math.inf}, "far"),
        ({"near": 1.0, "far": 1.0}, "near is 1.0 m"),
        ({"near": True}, "near"), ({"near": None}, "near"),
        ({"hand_camera": {"near": 2.0, "far": 1.0}}, "near is 2.0 m"),
    ],
    ids=str,
)  # fmt: skip
def test_settings_of_cameras_beyond_their_limits_are_refused(settings: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words):
        check_settings(settings)


def test_settings_belong_to_a_camera_or_to_all():
    check_names({"hand_camera": {"width": 3, "use_stereo_depth": True}, "height": 4}, {"hand_camera": None})
    for wrong, words in (({"hand_camera": {"colour": 3}}, "no 'colour'"), ({"camera": {}}, "no camera 'camera'")):
        with pytest.raises(InputError, match=words):
            check_names(wrong, {"hand_camera": None})


def test_a_camera_of_a_task_has_its_numbers():
    textures = SimpleNamespace(**dict.fromkeys(("rgb", "depth", "segmentation", "position", "normal", "albedo"), False))
    made: Any = CameraSpec((1.0, 0.0, 0.0), (0.0, 0.0, 0.0), width=32, height=16, fov=0.5, near=0.1, far=5.0).config(
        "eye", textures
    )
    assert (made.uid, made.width, made.height, made.fov, made.near, made.far) == ("eye", 32, 16, 0.5, 0.1, 5.0)
    assert (made.mount, made.shader_pack) == (None, "minimal")


def sensors(mode: str, *textures: str, drawn: tuple[str, ...] = ("rgb", "depth")) -> Any:
    """An environment with one camera, whose mode observes some textures and whose shader draws some."""
    known = ("rgb", "depth", "segmentation", "position", "normal", "albedo")
    visual = SimpleNamespace(**{name: name in textures for name in known})
    shader = SimpleNamespace(texture_names={"Colour": list(drawn)}, shader_pack="minimal")
    camera = SimpleNamespace(config=SimpleNamespace(shader_config=shader))
    return SimpleNamespace(obs_mode=mode, obs_mode_struct=SimpleNamespace(visual=visual), _sensors={"eye": camera})


def test_cameras_draw_all_that_is_observed():
    check_cameras(sensors("rgb+depth", "rgb", "depth"))
    check_cameras(sensors("state", "albedo"))
    with pytest.raises(InputError, match="'minimal' of the camera 'eye' draws no albedo"):
        check_cameras(sensors("albedo", "rgb", "albedo"))


def test_what_is_shown_is_what_is_observed_or_all_with_a_state():
    check_shown(sensors("rgb", "rgb"))
    check_shown(sensors("state"))
    check_shown(sensors("state_dict"))
    with pytest.raises(InputError, match="'albedo' has none of"):
        check_shown(sensors("albedo", "albedo"))


@pytest.mark.parametrize(
    ("name", "expected"), [("physx_cuda", True), ("cuda:1", True), ("gpu", True), ("physx_cpu", False), ("x", False)]
)
def test_back_ends_on_a_gpu_are_known_by_name(name: str, expected: bool):
    assert on_gpu(name) is expected


def test_a_keyword_that_is_misspelt_gets_the_nearest_one():
    check_keywords(DoraEnv, {"num_envs": 2}, ["num_envs"])
    with pytest.raises(InputError, match="DoraEnv takes no argument 'guidence': did you mean 'guidance'"):
        check_keywords(DoraEnv, {"guidence": "none"}, ["num_envs"])
    with pytest.raises(InputError, match="did you mean 'max_episode_steps'"):
        check_keywords(DoraEnv, {"max_episode_step": 3}, ["num_envs"])
