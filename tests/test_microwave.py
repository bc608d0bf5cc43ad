"""DoraMicrowave-v1: geometry and references on invented states, and what the scripted solution does."""

from dataclasses import replace
from math import pi, radians
from typing import Any

import numpy as np
import pytest
import torch
from invented_microwave import YAW, in_world, invented, out, turned
from placements import grasps
from torch import Tensor

import dora.tasks as tasks
from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import hand_digest
from dora.affordance.objects.catalogue import load_object
from dora.geometry.poses import compose
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_from_yaw,
    quaternion_multiply,
    rotation_angle,
)
from dora.robot import load_robot
from dora.tasks.env.arm import Arm
from dora.tasks.env.options import task_config
from dora.tasks.env.starts import STANDING_DRAWS
from dora.tasks.microwave import mdp
from dora.tasks.microwave import task as microwave
from dora.tasks.microwave.mdp import MicrowaveConfig
from dora.tasks.microwave.reach import STEP, placing_way
from dora.tasks.microwave.reference import OpenSettings, PlaceSettings, entry_turn, opening, placing, with_door
from dora.tasks.microwave.snapshot import CAVITY, LEFT, RIGHT, MicrowaveSnapshot, cube_in_oven, hands_out, inside
from dora.tasks.microwave.task import MicrowaveTask, mirrored, oven_mount

CONFIG = MicrowaveConfig()
"""The task's own numbers."""
STARTS = 100
"""Episodes of the scripted solution [1]."""


# ---------------------------------------------------------------------- geometry


def test_the_way_into_the_cavity_is_followed_in_small_steps():
    candidates = grasps(load_robot("diana7_hit"), load_object("cube"), 1)
    turn = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    way = placing_way(0.2, 0.1, 0.15)(candidates, torch.zeros(1, 3), turn)
    places = torch.stack([p[0, 0] for p, _ in way])
    steps = places.diff(dim=0)
    assert float(steps.norm(dim=-1).max()) <= STEP + 1e-6
    torch.testing.assert_close(steps.sum(0), torch.tensor([0.3, 0.0, 0.0]))


def test_points_are_seen_from_the_microwave_wherever_it_stands():
    s = invented(cube={"p": in_world(0.1, -0.02, 0.05)})
    torch.testing.assert_close(cube_in_oven(s), torch.tensor([[0.1, -0.02, 0.05]] * 2), atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ((0.12, 0.0, 0.05), True), ((0.03, 0.0, 0.05), False), ((-0.1, 0.0, 0.05), False), ((0.12, 0.25, 0.05), False),
        ((0.12, 0.0, 0.32), False), ((0.12, 0.0, -0.05), False), ((0.40, 0.0, 0.05), False),
    ],
)  # fmt: skip
def test_a_cube_is_inside_when_all_of_it_is(place: tuple[float, ...], expected: bool):
    assert inside(invented(cube={"p": in_world(*place)}).of(RIGHT)).tolist() == [expected] * 2


@pytest.mark.parametrize("part", ["wrist_p", "tip_p"])
def test_a_hand_is_out_when_wrist_and_fingertips_are(part: str):
    assert hands_out(invented(right=out())).all()
    late = out() | {part: (in_world(0.05, 0.0, 0.1) if part == "wrist_p" else out()["tip_p"] + 0.2)}
    assert not hands_out(invented(right=late)).any()


@pytest.mark.parametrize("angle", [0.0, 0.4, 1.4])
def test_the_door_is_observed_from_the_pose_of_the_handle(angle: float):
    """The handle of a door that has opened by an angle is turned by it against the vertical."""
    shut = quaternion_multiply(turned(YAW), torch.tensor(oven_mount().object_link.quaternion).expand(2, 4))
    s = invented(handle={"q": quaternion_multiply(turned(-angle), shut)}, cube={"p": in_world(0.1, 0.0, 0.0)})
    seen = s.reobserved(lambda pose: pose)
    torch.testing.assert_close(seen.door, torch.full((2,), angle), atol=1e-5, rtol=0)
    torch.testing.assert_close(seen.cube_p, s.objects["cube"].p)


