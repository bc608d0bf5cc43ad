"""Where the hammer of DoraHammer-v1 is released, how it moves then, and what is forgotten of the last episode."""

import inspect
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import dora.tasks as tasks
from dora.geometry.rotations import quaternion_from_rotation_vector, quaternion_multiply
from dora.tasks.hammer import task as hammer
from dora.tasks.hammer.task import UNKNOWN, HammerConfig, HammerTask

C = HammerConfig()
"""The task's own numbers."""
SIZE = 1.1
"""Size of the second hammer, relative to the nominal one."""


@pytest.fixture(scope="module")
def task() -> Iterator[Any]:
    made = tasks.make_task("DoraHammer-v1", 2, preset="none", guidance="none")
    yield made
    made.close()


def released(task: Any, *shares: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Position, orientation, velocity and spin of the second hammer, released with these random numbers; those that
    are not given are a half."""
    rows = torch.tensor([1])
    u = torch.full((1, HammerTask.DRAWS), 0.5)
    u[0, : len(shares)] = torch.tensor(shares)
    scene = task.task_scene
    scene.scene._reset_mask[:] = torch.tensor([False, True])
    task.task.place(scene, rows, u)
    scene.scene._reset_mask[:] = True
    body = task.target_object
    return body.pose.p[1], body.pose.q[1], body.linear_velocity[1], body.angular_velocity[1]


@pytest.mark.parametrize("shares", [(0.5, 0.5, 0.5), (0.0, 1.0, 0.0), (1.0, 0.25, 1.0)])
def test_the_handle_ends_as_high_as_it_falls(task: Any, shares: tuple[float, ...]):
    task.reset(seed=0)
    p, q, v, w = released(task, *shares)
    x, y, height = (2 * share - 1 for share in shares)
    fall = C.fall[0] + (height + 1) / 2 * (C.fall[1] - C.fall[0])
    butt = float(task.task.points["butt"][1, 2])
    expected = [C.release[0] + C.spread * x, C.release[1] + C.spread * y, C.release[2] + fall - butt]
    assert p.tolist() == pytest.approx(expected, abs=1e-5)
    torch.testing.assert_close(q.abs(), torch.tensor([1.0, 0.0, 0.0, 0.0]), atol=1e-6, rtol=0)
    assert v.abs().max() == w.abs().max() == 0.0


def test_it_is_tilted_after_it_is_rolled_and_spins(task: Any):
    task.reset(seed=0)
    _, q, _, w = released(task, 0.5, 0.5, 0.5, 1.0, 0.25, 0.75, 0.0, 0.75, 1.0)
    tilt = quaternion_from_rotation_vector(torch.tensor([C.tilt, -0.5 * C.tilt, 0.0]))
    roll = quaternion_from_rotation_vector(torch.tensor([0.0, 0.0, 0.5 * C.roll]))
    torch.testing.assert_close(q, quaternion_multiply(tilt, roll), atol=1e-6, rtol=0)
    assert w.tolist() == pytest.approx([-C.spin, 0.5 * C.spin, C.spin])


def test_what_was_remembered_of_it_is_forgotten(task: Any):
    task.reset(seed=0)
    for _ in range(2):
        task.step(torch.zeros(2, task.action_size))
    assert task.task.history.history.amin(1)[:, 0].max() < UNKNOWN
    released(task)
    assert (task.task.history.history[1] == UNKNOWN).all()
    assert task.task.history.history[0].min() < UNKNOWN
    assert task.task.turning.held[1].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert task.task.turning.way.tolist() == [0.0, 0.0]


def test_a_nail_counts_physics_steps_and_a_window_control_steps(monkeypatch: pytest.MonkeyPatch):
    """The face and its radius are those of a larger hammer, too."""
    made: dict[str, Any] = {}

    def nail(scene: Any, settings: Any, dt: float) -> Any:
        made.update(settings=settings, dt=dt)
        return SimpleNamespace(strike_with=lambda actor, face, radii: made.update(face=face, radii=radii))

    monkeypatch.setattr(hammer, "Nail", nail)
    config = replace(C, window=0.2)
    own: Any = HammerTask(config)
    scene: Any = SimpleNamespace(device=torch.device("cpu"), num_envs=2, scene=None, build=lambda *_, **__: None)
    build: Any = inspect.unwrap(HammerTask.build)  # without the check of types: this scene is invented
    build(own, scene, "hammer", torch.tensor([1.0, SIZE]).numpy())
    assert made["dt"] == pytest.approx(1 / 240)
    assert made["settings"] is config.nail
    assert own.history.history.shape == (2, 1 + 8, 7)
    assert made["radii"][1] == pytest.approx(SIZE * made["radii"][0])
    assert 0.008 < made["radii"][0] < 0.03
    for points in own.points.values():
        torch.testing.assert_close(points[1], SIZE * points[0])
    torch.testing.assert_close(torch.as_tensor(made["face"]), own.points["face"])
    assert own.points["neck"][0, 2] > own.points["butt"][0, 2]
    assert own.points["neck"][0, :2].equal(own.points["butt"][0, :2])
    assert own.turning.held.tolist() == [[1.0, 0.0, 0.0, 0.0]] * 2
