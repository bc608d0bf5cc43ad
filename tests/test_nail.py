"""The nail of DoraHammer-v1: what a blow of the striking face drives, and that pushes and other bodies do not."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from math import pi
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs import Pose

import dora.tasks as tasks
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_multiply,
)
from dora.robot.shapes import Shape
from dora.sim.substeps import watch_physics
from dora.tasks.hammer.ballistics import Strike
from dora.tasks.hammer.nail import Nail, drawn_links, driven_by_momentum, struck
from dora.tasks.hammer.snapshot import HAND_CENTRE
from dora.tasks.hammer.task import HammerConfig, HammerTask

CONFIG = HammerConfig()
"""The task's own numbers."""
HEAD_SIDE = 0.011
"""Radius of the hammer's head beside the face [m]."""


@pytest.fixture(scope="module")
def bench() -> Iterator[tasks.DoraEnv]:
    """One environment whose hammer the tests drop on the nail, where it counts as held."""
    task = tasks.make_task("DoraHammer-v1", 1, preset="none", sim_backend="physx_cpu", guidance="none")
    hammer: Any = task.task
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(hammer, "remember", lambda _: hammer.nail.let_strike(torch.tensor([True])))
        yield task
    task.close()


def over_nail(task: tasks.DoraEnv, gap: float, speed: float) -> sapien.physx.PhysxRigidDynamicComponent:
    """Puts the hammer face down over the nail, `gap` [m] above it and moving down, in a new episode."""
    task.reset(seed=0)
    return again_over_nail(task, gap, speed)


def again_over_nail(task: tasks.DoraEnv, gap: float, speed: float) -> sapien.physx.PhysxRigidDynamicComponent:
    """The same in the same episode: `gap` above where the nail's head was at its beginning."""
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


@pytest.mark.parametrize(("push", "least"), [(0.0, 0.3), (30.0, 5.0), (40.0, 12.0), (60.0, 20.0)])
def test_pushing_on_after_a_touch_ends_the_blow(bench: tasks.DoraEnv, push: float, least: float):
    """A touch just above the speed of a blow, then a push [N] that from 40 N alone sinks the whole nail; at least as
    deep as `least` [mm]."""
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
    assert depth > least
    assert 0.3 < driven < 6  # of the 10 mm that it takes


def test_what_a_blow_left_over_is_not_there_for_a_push_after_the_next_one(bench: tasks.DoraEnv):
    """A free hammer sinks the nail less far than one in a hand would: the rest must not count half a second later."""
    over_nail(bench, 0.01, 1.6)
    depth, first = run(bench, 4)
    assert first == pytest.approx(depth, abs=0.05)
    assert bench.task.nail._left.item() > 0.005
    again_over_nail(bench, 0.10, 0.0)
    bench.target_object._bodies[0].disable_gravity = True
    run(bench, 20)
    bench.target_object._bodies[0].disable_gravity = False
    body, before = again_over_nail(bench, 0.006 - depth / 1000, 0.55), depth

    def push(_: int) -> None:
        if 1000 * bench.task.nail.depth.item() > before + 1e-3:
            body.add_force_at_point([0.0, 0.0, -60.0], body.entity_pose.p)

    watch_physics(bench.scene, push)
    depth, driven = run(bench, 8)
    bench.reset(seed=0)
    print(f"first blow {first:.1f} mm; a touch and a push {depth - before:.1f} mm, counted {driven - first:.1f} mm")
    assert depth - before > 20
    assert 0.3 < driven - first < 6


def test_a_second_blow_counts_as_far_as_its_own_momentum():
    """Whatever the first has left, in the time of a blow or after it."""
    nail: Any = Nail.__new__(Nail)
    nail.settings, nail._hammers = CONFIG.nail, [SimpleNamespace(mass=0.5)]
    nail._left, nail._reach, nail._since = (np.zeros(1) for _ in range(3))
    nail._strike(0, 1.5, 0.0)
    reach, nail._left[0] = nail._left[0], 0.001
    nail._since[0] = CONFIG.nail.blow_window
    nail._strike(0, 1.5, 0.0)
    assert nail._left[0] == reach


def test_blows_of_a_free_hammer_count_whole(bench: tasks.DoraEnv):
    for speed in (0.7, 1.0, 1.6, 2.2):
        over_nail(bench, 0.01, speed)
        depth, driven = run(bench, 4)
        assert driven == pytest.approx(depth, abs=0.05)
        assert driven > 0.5


@pytest.mark.parametrize(("touching", "stage", "counts"), [(2, 3, True), (1, 3, False), (2, 2, False)])
def test_a_hammer_that_is_not_held_to_strike_strikes_no_blow(
    bench: tasks.DoraEnv, touching: int, stage: int, counts: bool
):
    """Two fingers have to be on the handle, in the stage of the blows."""
    s = bench.snapshot
    touch = torch.zeros_like(s.hand.touch)
    touch[:, 1 : 1 + touching] = True
    place = {"wrist_p": s.object.p - torch.tensor(HAND_CENTRE), "wrist_q": torch.tensor([[1.0, 0.0, 0.0, 0.0]])}
    hands = {arm: dataclasses.replace(hand, touch=touch, **place) for arm, hand in s.hands.items()}
    seen = dataclasses.replace(s, hands=hands, stage=torch.full_like(s.stage, stage))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.task, "remember", lambda _: HammerTask.remember(bench.task, seen))
        over_nail(bench, 0.01, 1.6)
        depth, driven = run(bench, 4)
    assert depth > 2
    assert driven == pytest.approx(depth if counts else 0.0, abs=0.05)