def test_the_microwave_is_observed_where_it_was_located():
    """A microwave that seems to be turned by .1 rad has a door that seems to be opened by .1 rad more."""
    shut = quaternion_multiply(turned(YAW), torch.tensor(oven_mount().object_link.quaternion).expand(2, 4))
    s = invented(handle={"q": shut})
    seen = s.reobserved(lambda pose: (pose[0] + 0.01, quaternion_multiply(turned(0.1), pose[1])))
    torch.testing.assert_close(seen.oven_p, s.oven_p + 0.01)
    torch.testing.assert_close(seen.door, torch.full((2,), 0.1), atol=1e-5, rtol=0)


def test_the_cavity_is_what_the_walls_leave_free():
    """From behind the front plane, so that no corner of a turned cube stands out, to the back wall."""
    walls = {str(k): (np.array(w.position), np.array(w.size)) for k, w in enumerate(oven_mount().links[0].shapes)}
    (x0, x1), across, height = CAVITY
    middle = np.array([(x0 + x1) / 2, 0.0, sum(height) / 2])
    for axis, (low, high) in ((1, across), (2, height), (0, (None, x1))):
        faces = [(p[axis] - h[axis], p[axis] + h[axis]) for p, h in walls.values()]
        below = [upper for _, upper in faces if upper <= middle[axis]]
        above = [lower for lower, _ in faces if lower >= middle[axis]]
        assert min(above) == pytest.approx(high)
        assert low is None or max(below) == pytest.approx(low)
    half = float(load_object("cube").mesh.extents[0]) / 2
    assert x0 + half >= half * 2**0.5


def error_of_place(task: Any) -> Tensor:
    """Observed less true position of the microwave (n, 3) [m]."""
    return task.observed.oven_p - task.snapshot.oven_p


def test_where_the_microwave_is_believed_to_be_stays_for_the_episode():
    r = MicrowaveConfig.PRESETS["standard"]
    task = tasks.make_task("DoraMicrowave-v1", 4)
    task.reset(seed=0)
    errors = []
    for _ in range(3):
        errors.append(error_of_place(task))
        task.step(torch.zeros(4, task.action_size))
    assert torch.equal(errors[0], errors[1])
    assert torch.equal(errors[0], errors[2])
    assert 0 < errors[0].abs().max() <= r.observed_position
    assert not torch.equal(errors[0][0], errors[0][1])
    task.reset(seed=1)
    assert not torch.equal(errors[0], error_of_place(task))
    task.close()


def test_what_is_led_with_the_door_keeps_its_place_on_it():
    """Turned by the rest of the way about the hinge, the wrist is as far from the hinge, and as much turned."""
    hinge = torch.tensor(oven_mount().hinge_link.position)
    goal = {"p": in_world(-0.1, -0.16, 0.15), "q": turned(0.3)}
    s = invented(goals={LEFT: goal}).of(LEFT)
    p, q = with_door(s, hinge, torch.tensor([0.0, 0.5]))
    torch.testing.assert_close(p[0], goal["p"][0])
    at = in_world(*hinge.tolist())[0]
    torch.testing.assert_close((p[1] - at).norm(), (goal["p"][1] - at).norm())
    assert float(rotation_angle(q, goal["q"])[1]) == pytest.approx(0.5, abs=1e-5)
    assert p[1, 0] < p[0, 0]  # towards the robots


def test_the_cube_is_carried_in_with_the_fingers_ahead():
    from dora.tasks.guidance.waypoints import Kept

    q = quaternion_from_rotation_vector(torch.randn(2, 3, generator=torch.Generator().manual_seed(3)))
    zero = torch.zeros(2, 3), turned(0.0)
    turn = entry_turn(invented().of(RIGHT), Kept((torch.zeros(2, 3), q), zero, zero))
    fingers = quaternion_apply(quaternion_multiply(turn, q), torch.tensor([[0.0, 0.0, 1.0]] * 2))
    torch.testing.assert_close(torch.atan2(fingers[:, 1], fingers[:, 0]), torch.full((2,), YAW), atol=1e-5, rtol=0)
    before = quaternion_apply(q, torch.tensor([[0.0, 0.0, 1.0]] * 2))
    torch.testing.assert_close(fingers[:, 2], before[:, 2])  # about the vertical alone


