"""The ladder of guidance: what each step takes away, what stays the same, and whether the reach filter pays."""

import json
import sys
from typing import Any

import pytest
import torch
from torch import Tensor

import dora.tasks as tasks
from dora.affordance.bundled_sets import load_candidates
from dora.affordance.reach.approach_paths import OK
from dora.commands import bench
from dora.geometry.rotations import quaternion_from_rotation_vector
from dora.tasks.mdp.guidance_parts import PARTS
from dora.tools.filter_benchmark import Outcomes, outcomes


@pytest.mark.parametrize(
    ("env_id", "config"),
    [
        ("DoraCube-v1", {}),
        pytest.param("DoraCube-v1", {"optimised": True}, marks=pytest.mark.slow),
        ("DoraJug-v1", {}),
        ("DoraHammer-v1", {}),
    ],
    ids=["cube", "cube optimised", "jug", "hammer"],
)
def test_grasps_take_away_the_regions_and_nothing_else(env_id: str, config: dict[str, Any]):
    made = [tasks.make_task(env_id, 4, guidance=g, config=config) for g in ("affordance", "grasps", "none")]
    whole, grasps, plain = made
    regional = {k for k, e in whole.observation_entries.items() if e.region}
    assert regional
    assert set(whole.observation_entries) - set(grasps.observation_entries) == regional
    assert set(whole.terms.terms) - set(grasps.terms.terms) == {k for k, t in whole.terms.terms.items() if t.region}
    assert "affordance" not in grasps.terms.terms
    assert "candidate" in grasps.terms.terms
    assert grasps.arm.takes_residual
    assert grasps.action_size == whole.action_size
    assert set(plain.terms.terms) < set(grasps.terms.terms)
    for task in (whole, grasps, plain):
        task.reset(seed=11)
    for other in (grasps, plain):
        torch.testing.assert_close(whole.snapshot.object.p, other.snapshot.object.p, atol=0, rtol=0)
        torch.testing.assert_close(whole.snapshot.object.q, other.snapshot.object.q, atol=0, rtol=0)
    mine, blind = (t.guide.choice.candidates for t in (whole, grasps))
    assert blind.ranking_steps
    made_by_hand = env_id == "DoraCube-v1" and not config
    if not made_by_hand:
        assert len(mine) == len(blind)
        assert not torch.equal(mine.position, blind.position)
    unknown = made_by_hand or env_id == "DoraHammer-v1"  # the hammer's set of the region is of an earlier version
    assert mine.ranking_steps == whole.ranking_steps == (None if unknown else blind.ranking_steps)
    for task in (whole, grasps, plain):
        task.close()


@pytest.mark.slow
def test_grasps_take_away_the_regions_of_both_arms():
    whole, grasps = (tasks.make_task("DoraMicrowave-v1", 4, guidance=g) for g in ("affordance", "grasps"))
    regional = {k for k, e in whole.observation_entries.items() if e.region}
    assert {name.partition("/")[0] for name in regional} == {"left", "right"}
    assert set(whole.observation_entries) - set(grasps.observation_entries) == regional
    assert set(whole.terms.terms) - set(grasps.terms.terms) == {"affordance_left", "affordance_right"}
    sets = {"left": load_candidates("microwave", region=False)}
    sets["right"] = load_candidates("cube", region=False, task="DoraMicrowave-v1")
    grasps.reset(seed=11)
    config: Any = grasps.config
    for name, arm in grasps.arms.items():
        used = arm.guide.choice.candidates
        assert 0 < len(used) <= config.most_candidates
        assert torch.equal(used.score.cpu(), sets[name].score[: len(used)])
        assert used.score.min() >= config.fewest * sets[name].score.max()
    for task in (whole, grasps):
        task.close()


@pytest.mark.parametrize("env_id", ["DoraCube-v1", "DoraJug-v1"])
def test_what_the_filter_says_is_its_table(env_id: str):
    """Objects all over the task's area, and beyond it, where the table rejects some candidates and accepts others."""
    task: Any = tasks.make_task(env_id, 2)
    task.reset(seed=0)
    torch.manual_seed(0)
    (x, y), height, count = task.config.centre, task.snapshot.object.p[0, 2].item(), 400
    p = torch.tensor([x, y, height]) + 0.4 * (torch.rand(count, 3) - 0.5) * torch.tensor([1.0, 1.0, 0.0])
    q = quaternion_from_rotation_vector(torch.tensor([0.0, 0.0, 6.28]) * torch.rand(count, 1))
    table = task.arm.reach_table
    assert table is not None
    said = task.task.reachable(task.arm, torch.zeros(count, dtype=torch.long), p, q)
    assert torch.equal(said, table.mask(p, q))
    assert said.any()
    assert not said.all()
    task.close()


