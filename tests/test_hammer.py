"""DoraHammer-v1: ballistics and striking geometry on invented states, the nail, and what the scripted solution does."""

from collections.abc import Iterator
from contextlib import contextmanager
from math import pi
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from invented import extension
from mani_skill.utils.structs import Pose
from torch import Tensor

import dora.tasks as tasks
from dora.geometry.poses import compose
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)
from dora.sim.substeps import watch_physics
from dora.tasks.hammer import mdp
from dora.tasks.hammer.ballistics import Strike, after_fall, arrival, fall_time, slid
from dora.tasks.hammer.nail import slowed
from dora.tasks.hammer.reference import ALIGN, CatchReference
from dora.tasks.hammer.snapshot import HAND_CENTRE, HammerSnapshot, face_to_nail, handle_distance, misalignment
from dora.tasks.hammer.task import UNKNOWN, HammerConfig, HammerTask

FACE = (0.04, 0.0, 0.04)
CONFIG = HammerConfig()
"""The task's own numbers."""
STAGES, TERMS = mdp.stages(CONFIG), mdp.terms(CONFIG).terms
FLAT = quaternion_multiply(
    quaternion_from_rotation_vector(torch.tensor([0.0, pi / 2, 0.0])), torch.tensor([1.0, 0.0, 0.0, 0.0])
)
"""Handle along +x, face down."""


def invented(n: int, **given: Tensor) -> HammerSnapshot:
    """A snapshot of zeros and unit quaternions, with what is given."""
    hammer = {
        "face": torch.tensor(FACE).repeat(n, 1),
        "butt": torch.tensor([0.0, 0.0, -0.22]).repeat(n, 1),
        "neck": torch.tensor([0.0, 0.0, 0.04]).repeat(n, 1),
        "nail_p": torch.zeros(n, 3),
    }
    still = dict.fromkeys(("nail_depth", "nail_driven", "drift_p", "drift_r"), torch.zeros(n))
    return extension(HammerSnapshot, n, **(hammer | still | given))


def random_pose(n: int) -> tuple[Tensor, Tensor]:
    return torch.randn(n, 3), quaternion_from_rotation_vector(torch.randn(n, 3))


# ---------------------------------------------------------------------- geometry


def test_a_fall_takes_as_long_as_it_takes():
    time = fall_time(torch.tensor([0.0, 1.0, 0.2, -1.0]), torch.tensor([0.0, 0.0, 1.0, 0.0]))
    torch.testing.assert_close(time[1], torch.tensor((2 / 9.81) ** 0.5))
    assert time[0] == 0
    t = time[2]
    assert abs(0.2 + t - 9.81 * t**2 / 2) < 1e-5
    assert time[3] == 0


def test_the_predicted_point_is_at_the_height_at_the_time_of_arrival():
    torch.manual_seed(0)
    n = 64
    body = torch.rand(n, 3) + torch.tensor([0.0, 0.0, 1.0]), quaternion_from_rotation_vector(0.2 * torch.randn(n, 3))
    velocity, spin = 0.5 * torch.randn(n, 3), 0.5 * torch.randn(n, 3)
    point, height = 0.1 * torch.randn(n, 3), torch.full((n,), 0.3)
    time = arrival(body, velocity, spin, point, height)
    position, quaternion = after_fall(body, velocity, spin, time)
    z = (position + quaternion_apply(quaternion, point))[:, 2]
    torch.testing.assert_close(z, height, atol=2e-3, rtol=0)


