"""DoraJug-v1: its logic on invented states, and what its scripted grasp is worth."""

from dataclasses import replace
from math import cos, pi, radians, sin

import pytest
import torch
from invented import TIP_RADIUS, invented, memory
from mani_skill.utils.structs import Pose
from torch import Tensor

import dora.tasks as tasks
from dora.affordance.objects.catalogue import load_object
from dora.tasks import jug
from dora.tasks.jug import JugConfig
from dora.tasks.mdp.snapshot import CONTACT_CLASSES, Snapshot

STARTS = 40
"""Random starts of the scripted grasp."""
CONFIG = JugConfig()
"""The task's own numbers."""
THUMB, INDEX = CONTACT_CLASSES.index("thumb"), CONTACT_CLASSES.index("index")


def jugs(n: int, **given: Tensor) -> Snapshot:
    """Invented jugs of nominal size."""
    half = torch.as_tensor(load_object("jug").mesh.extents / 2, dtype=torch.float32)
    return invented(n, object_half=half.repeat(n, 1), **given)


def tilted(angle: float) -> Tensor:
    return torch.tensor([[cos(angle / 2), sin(angle / 2), 0.0, 0.0]])


def touching(*labels: str) -> Snapshot:
    """Thumb, index and so on, each in contact with the named region."""
    regions = jug.jug_map()
    where = [regions.points[regions.labels == regions.label_index(label)][7] for label in labels]
    finger = torch.arange(THUMB, THUMB + len(labels))
    return jugs(1, contact_p=torch.stack(where)[None], contact_finger=finger[None])


@pytest.mark.parametrize(
    ("labels", "by_handle"),
    [
        (("handle", "handle", "handle"), True),
        (("body", "body", "body"), False),
        (("handle", "body"), True),  # the thumb counts twice
        (("body", "handle"), False),
        (("rim", "rim", "handle"), False),
    ],
)
def test_the_class_is_voted_by_the_actual_contacts(labels: tuple[str, ...], by_handle: bool):
    assert bool(jug.by_the_handle(touching(*labels))) == by_handle


def test_without_contact_there_is_no_class():
    nothing = jugs(1, contact_p=torch.zeros(1, 3, 3), contact_finger=torch.zeros(1, 3, dtype=torch.long))
    assert jug.grasp_label(nothing).item() == -1
    assert not jug.by_the_handle(nothing)


def test_distances_are_those_of_the_handle_and_follow_the_jug():
    regions = jug.jug_map()
    handle = regions.labels == regions.label_index("handle")
    point, normal = regions.points[handle][::60][:5], regions.normals[handle][::60][:5]
    tips = point + 0.02 * normal
    turn = torch.tensor([[cos(0.6), 0.0, 0.0, sin(0.6)]])
    matrix = torch.tensor([[cos(1.2), -sin(1.2), 0], [sin(1.2), cos(1.2), 0], [0, 0, 1]])
    moved = tips @ matrix.T + torch.tensor([0.5, 0.1, 0.1])
    s = jugs(1, tip_p=moved[None], object_p=torch.tensor([[0.5, 0.1, 0.1]]), object_q=turn)
    expected = regions.region_distance(tips, "handle") - TIP_RADIUS
    torch.testing.assert_close(jug.handle_distance(s)[0], expected, atol=1e-4, rtol=0)
    assert (expected <= 0.0101).all()


@pytest.mark.parametrize(("angle", "level"), [(0.0, True), (25.0, True), (35.0, False), (90.0, False)])
def test_only_an_upright_jug_is_held(angle: float, level: bool):
    touch = torch.zeros(1, 6, dtype=torch.bool)
    touch[0, :2] = True
    s = jugs(1, object_p=torch.tensor([[0.0, 0.0, 0.12]]), object_q=tilted(radians(angle)), touch=touch)
    assert bool(jug.held(s, CONFIG)) == level


def test_every_term_stays_in_bounds_on_random_states():
    torch.manual_seed(0)
    n = 256
    s = jugs(
        n,
        tip_p=torch.randn(n, 5, 3), object_p=torch.randn(n, 3), wrist_p=torch.randn(n, 3), goal_p=torch.randn(n, 3),
        object_q=torch.nn.functional.normalize(torch.randn(n, 4), dim=-1),
        touch=torch.rand(n, 6) > 0.5, action=3 * torch.randn(n, 26), penetration=torch.rand(n) * 0.05,
        stage=torch.randint(0, 4, (n,)), contact_p=0.1 * torch.randn(n, 4, 3),
        contact_finger=torch.randint(0, 7, (n, 4)),
    )  # fmt: skip
    for terms in (jug.terms(CONFIG), jug.paper_terms(CONFIG)):
        for name, term in terms.terms.items():
            value = term.value(s)
            assert ((value >= 0) & (value <= 1)).all(), name