def test_the_filter_of_the_hammer_asks_whether_the_hand_can_wait_below_it():
    task: Any = tasks.make_task("DoraHammer-v1", 2)
    p = torch.tensor(task.config.release).repeat(2, 1) + torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0]])
    q = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)
    near, far = task.task.reachable(task.arm, torch.arange(2), p, q)
    assert near.any()
    assert not far.any()
    task.close()


def test_the_class_of_the_grasp_belongs_to_the_task_of_the_jug():
    task = tasks.make_task("DoraJug-v1", 2, guidance="none")
    assert "class" in task.terms.terms
    task.close()


def test_candidates_of_a_blind_search_may_be_of_any_class():
    assert len(set(load_candidates("jug", region=False).grasp_class)) > 1


def test_a_start_without_a_reachable_candidate_fails_at_once_and_earns_nothing(monkeypatch: pytest.MonkeyPatch):
    task = tasks.make_task("DoraCube-v1", 2, preset="none")
    able = task.task.reachable

    def none_for_the_second(arm: Any, rows: Tensor, p: Tensor, q: Tensor) -> Tensor:
        return able(arm, rows, p, q) & torch.tensor([[True], [False]])

    monkeypatch.setattr(task.task, "reachable", none_for_the_second)
    task.reset(seed=0)
    _, reward, _, _, info = task.step(torch.zeros(2, task.action_size))
    assert info["unreachable"].tolist() == info["fail"].tolist() == [False, True]
    assert reward[0] > 0
    assert reward[1] == 0
    task.close()


def test_the_filter_leaves_only_what_it_accepts(monkeypatch: pytest.MonkeyPatch):
    """Every second candidate is out of reach: with the filter none of them leads, without it some do."""
    parts = tuple(p for p in PARTS if p != "filter")
    even = {}
    for name, given in (("filtered", None), ("free", parts)):
        task = tasks.make_task("DoraJug-v1", 64, guidance_parts=given)

        def every_second(arm: Any, rows: Tensor, p: Tensor, q: Tensor) -> Tensor:
            mask = torch.zeros(len(p), len(arm.guide.choice.candidates), dtype=torch.bool)
            mask[:, ::2] = True
            return mask

        monkeypatch.setattr(task.task, "reachable", every_second)
        task.reset(seed=0)
        even[name] = (task.guide.choice.buffers.chosen % 2 == 0).float().mean().item()
        task.close()
    assert even["filtered"] == 1.0
    assert even["free"] < 0.9


@pytest.mark.slow
def test_what_f_reach_rejects_fails_more_than_twice_as_often():
    """Of all stored grasps by the handle: the twelve best are alike, and nearly all of them can be carried out."""
    every = {"most_candidates": 96, "fewest_lifts": 0.0}
    found = outcomes("DoraJug-v1", 64, "none", "random", every)
    accepted, rejected = found.failure_rates()
    print(f"accepted candidates fail in {accepted:.2f}, rejected ones in {rejected:.2f}")
    assert rejected > 2 * accepted
    assert rejected > 0.5


@pytest.mark.slow
def test_f_reach_pays_on_the_cube_for_a_policy_that_has_learned(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """With zero correction half of what can be carried out fails, by errors of the candidate that a policy undoes."""
    monkeypatch.setattr(sys, "argv", ["bench", "filter", "DoraCube-v1", "--policy", "--episodes", "64", "--json"])
    assert bench.main() == 0
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])["random"]
    assert printed["accepted"] + printed["rejected"] == 64
    assert printed["rejected_failed"] > 2 * printed["accepted_failed"]
    assert printed["accepted_failed"] < 0.1


def test_outcomes_are_counted_by_what_f_reach_says(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    mixed = Outcomes(torch.tensor([OK, OK, OK + 1, OK + 1, OK + 1]), torch.tensor([True, False, False, False, True]))
    assert mixed.summary() == {
        "accepted": 2,
        "rejected": 3,
        "accepted_failed": 0.5,
        "rejected_failed": pytest.approx(2 / 3),
    }
    alone = Outcomes(torch.tensor([OK] * 5), torch.ones(5, dtype=torch.bool))
    assert alone.summary() == {"accepted": 5, "rejected": 0, "accepted_failed": 0.0, "rejected_failed": None}
    monkeypatch.setattr(
        bench, "outcomes", lambda env, episodes, preset, choice, act: mixed if choice == "random" else alone
    )
    bench.bench_filter("DoraJug-v1")
    printed = capsys.readouterr().out
    assert "failed: 0.000 of the accepted\n" in printed
    assert "failed: 0.500 of the accepted, 0.667 of the rejected" in printed
    bench.bench_filter("DoraJug-v1", json=True)
    assert json.loads(capsys.readouterr().out)["nearest"]["rejected_failed"] is None