def test_a_slid_pose_is_at_the_height_and_on_the_axis():
    axis = torch.tensor([[0.3, 0.0, 0.954]])
    goal = torch.tensor([[0.1, 0.2, 0.9]]), torch.tensor([[1.0, 0, 0, 0]])
    moved, _ = slid(goal, axis, torch.tensor([0.6]))
    assert abs(moved[0, 2] - 0.6) < 1e-6
    assert torch.linalg.cross(moved - goal[0], axis).norm() < 1e-6


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_a_blow_meets_the_nail_squarely(yaw: float):
    top, face = torch.tensor([0.6, -0.1, 0.3]), torch.tensor([FACE, FACE])
    strike = Strike(top, face, 0.36, yaw)
    depth = torch.tensor([0.0, 0.01])
    nail_p = top.repeat(2, 1) - torch.stack([0 * depth, 0 * depth, depth], -1)
    p, q = strike.hammer(depth, torch.zeros(2), 0.0)
    s = invented(2, object_p=p, object_q=q, nail_p=nail_p)
    assert face_to_nail(s).abs().max() < 1e-6
    assert misalignment(s).max() < 1e-3
    raised_p, raised_q = strike.hammer(depth, torch.full((2,), 0.5), 0.0)
    up = invented(2, object_p=raised_p, object_q=raised_q, nail_p=nail_p)
    torch.testing.assert_close(misalignment(up), torch.full((2,), 0.5), atol=1e-4, rtol=0)
    assert (face_to_nail(up)[:, 2] < -0.1).all()  # above the nail


def test_distance_from_the_handle():
    points = torch.tensor([[[0.03, 0.0, 0.0], [0.0, 0.0, -0.25], [0.0, 0.04, 0.07]]])
    torch.testing.assert_close(handle_distance(invented(1), points), torch.tensor([[0.03, 0.03, 0.05]]))


# ------------------------------------------------------------------------ stages


def caught(n: int, **given: Tensor) -> HammerSnapshot:
    """Hammers at the middle of the hand, two fingers on them."""
    touch = torch.zeros(n, 6, dtype=torch.bool)
    touch[:, 1:3] = True
    centre = torch.tensor(HAND_CENTRE).repeat(n, 1)
    return invented(n, **({"object_p": centre, "touch": touch} | given))


def test_catching_needs_place_fingers_and_rest():
    done = STAGES[0].done
    assert done(caught(1)).all()
    assert not done(caught(1, touch=torch.zeros(1, 6, dtype=torch.bool))).any()
    assert not done(caught(1, object_v=torch.tensor([[0.0, 0.0, -0.6]]))).any()
    assert not done(caught(1, object_p=torch.tensor([[0.145, 0.0, 0.15]]))).any()
    # what moves along with the hand rests in it
    moving = torch.tensor([[0.0, 1.0, 0.0]])
    assert done(caught(1, object_v=moving, wrist_v=moving)).all()


def test_stillness_counts_over_the_window_only():
    done = STAGES[1].done
    assert done(caught(1)).all()
    assert not done(caught(1, drift_p=torch.tensor([0.009]))).any()
    assert not done(caught(1, drift_r=torch.tensor([0.2]))).any()
    assert not done(caught(1, drift_p=torch.tensor([UNKNOWN]))).any()


def test_orientation_is_judged_between_striking_axis_and_nail_axis():
    done = STAGES[2].done
    n = 4
    tilt = torch.tensor([0.0, 0.2, 0.3, 0.0])
    q = quaternion_multiply(
        quaternion_from_rotation_vector(torch.stack([tilt, 0 * tilt, 0 * tilt], -1)), FLAT.expand(n, 4)
    )
    p = torch.tensor(HAND_CENTRE).repeat(n, 1)
    nail_p = p + quaternion_apply(q, torch.tensor(FACE).repeat(n, 1)) - torch.tensor([0.0, 0.0, 0.05])
    nail_p[3, 0] += 0.02
    s = caught(n, object_p=p, object_q=q, nail_p=nail_p)
    assert done(s).tolist() == [True, True, False, False]


def test_depth_pays_until_the_target_and_only_if_driven():
    depth = torch.tensor([0.0, 0.005, 0.010, 0.020])
    driven = TERMS["strike"].value(invented(4, nail_driven=depth, nail_depth=depth))
    torch.testing.assert_close(driven, torch.tensor([0.0, 0.5, 1.0, 1.0]))
    overlapped = TERMS["strike"].value(invented(4, nail_driven=depth, max_penetration=torch.full((4,), 0.006)))
    torch.testing.assert_close(overlapped, CONFIG.after_overlap * driven)
    pushed = TERMS["strike"].value(invented(4, nail_depth=depth))
    assert (pushed == 0).all()