def test_mirrored_candidates_are_mirror_images():
    """A point of the mirrored hand is the mirror image of the same point of the hand."""
    found = tasks.find_task("DoraMicrowave-v1")(CONFIG).candidates(RIGHT).select(slice(4))
    left, right = load_robot("diana7_hit_left"), load_robot("diana7_hit")
    image = mirrored(found, left)
    flip = torch.tensor([1.0, -1.0, 1.0])
    point = torch.tensor([0.05, 0.02, 0.11]).repeat(4, 1)
    there, _ = compose((image.position, image.quaternion), (point * flip, image.quaternion))
    here, _ = compose((found.position, found.quaternion), (point, found.quaternion))
    torch.testing.assert_close(there, here * flip, atol=1e-6, rtol=0)
    assert torch.equal(mirrored(image, right).position, found.position)
    assert (image.robot, image.robot_digest) == ("diana7_hit_left", hand_digest(left))


# -------------------------------------------------------------------- simulation


@pytest.fixture(scope="module")
def task():
    made = tasks.make_task("DoraMicrowave-v1", 4, preset="standard")
    yield made
    made.close()


def run(task: Any, steps: int) -> MicrowaveSnapshot:
    """The state after some control steps of the scripted solution."""
    for _ in range(steps):
        task.step(task.scripted_action())
    return task.snapshot


def test_microwaves_differ_and_start_shut(task: Any):
    task.reset(seed=1)
    s = task.snapshot
    assert s.oven_p[:, :2].std(0).min() > 0.005
    assert (s.oven_p[:, :2] - torch.tensor(CONFIG.oven[:2])).abs().max() <= 0.04
    assert s.door.abs().max() < 1e-3
    assert len({round(float(x), 5) for x in task.task.oven.get_state()["damping"]}) == 4


@pytest.mark.parametrize("shares", [(0.5,) * 6, (1.0, 0.0, 0.75, 0.0, 1.0, 0.25), (0.25, 0.75, 0.0, 1.0, 0.5, 0.0)])
def test_shares_that_are_drawn_say_where_a_microwave_stands_and_how_it_resists(task: Any, shares: tuple[float, ...]):
    """x, y, yaw, damping, friction, latch: half is the nominal number, 0 and 1 are the ends of its range."""
    task.reset(seed=1)
    begun: dict[str, Tensor] = {}
    names = ("rows", "p", "q", "damping", "friction", "latch")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(task.task.oven, "begin", lambda *values: begun.update(zip(names, values, strict=True)))
        u = torch.tensor([[0.5] * STANDING_DRAWS + list(shares)])
        task.task.place(task.task_scene, torch.tensor([2]), u)
    x, y, yaw, *ways = (2 * share - 1 for share in shares)
    hinge = oven_mount().hinge
    expected = torch.tensor([[0.70 + 0.04 * x, 0.04 * y, 0.10]])
    torch.testing.assert_close(begun["p"], expected)
    torch.testing.assert_close(begun["q"], quaternion_from_yaw(torch.tensor([radians(10) * yaw])))
    nominal = (hinge.damping, hinge.friction, hinge.latch)
    for name, number, way in zip(names[3:], nominal, ways, strict=True):
        assert begun[name].tolist() == pytest.approx([number * (1 + 0.5 * way)])
    task.reset(seed=1)


def test_no_set_of_candidates_takes_the_reach_of_one_that_is_gone(monkeypatch: pytest.MonkeyPatch):
    """Ids of what has been freed are given again."""

    class Reach:
        def __init__(self, arm: Any, candidates: Any, *_: Any):
            self.found = candidates.position[None, :, 0] > 0.5

        def mask(self, p: Tensor, q: Tensor) -> Tensor:
            return self.found

    monkeypatch.setattr(microwave, "oven_reach", Reach)
    task: Any = MicrowaveTask(MicrowaveConfig())
    task._reach = {}
    arm, some = Arm.__new__(Arm), load_candidates("microwave").select(slice(2))
    arm.name = LEFT
    for k in range(100):
        own = replace(some, position=some.position * 0 + (k % 3 == 1))
        assert task._followed(arm, torch.zeros(1, 3), torch.zeros(1, 4), own).tolist() == [[k % 3 == 1] * 2]


