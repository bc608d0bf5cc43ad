"""DoraHammer-v1: ballistics and striking geometry on invented states, and what the scripted solution does."""

from math import pi

import pytest
import torch
from invented import extension
from torch import Tensor

import dora
import dora.tasks as tasks
from dora.geometry.poses import compose, relative
from dora.geometry.rotations import (
    quaternion_apply,
    quaternion_from_rotation_vector,
    quaternion_multiply,
    rotation_angle,
)
from dora.tasks.hammer import mdp
from dora.tasks.hammer.ballistics import Strike, after_fall, arrival, fall_time, slid
from dora.tasks.hammer.reference import CatchReference, CatchSettings, Timing, phases
from dora.tasks.hammer.snapshot import HAND_CENTRE, HammerSnapshot, face_to_nail, handle_distance, misalignment
from dora.tasks.hammer.task import UNKNOWN, HammerConfig, HammerTask

FACE = (0.04, 0.0, 0.04)
CONFIG = HammerConfig()
"""The task's own numbers."""
STAGES, TERMS = mdp.stages(CONFIG), mdp.terms(CONFIG).terms
PHASES = [phase.name for phase in phases(CatchSettings())]
ALIGN, SWING, REST = (PHASES.index(name) for name in ("align", "swing", "rest"))
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
    still = dict.fromkeys(("nail_depth", "nail_driven", "drift_p", "drift_r", "turned", "way"), torch.zeros(n))
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


def test_the_residual_has_its_bounds_until_the_hammer_is_held_and_a_share_of_them_from_then_on():
    strike = Strike(torch.tensor(CONFIG.nail.top), torch.zeros(REST + 1, 3), CONFIG.swing_radius)
    settings = CatchSettings(held_freedom=0.25)
    reference = CatchReference(REST + 1, strike, CONFIG.nail.driven, 0.025, "cpu", settings)
    reference.phase.index.copy_(torch.arange(REST + 1))
    assert reference.freedom().tolist() == [1.0] * ALIGN + [0.25] * (REST + 1 - ALIGN)


@pytest.mark.parametrize(
    ("phase", "share"), [("wait", 1.0), ("close", 1.0), ("settle", 0.3), ("align", 0.3), ("raise", 0.3), ("swing", 0.0)]
)
def test_the_pose_in_the_hand_is_followed_at_once_then_smoothly_and_not_in_a_blow(phase: str, share: float):
    strike = Strike(torch.tensor(CONFIG.nail.top), torch.zeros(1, 3), CONFIG.swing_radius)
    reference = CatchReference(1, strike, CONFIG.nail.driven, 0.025, "cpu", CatchSettings(memory=0.3))
    reference.begin(torch.arange(1), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]))
    reference.phase.index.fill_(PHASES.index(phase))
    reference.advance(invented(1, object_p=torch.tensor([[0.1, 0.0, 0.0]])))
    torch.testing.assert_close(reference.buffers.grasped_p, torch.tensor([[0.1 * share, 0.0, 0.0]]))


@pytest.mark.parametrize(
    ("beyond", "driven", "done", "lost"),
    [(-0.01, False, False, False), (-0.01, True, False, False), (0.01, False, False, True), (0.01, True, True, False)],
)
def test_a_blow_is_followed_by_another_until_the_nail_is_in(beyond: float, driven: bool, done: bool, lost: bool):
    settings = CatchSettings()
    swing = phases(settings)[SWING]
    spent = torch.tensor([settings.swing_time + settings.dwell + beyond])
    t = Timing(torch.zeros(1), spent, torch.zeros(1), torch.zeros(1), torch.tensor([driven]))
    assert swing.lost is not None
    assert (swing.done(t).item(), swing.lost(t).item(), swing.back_to) == (done, lost, "raise")


# ---------------------------------------------------------------------- solution


@pytest.mark.slow
@pytest.mark.parametrize("learned", [False, True], ids=["script", "policy"])
def test_between_catch_and_blow_the_wrist_turns_the_hammer(learned: bool):
    """Medians over the starts in which the stage `orient` was done."""
    starts = 64
    task = tasks.make_task("DoraHammer-v1", starts)
    policy = dora.load_policy("DoraHammer-v1") if learned else lambda obs: torch.zeros(starts, task.action_size)
    observation = task.reset(seed=30_000)[0]
    before, turned = torch.full((2, starts, 4), float("nan")), torch.full((2, starts), float("nan"))
    for _ in range(task.max_steps):
        s = task.snapshot
        now = torch.stack([relative((s.hand.wrist_p, s.hand.wrist_q), (s.object.p, s.object.q))[1], s.object.q])
        begins = (s.stage >= mdp.HELD) & before[0, :, 0].isnan()
        before[:, begins] = now[:, begins]
        ends = (s.stage >= mdp.strike_stage(CONFIG)) & turned[0].isnan()
        turned[:, ends] = rotation_angle(before[:, ends].flatten(0, 1), now[:, ends].flatten(0, 1)).view(2, -1)
        observation = task.step(policy(observation))[0]
    in_hand, in_world = turned.nanmedian(-1).values.tolist()
    print(f"{turned[0].isfinite().sum()} of {starts}: {in_hand:.3f} rad in the hand, {in_world:.2f} in the world")
    assert in_hand < 0.15
    assert in_world > 1.4
    task.close()


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


def test_numbers_of_a_start_that_can_be_chosen_span_what_is_drawn():
    """Their shares are the random numbers themselves, 0 at the lowest value and 1 at the highest."""
    c = HammerConfig()
    starts = HammerTask(c).starts()
    assert starts is not None
    ranges = {number.name: (number.low, number.high) for number in starts.numbers}
    (x, y, _), w = c.release, c.spread
    assert ranges == {
        "release x": (x - w, x + w), "release y": (y - w, y + w), "fall": c.fall, "tilt x": (-c.tilt, c.tilt),
        "tilt y": (-c.tilt, c.tilt), "roll": (-c.roll, c.roll),
        **{f"spin {axis}": (-c.spin, c.spin) for axis in "xyz"},
    }  # fmt: skip