def test_every_term_stays_in_bounds_on_random_states():
    torch.manual_seed(0)
    n = 256
    s = invented(
        n,
        tip_p=torch.randn(n, 5, 3), object_p=torch.randn(n, 3), wrist_p=torch.randn(n, 3), goal_p=torch.randn(n, 3),
        object_q=random_pose(n)[1], nail_p=torch.randn(n, 3), nail_driven=0.05 * torch.rand(n),
        touch=torch.rand(n, 6) > 0.5, action=3 * torch.randn(n, 26), penetration=torch.rand(n) * 0.05,
        drift_p=torch.rand(n), drift_r=torch.rand(n), stage=torch.randint(0, 5, (n,)),
    )  # fmt: skip
    for terms in (mdp.terms(CONFIG), mdp.paper_terms(CONFIG)):
        for name, term in terms.terms.items():
            value = term.value(s)
            assert ((value >= 0) & (value <= 1)).all(), name


# --------------------------------------------------------------------- reference


def test_the_reference_brings_the_held_hammer_over_the_nail_wherever_it_is_held():
    torch.manual_seed(0)
    n = 8
    top, face = torch.tensor(CONFIG.nail.top), torch.tensor(FACE).repeat(n, 1)
    reference = CatchReference(n, Strike(top, face, CONFIG.swing_radius), CONFIG.nail.driven, 0.025, "cpu")
    held = 0.1 * torch.randn(n, 3), quaternion_from_rotation_vector(0.5 * torch.randn(n, 3))
    reference.begin(torch.arange(n), torch.zeros(n, 3), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1))
    reference.phase.index.fill_(ALIGN)
    wrist = torch.zeros(n, 3), torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    nail_p = top.repeat(n, 1)
    for _ in range(120):
        p, q = compose(wrist, held)
        s = invented(n, wrist_p=wrist[0], wrist_q=wrist[1], object_p=p, object_q=q, nail_p=nail_p)
        reference.advance(s)
        reference.phase.index.fill_(ALIGN)
        target = reference.target(s)
        wrist = target.wrist_p, target.wrist_q
    p, q = compose(wrist, held)
    s = invented(n, object_p=p, object_q=q, nail_p=nail_p)
    assert misalignment(s).max() < 0.02
    assert face_to_nail(s)[:, :2].norm(dim=-1).max() < 0.005
    assert ((face_to_nail(s)[:, 2] < -0.03) & (face_to_nail(s)[:, 2] > -0.07)).all()


# -------------------------------------------------------------------------- nail


@pytest.fixture(scope="module")
def bench() -> Iterator[tasks.DoraEnv]:
    """One environment whose hammer the tests drop on the nail by hand."""
    task = tasks.make_task("DoraHammer-v1", 1, preset="none", sim_backend="physx_cpu", guidance="none")
    assert isinstance(task.task, HammerTask)
    yield task
    task.close()


def over_nail(task: tasks.DoraEnv, gap: float, speed: float) -> sapien.physx.PhysxRigidDynamicComponent:
    """Puts the hammer face down over the nail, `gap` [m] above it and moving down."""
    task.reset(seed=0)
    strike = Strike(torch.tensor(CONFIG.nail.top), task.task.points["face"], CONFIG.swing_radius)
    task.target_object.set_pose(Pose.create_from_pq(*strike.hammer(torch.zeros(1), torch.zeros(1), gap)))
    task.target_object.set_linear_velocity(torch.tensor([[0.0, 0.0, -speed]]))
    task.target_object.set_angular_velocity(torch.zeros(1, 3))
    return task.target_object._bodies[0]


def run(task: tasks.DoraEnv, steps: int) -> tuple[float, float]:
    """Depth and driven depth after some control steps with the arm at rest [mm]."""
    for _ in range(steps):
        task.step(task.scripted_action() * 0)
    return 1000 * task.task.nail.depth.item(), 1000 * task.task.nail.driven.item()


def test_a_blow_drives_the_nail_and_a_harder_one_drives_it_further(bench: tasks.DoraEnv):
    soft, hard = [], []
    for speed, result in ((1.0, soft), (1.6, hard)):
        over_nail(bench, 0.01, speed)
        result += run(bench, 4)
    print(f"1.0 m/s: {soft[1]:.2f} mm, 1.6 m/s: {hard[1]:.2f} mm")
    assert 0.5 < soft[1] < hard[1] < 8
    assert hard[1] > 2
    assert hard[1] == pytest.approx(hard[0], abs=0.05)