def test_arms_have_candidates_of_their_own():
    made = tasks.find_task("DoraMicrowave-v1")(CONFIG)
    left, right = load_robot("diana7_hit_left"), load_robot("diana7_hit")
    handle, cube = made.candidates(LEFT), made.candidates(RIGHT)
    assert (handle.object, cube.object) == ("microwave", "cube")
    ranked = load_candidates("cube", task="DoraMicrowave-v1").position.tolist()
    assert all(position in ranked for position in cube.position.tolist())
    blind, used = load_candidates("cube", region=False, task="DoraMicrowave-v1"), made.candidates(RIGHT, region=False)
    for name in ("position", "score"):  # the same grasps have other scores in DoraCube-v1
        torch.testing.assert_close(getattr(used, name), getattr(blind, name)[: len(used)], atol=0, rtol=0)
    assert made.adapted(cube, RIGHT, right) is cube
    assert made.adapted(handle, LEFT, right) is handle
    image = made.adapted(handle, LEFT, left)
    flip = torch.tensor([1.0, -1.0, 1.0])
    for mine, other in ((image.approach, handle.approach), (image.contacts, handle.contacts)):
        torch.testing.assert_close(mine, other * flip, atol=0, rtol=0, equal_nan=True)
    assert made.adapted(image, LEFT, left) is image
    assert made.start_grid(LEFT) is None
    grid = made.start_grid(RIGHT)
    assert grid is not None
    assert (grid.centre, grid.spread) == (CONFIG.centre, (CONFIG.spread,) * 2)
    nominal, share = torch.tensor([2.0]), torch.tensor([1.0])
    assert made.masses("microwave", nominal, share) is nominal
    varied = MicrowaveTask(task_config(MicrowaveConfig, "standard", None))
    assert varied.masses("microwave", nominal, share) is nominal
    assert varied.masses("cube", nominal, share) > nominal


def test_the_handle_is_the_object_of_the_left_arm_and_no_part_of_the_world(task: Any):
    task.reset(seed=1)
    assert task.snapshot.handles == {LEFT: "microwave", RIGHT: "cube"}
    assert task.objects["microwave"] is task.task.oven.link
    assert {link.name.rpartition("-")[2] for link in task.task.world(task.task_scene)[1:]} == {"body", "door"}


@pytest.mark.slow
def test_a_restored_state_has_the_same_microwave_and_goes_on_alike(task: Any):
    task.reset(seed=2)
    run(task, 70)
    state = task.get_state_dict()
    stages = {arm: index.tolist() for arm, index in task.machine.by_arm().items()}
    resistance = task.task.oven.get_state()
    after = run(task, 3)
    task.reset(seed=3)
    task.set_state_dict(state)
    assert all(torch.equal(value, task.task.oven.get_state()[name]) for name, value in resistance.items())
    assert {arm: index.tolist() for arm, index in task.machine.by_arm().items()} == stages
    again = run(task, 3)
    torch.testing.assert_close(again.door, after.door, atol=1e-3, rtol=0)
    torch.testing.assert_close(again.wrists, after.wrists, atol=1e-3, rtol=0)
    torch.testing.assert_close(again.cube_p, after.cube_p, atol=1e-3, rtol=0)


@pytest.mark.slow
def test_stages_of_the_arms_go_on_side_by_side(task: Any):
    task.reset(seed=4)
    together = False
    for _ in range(120):
        task.step(task.scripted_action())
        left, right = (index for index in task.machine.by_arm().values())
        together |= bool(((left > 0) & (left < 3) & (right > 0)).any())
    assert together
    assert task.stage_names == tuple(stage.name for arm in (LEFT, RIGHT) for stage in mdp.stages(CONFIG)[arm])


@pytest.mark.slow
def test_the_scripted_solution_succeeds_in_85_of_100_starts_without_randomisation():
    made = tasks.make_task("DoraMicrowave-v1", STARTS, preset="none")
    made.reset(seed=0)
    info: dict[str, Tensor] = {}
    for _ in range(MicrowaveTask.MAX_STEPS):
        *_, info = made.step(made.scripted_action())
    rates = {name: info[name].float().mean().item() for name in ("success", "raw_success")}
    print(rates, f"95 % of overlaps below {info['penetration_max_mm'].quantile(0.95):.1f} mm")
    assert rates["success"] >= 0.85
    assert made.task.oven.angle.max() < pi / 2
    made.close()


def test_where_the_hand_was_is_kept_when_it_begins_to_close():
    """The wrist stays there while the fingers close, and is led from there."""
    for waypoints in (opening(OpenSettings(), torch.zeros(3)), placing(PlaceSettings(), 0.0)):
        assert [w.name for w in waypoints if w.keep] == ["close"]
