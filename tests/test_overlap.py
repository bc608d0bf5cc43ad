"""Overlap is looked for in every physics step, between everything that an arm or an object may touch."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import sapien
import torch
from solids import PairWatch, Solids, depth

import dora.tasks as tasks
from dora.sim.overlap import OverlapMonitor
from dora.sim.substeps import watch_physics
from dora.tasks.cube import CubeConfig, CubeTask
from dora.tasks.env import options
from dora.tasks.env.env import DoraEnv
from dora.tasks.env.options import task_config
from dora.tasks.microwave.snapshot import LEFT, RIGHT

OVEN = ("handle", "door", "body")
"""Names of the bodies of the microwave."""
BOTH = [(arm, name) for arm in (LEFT, RIGHT) for name in (*OVEN, "cube")]
PAIRS = [*BOTH, (LEFT, RIGHT), ("cube", "door"), ("cube", "body")]
"""What may meet in the task of the microwave, besides the table and an arm with itself."""
HIDDEN = {"DoraMicrowave-v1": 0.3, "DoraJug-v1": 1.6, "DoraHammer-v1": 0.3}
"""Largest 90th percentile of an episode's true overlap less the reported one [mm]."""


def groups_of(task: DoraEnv) -> dict[str, list[Any]]:
    """Links of each arm, objects, and what the microwave is made of, by name."""
    arms = {name: list(arm.agent.robot.links) for name, arm in task.arms.items()}
    oven = getattr(task.task, "oven", None)
    links = {name: [oven.links[name]] for name in OVEN} if oven else {}
    return {**arms, **{name: [o] for name, o in task.objects.items()}, **links}