def test_leaning_and_pushing_do_not_count(bench: tasks.DoraEnv):
    body = over_nail(bench, 0.0005, 0.0)
    push = [0.0]

    def lean(_: int) -> None:
        body.add_force_at_point([0.0, 0.0, -push[0]], body.entity_pose.p)

    watch_physics(bench.scene, lean)
    push[0] = 20.0
    depth, driven = run(bench, 4)
    assert depth < 0.5
    assert driven == 0.0
    push[0] = 80.0
    over_nail(bench, 0.0005, 0.0)
    body = bench.target_object._bodies[0]
    watch_physics(bench.scene, lean)
    depth, driven = run(bench, 6)
    assert depth > 5  # it yields to a strong push
    assert driven == 0.0
    bench.reset(seed=0)


@pytest.mark.parametrize("push", [0.0, 30.0, 40.0, 60.0])
def test_pushing_on_after_a_touch_ends_the_blow(bench: tasks.DoraEnv, push: float):
    """A touch just above the speed of a blow, then a push that alone sinks the whole nail."""
    over_nail(bench, 0.006, 0.55)
    body, touched = bench.target_object._bodies[0], [False]

    def go_on(_: int) -> None:
        touched[0] |= bench.task.nail.depth.item() > 0
        if touched[0]:
            body.add_force_at_point([0.0, 0.0, -push], body.entity_pose.p)

    watch_physics(bench.scene, go_on)
    depth, driven = run(bench, 8)
    bench.reset(seed=0)
    print(f"{push:g} N: {depth:.1f} mm, driven {driven:.1f} mm")
    assert depth > 12 or push < 40
    assert 0.3 < driven < 6  # of the 10 mm that it takes


def test_blows_of_a_free_hammer_count_whole(bench: tasks.DoraEnv):
    for speed in (0.7, 1.0, 1.6, 2.2):
        over_nail(bench, 0.01, speed)
        depth, driven = run(bench, 4)
        assert driven == pytest.approx(depth, abs=0.05)
        assert driven > 0.5


def test_a_nail_that_nothing_pushes_is_slowed_as_its_equation_says():
    numbers, mass, whole = CONFIG.nail, 1.8, 0.01
    fine = speed = 1.2
    for _ in range(1000):
        fine -= whole / 1000 * (numbers.resistance + numbers.drag * fine) / (mass + numbers.mass)
    assert slowed(numbers, speed, mass, whole) == pytest.approx(fine, abs=0.05)
    assert slowed(numbers, 0.01, mass, whole) == 0.0


def test_a_fast_blow_counts(bench: tasks.DoraEnv):
    """A face at 3 m/s is more than a centimetre below the nail's head after the step in which it meets it."""
    over_nail(bench, 0.03, 3.0)
    depth, driven = run(bench, 4)
    assert driven == pytest.approx(depth, abs=0.05)
    assert driven > 5


def test_slow_impacts_and_no_contact_leave_it_alone(bench: tasks.DoraEnv):
    over_nail(bench, 0.004, 0.8 * CONFIG.nail.blow_speed)
    _, driven = run(bench, 2)
    assert driven == 0.0
    bench.reset(seed=1)
    assert run(bench, 8) == (0.0, 0.0)


@contextmanager
def pressed(task: tasks.DoraEnv, force: float) -> Iterator[None]:
    """The nail is pressed down by a force from elsewhere [N], whatever the hammer does."""
    settings, nail = CONFIG.nail, task.task.nail
    nail._bodies[0].set_qf(np.array([force - settings.resistance], np.float32))
    yield
    nail._bodies[0].set_qf(np.array([-settings.resistance], np.float32))


def beside_nail(task: tasks.DoraEnv, shift: tuple[float, float, float], turn: float) -> None:
    """The hammer comes down at 1.6 m/s, its face `shift` [m] away from the nail, turned about world y [rad]."""
    body = over_nail(task, 0.01, 1.6)
    p, q = torch.tensor(body.entity_pose.p), torch.tensor(body.entity_pose.q)
    tilt = quaternion_from_rotation_vector(torch.tensor([[0.0, turn, 0.0]]))
    p = p + torch.tensor(shift)
    task.target_object.set_pose(Pose.create_from_pq(p[None], quaternion_multiply(tilt, q[None])))
    task.target_object.set_linear_velocity(torch.tensor([[0.0, 0.0, -1.6]]))


