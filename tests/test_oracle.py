"""The exact correction of a candidate's error, and the tool that runs episodes with it."""

from typing import Any

import pytest
import torch

from dora.geometry.rotations import rotation_angle
from dora.tasks import make_task
from dora.tasks.guidance.exact_correction import exact_correction
from dora.tasks.guidance.residual_action import SMOOTHING, Target
from dora.tools import oracle

SETTLED = 60
"""Control steps after which the low-passed residual is the action."""


@pytest.fixture(scope="module", params=[20, 15])
def task(request: pytest.FixtureRequest):
    made = make_task("DoraJug-v1", 4, preset="hard", hand_joints=request.param)
    made.reset(seed=[1, 2, 3, 4])
    yield made
    made.close()


def test_with_it_the_reference_leads_to_the_candidate_of_the_set(task):
    arm = task.arms.only
    choice, residual = arm.guide.choice, arm.guide.residual
    held, b, chosen = choice.candidates, choice.buffers, choice.buffers.chosen.long()
    expand = arm.agent.wrist_controller.expand_hand
    action = exact_correction(choice, residual.bounds, expand, arm.action_size - 6)
    wrong = Target(b.position[:, 0].clone(), b.quaternion[:, 0].clone(), b.grasp.clone())
    assert ((wrong.wrist_p - held.position[chosen]).norm(dim=-1) > 1e-3).all()
    residual.begin(torch.arange(4))
    for _ in range(SETTLED):
        mended = residual.apply(wrong, action, expand)
    assert (1 - SMOOTHING) ** SETTLED < 1e-8
    inside = action[:, :6].abs().amax(-1) < 1
    assert inside.any()
    assert (mended.wrist_p - held.position[chosen])[inside].abs().max() < 1e-5
    assert rotation_angle(mended.wrist_q, held.quaternion[chosen])[inside].max() < 1e-3
    away = (mended.hand - held.grasp[chosen]).norm(dim=-1)
    before = (wrong.hand - held.grasp[chosen]).norm(dim=-1)
    if task.action_size == 26:
        assert away.max() < 1e-4
    else:  # a coupled finger cannot undo what bends its joints differently
        assert (away < before).all()


def test_it_is_the_same_each_time_to_the_last_digit(task):
    """Whatever was in memory before; an episode may turn on it."""
    first = oracle.exact_action(task)
    for size in range(40):
        kept = torch.ones(size + 1)
        assert torch.equal(oracle.exact_action(task), first), len(kept)


def test_without_an_error_there_is_nothing_to_correct(task):
    task.anneal(error=0.0)
    task.reset(seed=[1, 2, 3, 4])
    arm = task.arms.only
    choice, expand = arm.guide.choice, arm.agent.wrist_controller.expand_hand
    action = exact_correction(choice, arm.guide.residual.bounds, expand, arm.action_size - 6)
    assert action.abs().max() < 2e-2  # of the bounds: angles near zero are rounded so in float32
    task.anneal(error=1.0)


@pytest.mark.slow
def test_the_tool_runs_the_same_starts_with_each(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    begun, make, guidance = [], oracle.make_task, []

    def noted(*args: Any, **options: Any) -> Any:
        task: Any = make(*args, **options)
        reset = task.reset
        guidance.append(args[2])
        task.reset = lambda seed: (reset(seed=seed), begun.append(task.objects["cube"].pose.p.clone()))
        return task

    monkeypatch.setattr(oracle, "make_task", noted)
    monkeypatch.setattr(oracle, "BATCH", 2)
    words = ["oracle", "DoraCube-v1", "--episodes", "2", "--preset", "hard", "--guidance", "grasps"]
    monkeypatch.setattr("sys.argv", words)
    oracle.main()
    out = capsys.readouterr().out
    assert "DoraCube-v1, hard, guidance grasps:" in out
    assert guidance == ["grasps"] * 3
    lines = [line for line in out.splitlines() if " none " in f"{line} " or "exact" in line]
    sizes = [float(line.split()[-1]) for line in lines[-3:]]
    assert sizes[:2] == [0.0, 0.0]
    assert sizes[2] > 0.1
    assert len(begun) == 3
    assert torch.equal(begun[0], begun[1])
    assert torch.equal(begun[0], begun[2])


def test_no_episodes_are_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr("sys.argv", ["oracle", "DoraCube-v1", "--episodes", "0"])
    assert oracle.main()
    assert "--episodes is 0; it has to be at least 1." in capsys.readouterr().err