@pytest.fixture(scope="module")
def task() -> tasks.DoraEnv:
    """A batch after its scripted episode, with the stages it went through."""
    task = tasks.make_task("DoraJug-v1", STARTS, preset="none")
    assert isinstance(task.task, jug.JugTask)
    task.reset(seed=0)
    turn = task.snapshot.object.q
    task.yaw = 2 * torch.atan2(turn[:, 3], turn[:, 0]) % (2 * pi)  # type: ignore[attr-defined]
    seen, failed = [], torch.zeros(STARTS, dtype=torch.bool)
    for _ in range(task.max_steps):
        *_, info = task.step(task.scripted_action())
        seen.append(info["stage"])
        failed |= info["fail"]
    task.history, task.spilt = torch.stack(seen), failed  # type: ignore[attr-defined]
    return task


def test_the_script_lifts_by_the_handle_from_random_starts(task: tasks.DoraEnv):
    info = task.evaluate()
    success = info["success"] & ~task.spilt  # type: ignore[attr-defined]
    depth = info["penetration_max_mm"]
    print(f"success {success.float().mean():.2f}, penetration median {depth.median():.2f}, max {depth.max():.2f} mm")
    assert success.float().mean() >= 0.9
    for column in task.history[:, success].T:  # type: ignore[attr-defined]
        assert set(column.tolist()) >= {1, 2, 3}


def test_jugs_start_at_any_yaw(task: tasks.DoraEnv):
    share = torch.histc(task.yaw, 8, 0, 2 * pi) / STARTS  # type: ignore[attr-defined]
    assert (share > 0.03).all()


def test_what_fails_in_the_end_is_no_success(task: tasks.DoraEnv, monkeypatch: pytest.MonkeyPatch):
    assert task.evaluate()["success"].any()
    assert not task.evaluate()["fail"][task.evaluate()["success"]].any()
    lost = replace(task.mdp, failed=lambda s, memory: torch.ones(STARTS, dtype=torch.bool))
    monkeypatch.setattr(task, "mdp", lost)
    assert task.evaluate()["finished"].any()
    assert not task.evaluate()["success"].any()


def test_falling_over_and_being_dropped_are_failures(task: tasks.DoraEnv):
    s, failed = task.snapshot, task.mdp.failed
    held = jug.held(s, CONFIG)
    assert held.any()
    assert not failed(s, task.memory)[held].any()
    n = len(s.object.p)
    lying = jugs(n, object_q=tilted(radians(70)).repeat(n, 1), object_p=s.object.p, start_p=s.object.start_p)
    assert failed(lying, task.memory).all()
    standing = jugs(n, object_p=s.object.start_p, start_p=s.object.start_p, supported=torch.ones(n, dtype=torch.bool))
    rose = torch.linspace(0.0, 0.1, n)
    assert torch.equal(failed(standing, memory(n, highest=rose)), rose > CONFIG.dropped)
    assert failed(standing, task.memory).any()


def test_a_jug_that_was_dropped_and_is_lifted_again_is_no_success():
    task = tasks.make_task("DoraJug-v1", 1, preset="none")
    task.reset(seed=0)
    for _ in range(105):
        info = task.step(task.scripted_action())[-1]
    assert info["success"].all()
    state = task.get_state_dict()

    def put(height: float) -> dict:
        """The jug stands beside the hand, or is held there in the air; two steps later."""
        place = task.target_object.pose.p.clone()
        place[:, :2] += 0.2
        place[:, 2] = jug.jug().support + height
        task.target_object.set_pose(Pose.create_from_pq(place, torch.tensor([[1.0, 0.0, 0.0, 0.0]])))
        task.target_object.set_linear_velocity(torch.zeros(1, 3))
        task.target_object.set_angular_velocity(torch.zeros(1, 3))
        return [task.step(None)[-1] for _ in range(2)][-1]

    assert put(0.0)["fail"].all()
    info = put(0.08)
    assert info["fail"].all()
    assert not info["success"].any()
    dropped = task.get_state_dict()
    task.set_state_dict(state)
    assert task.evaluate()["success"].all()
    task.set_state_dict(dropped)
    assert task.evaluate()["fail"].all()
    earlier = {**dropped, "memory": {k: v for k, v in dropped["memory"].items() if k != "episode.failed"}}
    task.set_state_dict(earlier)  # of a version that did not remember it
    assert not task.evaluate()["fail"].any()
    task.close()


def test_masses_range_from_empty_to_full():
    task = tasks.make_task("DoraJug-v1", 24, preset="standard")
    task.reset(seed=0)
    mass = task.memory.object.mass
    assert (mass >= CONFIG.mass[0]).all()
    assert (mass <= CONFIG.mass[1]).all()
    assert mass.min() < 0.36
    assert mass.max() > 0.54
    body = task.target_object._bodies[5]
    assert body.mass == pytest.approx(mass[5].item())
    task.close()


def test_a_jug_stands_still_when_its_contacts_are_made_anew():
    task = tasks.make_task("DoraJug-v1", 6)
    task.reset(seed=0)
    for _ in range(9):
        task.step(None)
    stood = task.snapshot.object.p
    task.set_state_dict(task.get_state_dict())
    for _ in range(6):
        task.step(None)
        assert (task.snapshot.object.p - stood).abs().max() < 2e-4
    task.close()