def test_a_force_from_elsewhere_while_the_hammer_falls_beside_the_nail_is_no_blow(bench: tasks.DoraEnv):
    beside_nail(bench, (0.0, 0.06, 0.02), 0.0)
    with pressed(bench, 30.0):
        depth, driven = run(bench, 6)
    assert depth > 5
    assert driven == 0.0


def test_a_blow_with_the_handle_is_no_blow(bench: tasks.DoraEnv):
    """The hammer lies across the nail and falls flat on it, the middle of its handle first."""
    over_nail(bench, 0.01, 0.0)
    top = torch.tensor(CONFIG.nail.top)
    flat = quaternion_from_rotation_vector(torch.tensor([[0.0, pi / 2, 0.0]]))  # the handle along x
    middle = quaternion_apply(flat, (bench.task.points["butt"] + bench.task.points["neck"]) / 2)
    place = top + torch.tensor([0.0, 0.0, 0.03])
    bench.target_object.set_pose(Pose.create_from_pq(place[None] - middle, flat))
    bench.target_object.set_linear_velocity(torch.tensor([[0.0, 0.0, -1.6]]))
    depth, driven = run(bench, 6)
    assert depth > 0.5
    assert driven == 0.0


def test_a_blow_with_something_else_is_no_blow(bench: tasks.DoraEnv):
    """A block of 0.6 kg, as heavy as a palm, hits the nail while the hammer falls beside it."""
    beside_nail(bench, (0.0, 0.10, 0.0), 0.0)
    builder = bench.scene.sub_scenes[0].create_actor_builder()
    builder.add_box_collision(half_size=(0.03, 0.03, 0.03), density=0.6 / 0.06**3)
    builder.initial_pose = sapien.Pose([*CONFIG.nail.top[:2], CONFIG.nail.top[2] + 0.04])
    block = builder.build("block")
    body: Any = block.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
    body.set_linear_velocity([0.0, 0.0, -1.6])
    depth, driven = run(bench, 6)
    block.remove_from_scene()
    assert depth > 2
    assert driven == 0.0


def test_what_sinks_after_a_blow_counts_only_while_nothing_else_presses(bench: tasks.DoraEnv):
    driven = []
    for touched in (False, True):
        over_nail(bench, 0.01, 1.6)
        nail, pressed_by = bench.task.nail, bench.task.nail._pressed
        nail._pressed = (lambda i, c, by=pressed_by: (by(i, c)[0], True)) if touched else pressed_by
        driven.append(run(bench, 4)[1])
        del nail._pressed
    assert driven[0] > 2
    assert driven[1] == 0.0


def test_the_nail_never_comes_back_up_and_a_restored_one_stays_where_it_was(bench: tasks.DoraEnv):
    over_nail(bench, 0.01, 1.6)
    depth, driven = run(bench, 4)
    joint = bench.task.nail.articulation.get_qpos().item() * 1000
    assert joint == pytest.approx(depth, abs=0.05)
    state = bench.get_state_dict()
    bench.reset(seed=3)
    assert bench.task.nail.depth.item() == 0.0
    bench.set_state_dict(state)
    assert run(bench, 2)[1] == pytest.approx(driven, abs=1e-3)
    assert bench.task.nail.articulation.get_qpos().item() * 1000 == pytest.approx(depth, abs=0.05)
    assert depth < 1000 * CONFIG.nail.travel


# ---------------------------------------------------------------------- solution


@pytest.mark.slow
def test_the_script_catches_strikes_and_stays_clean():
    starts = 50
    task = tasks.make_task("DoraHammer-v1", starts, preset="none")
    task.reset(seed=0)
    zero = torch.zeros(starts, task.action_size)
    for _ in range(task.max_steps):
        info = task.step(zero)[-1]
    rates = {k: v.float().mean().item() for k, v in info.items() if k.startswith("stage/")}
    print(rates, f"success {info['success'].float().mean():.2f}, deepest {info['penetration_max_mm'].max():.1f} mm")
    assert info["success"].float().mean() >= 0.8
    task.close()