def reported_and_true(env: str, n: int, persistent: bool | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Largest overlap of scripted episodes of objects with arms and with what they are put into [mm] (n,): as PhysX
    reports it, and from geometry.

    Args:
        env: id.
        n: episodes, seed 100.
        persistent: contacts that PhysX keeps; None: as the task has it.
    """
    task = tasks.make_task(env, n, config={} if persistent is None else {"persistent_contacts": persistent})
    task.reset(seed=100)
    pairs = PAIRS if len(task.arms) > 1 else [(arm, name) for arm in task.arms for name in task.objects]
    watch = PairWatch(task.scene, groups_of(task), pairs)
    info: dict[str, Any] = {}
    for _ in range(task.max_steps):
        info = task.step(torch.zeros(n, task.action_size))[-1]
    task.close()
    reported, true = (1000 * overlap.max(1) for overlap in (watch.reported, watch.true))
    print(f"reported {np.round(reported, 2)} mm, true {np.round(true, 2)} mm")
    assert (reported <= info["penetration_max_mm"].numpy() + 1e-3).all()
    return reported, true


def test_nothing_deeper_than_what_is_reported_happens():
    reported, true = reported_and_true("DoraCube-v1", 12)
    assert (true < reported + 0.5).all()
    assert true.max() > 1.0  # the test sees something


@pytest.mark.slow
def test_persistent_contacts_let_fingers_into_the_cube():
    """Why the cube does without them: a finger that slides over an edge sinks in, and no contact is reported."""
    assert reported_and_true("DoraCube-v1", 12, persistent=True)[1].max() > 4.0


@pytest.mark.slow
@pytest.mark.parametrize(("env", "n"), [("DoraMicrowave-v1", 8), ("DoraJug-v1", 32), ("DoraHammer-v1", 12)])
def test_contacts_hide_no_more_than_was_measured(env: str, n: int):
    """Jug and microwave keep them, and some overlap is deeper than reported; little of the hammer's (findings.md)."""
    reported, true = reported_and_true(env, n)
    assert np.quantile(true - reported, 0.9) <= HIDDEN[env]


def at_the_start(env_id: str) -> Iterator[DoraEnv]:
    """Two environments without randomisation, closed in the end."""
    made = tasks.make_task(env_id, 2, preset="none")
    made.reset(seed=0)
    yield made
    made.close()


@pytest.fixture
def task() -> Iterator[DoraEnv]:
    yield from at_the_start("DoraCube-v1")


def shifted(pose: sapien.Pose, up: float) -> sapien.Pose:
    return sapien.Pose([pose.p[0], pose.p[1], pose.p[2] + up], pose.q)


def test_an_overlap_that_is_over_before_the_control_step_ends_is_seen(task: DoraEnv):
    """The cube is put into the table for the first physics step only; the solver has pushed it out by the last."""
    body, steps = task.target_object._bodies[0], [0]
    start = body.entity.pose

    def lift_again(row: int) -> None:
        if row == 0:
            steps[0] += 1
            body.entity.set_pose(shifted(start, 0.01))
            body.set_linear_velocity([0.0, 0.0, 0.0])

    body.entity.set_pose(shifted(start, -0.008))
    watch_physics(task.scene, lift_again)
    info = task.step(torch.zeros(2, task.action_size))[-1]
    assert steps[0] == 5
    assert info["penetration_mm"][0] == pytest.approx(8.0, abs=0.5)
    assert info["penetration_mm"][1] < 1
    assert task.task_scene.reader.overlap.max_penetration_pair(0) is not None
    again = task.step(torch.zeros(2, task.action_size))[-1]
    assert again["penetration_mm"][0] < 1
    assert again["penetration_max_mm"][0] == pytest.approx(8.0, abs=0.5)
    assert task.observed.max_penetration[0] > 0.007


def test_the_arm_and_the_hand_themselves_are_watched(task: DoraEnv):
    """A fist closed by force of will: fingers in the palm, and the elbow in the table."""
    robot = task.agent.robot
    q = robot.get_qpos().clone()
    names = [joint.name for joint in robot.active_joints]
    for finger in ("Index", "Thumb"):
        for k in range(1, 4):
            q[0, names.index(f"Right_{finger}_{k}")] = 1.4
    robot.set_qpos(q)
    info = task.step(None)[-1]
    assert info["penetration_mm"][0] > 1.0
    pair = task.task_scene.reader.overlap.max_penetration_pair(0)
    assert pair is not None
    assert all(name in {link.name for link in robot.links} for name in pair)
    assert info["penetration_mm"][1] < 1.0


def test_one_environment_reports_the_same_as_a_batch():
    depths = []
    for backend, n in (("physx_cpu", 1), ("physx_cpu_batch", 1)):
        task = tasks.make_task("DoraCube-v1", n, sim_backend=backend, preset="none")
        task.reset(seed=3)
        for _ in range(70):
            info = task.step(task.scripted_action())[-1]
        depths.append(info["penetration_max_mm"].item())
        task.close()
    assert depths[0] > 0
    assert depths[0] == pytest.approx(depths[1], abs=1e-4)


@pytest.fixture
def two_arms() -> Iterator[DoraEnv]:
    yield from at_the_start("DoraMicrowave-v1")


IN_OVEN = {"body": ((0.17, 0.15, 0.12), 1), "door": ((-0.06, 0.0, 0.12), 0)}
"""Where the cube is near wall or door in the microwave's frame [m], and the axis along which it is moved into it."""


@pytest.mark.parametrize("pair", [(LEFT, RIGHT), (RIGHT, "door"), ("cube", "body"), ("cube", "door")])
def test_every_pair_of_the_microwave_is_watched(two_arms: DoraEnv, pair: tuple[str, str]):
    """The first body is moved on in steps of 1 mm until shapes and poses say that it is 4 mm in the second one."""
    groups = groups_of(two_arms)
    one, other = (Solids(groups[name], 0) for name in pair)
    if pair[0] == "cube":
        place, axis = IN_OVEN[pair[1]]
        body, start = two_arms.objects["cube"]._bodies[0].entity, groups["body"][0]._bodies[0].entity.pose
        start, move = start * sapien.Pose(list(place)), body.set_pose
        ahead = np.eye(3)[axis]
    else:
        robot = two_arms.arms[pair[0]].agent.robot._objs[0]
        start, move = robot.root_pose, robot.set_root_pose
        ahead = np.array([0.0, -1.0, 0.0])
        if pair[1] == "door":
            start, ahead = (
                sapien.Pose((start.p + np.array([0.0, 0.25, 0.0])).tolist(), start.q),
                np.array([1.0, 0.0, 0.0]),
            )
    wanted = 0.0
    for step in range(1000):
        move(sapien.Pose((start.p + 0.001 * step * ahead).tolist(), start.q))
        wanted = 1000 * depth(one, other, one.poses(), other.poses())
        if wanted >= 4:
            break
    assert 4 <= wanted < 8
    info = two_arms.step(torch.zeros(2, two_arms.action_size))[-1]
    assert info["penetration_mm"][0] >= wanted - 0.5
    assert info["penetration_mm"][1] < 1
    assert two_arms.snapshot.penetration[0] == pytest.approx(info["penetration_mm"][0].item() / 1000)
    found = two_arms.task_scene.reader.overlap.max_penetration_pair(0)
    names = [{link._bodies[0].entity.name for link in groups[name]} for name in pair]
    assert found is not None
    assert any(found[k] in names[0] and found[1 - k] in names[1] for k in (0, 1)), found


def test_where_overlap_is_not_reported_numbers_are_finite_and_nothing_is_a_success(monkeypatch: pytest.MonkeyPatch):
    """As on a GPU: what was a success is one of `raw_success` alone."""
    unknown = torch.full((4,), torch.nan)
    seen: dict[bool, dict[str, Any]] = {}
    for known in (True, False):
        with monkeypatch.context() as patch:
            if not known:
                patch.setattr(OverlapMonitor, "take", lambda _: unknown.clone())
            task = tasks.make_task("DoraCube-v1", 4, preset="none")
            observation, _ = task.reset(seed=0)
            for _ in range(task.max_steps):
                assert observation.isfinite().all()
                observation, reward, *_, info = task.step(torch.zeros(4, task.action_size))
                assert reward.isfinite().all()
            task.close()
            seen[known] = info
    assert seen[True]["success"].any()
    assert seen[False]["raw_success"].equal(seen[True]["raw_success"])
    assert not seen[False]["success"].any()
    assert not seen[False]["nonfinite"].any()
    assert seen[False]["penetration_mm"].isnan().all()


@pytest.mark.parametrize("backend", ["physx_cuda", "gpu", "cuda:0"])
def test_a_task_on_a_gpu_says_that_overlap_is_not_known(
    backend: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(options.logger, "propagate", True)
    given: Any = ("none", None, 20, task_config(CubeConfig, "none", None), None, CubeTask.robots(), 2, None)
    check: Any = options.check_options
    chosen = check(*given, backend, "none", None, "state")
    assert chosen.sim_backend == backend
    assert "does not report on a GPU how deep bodies overlap" in caplog.text


def test_the_default_is_a_cpu_with_and_without_cuda(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    given: Any = ("none", None, 20, task_config(CubeConfig, "none", None), None, CubeTask.robots())
    check: Any = options.check_options
    for count, backend in ((1, "physx_cpu"), (2, "physx_cpu_batch")):
        assert check(*given, count, None, "auto", "none", None, "state").sim_backend == backend