@pytest.mark.parametrize(("resistance", "drag"), [(20.0, 40.0), (20.0, 0.0), (0.0, 40.0), (20.0, 1e-3), (1e-6, 40.0)])
def test_momentum_drives_a_nail_as_far_as_its_equation_says(resistance: float, drag: float):
    numbers = dataclasses.replace(CONFIG.nail, resistance=resistance, drag=drag)
    mass, speed, depth, dt = 1.4, 1.2, 0.0, 1e-5
    wanted = driven_by_momentum(numbers, speed, mass - numbers.mass)
    while speed > 1e-6 and depth < 10:
        depth += dt * speed
        speed -= dt * (resistance + drag * speed) / mass
    assert wanted == pytest.approx(depth, rel=2e-3)


def test_a_blow_that_goes_on_reaches_as_far_as_its_hardest_moment():
    """Of its reach 3 mm are driven already; a weaker moment adds nothing, a harder one the difference."""
    nail: Any = Nail.__new__(Nail)
    nail.settings, nail._hammers = CONFIG.nail, [SimpleNamespace(mass=0.5)]
    nail._left, nail._reach, nail._since = (np.zeros(1) for _ in range(3))
    mass = 0.5 + CONFIG.nail.hand
    slow, fast = (driven_by_momentum(CONFIG.nail, struck(CONFIG.nail, v, 0.0, mass), mass) for v in (1.0, 1.5))
    assert 0.003 < slow < fast
    nail._strike(0, 1.0, 0.0)
    assert nail._left[0] == nail._reach[0] == slow
    nail._left -= 0.003
    nail._strike(0, 0.5, 0.0)
    assert nail._reach[0] == slow
    assert nail._left[0] == pytest.approx(slow - 0.003)
    nail._strike(0, 1.5, 0.0)
    assert nail._reach[0] == fast
    assert nail._left[0] == pytest.approx(fast - 0.003)


def test_an_impact_keeps_the_momentum_of_nail_and_hammer():
    numbers, mass, face, sinking = CONFIG.nail, 1.8, 1.3, 0.4
    after = struck(numbers, face - sinking, sinking, mass)
    assert after * (mass + numbers.mass) == pytest.approx(mass * face + numbers.mass * sinking)


@pytest.mark.parametrize("gap", [0.02, 0.023, 0.034])
@pytest.mark.parametrize("speed", [3.0, 4.0])
def test_a_fast_blow_counts_wherever_it_is_between_two_steps(bench: tasks.DoraEnv, gap: float, speed: float):
    """The face is up to 17 mm below the nail after the step in which it meets it, or slowed down in the one before."""
    over_nail(bench, gap, speed)
    depth, driven = run(bench, 4)
    assert driven == pytest.approx(depth, abs=0.1)
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


@pytest.mark.parametrize(("behind", "speed"), [(0.007, 1.6), (0.002, 1.3), (0.002, 0.7)])
def test_a_blow_with_the_side_of_the_head_is_no_blow(bench: tasks.DoraEnv, behind: float, speed: float):
    """Upside down, and so near to the edge of the face [m] that the contact is within what belongs to the face."""
    over_nail(bench, 0.01, 0.0)
    upside_down = torch.tensor([[0.0, 1.0, 0.0, 0.0]])  # half a turn about x, the striking axis
    edge = bench.task.points["face"] + torch.tensor([[-behind, 0.0, HEAD_SIDE]])
    place = torch.tensor(CONFIG.nail.top) + torch.tensor([0.0, 0.0, 0.01]) - quaternion_apply(upside_down, edge)
    bench.target_object.set_pose(Pose.create_from_pq(place, upside_down))
    bench.target_object.set_linear_velocity(torch.tensor([[0.0, 0.0, -speed]]))
    depth, driven = run(bench, 5)
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


def test_the_drawn_nail_reaches_from_its_top_to_the_post_and_the_post_to_the_ground():
    def ends(shape: Shape) -> tuple[float, float]:
        """Its lowest and highest point along the nail, below the undriven nail's top [m]."""
        along = shape.size[-1]
        return shape.position[2] - along, shape.position[2] + along

    (post,), nail = drawn_links(CONFIG.nail)
    head, shank = (drawn.shape for drawn in nail)
    assert ends(head) == pytest.approx((-0.004, 0.0))
    assert ends(shank) == pytest.approx((-CONFIG.nail.stand, 0.0))
    assert ends(post.shape) == pytest.approx((-CONFIG.nail.top[2], -CONFIG.nail.stand))
    assert head.size[0] > shank.size[0]
