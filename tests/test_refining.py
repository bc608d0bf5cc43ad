"""Refining of bundled sets: search near given grasps, execution in the task, and what is stored."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.catalogue import load_object
from dora.affordance.search.initial_poses import Nearness, PosesNear
from dora.affordance.search.optimise import Settings, optimise
from dora.errors import InputError
from dora.geometry.rotations import rotation_angle
from dora.progress import ProgressDisplay
from dora.robot import RobotDescription
from dora.sim.grasp_tests.bundle_maker import KEPT, ROUND, SetMaker
from dora.tools.in_task import refining
from dora.tools.in_task.ranking import TaskRanking
from dora.tools.in_task.refining import CHILDREN, CONTENDERS, FINAL_TRIES, PARENTS, refine_bundled_set


def test_poses_are_drawn_near_each_of_the_given_ones(robot: RobotDescription):
    parents = load_candidates("jug").select(slice(3))
    spread = Nearness(position=0.01, rotation=0.1, joint=0.02)
    near = PosesNear(parents, HandModel(robot), spread)
    wrist, joints = near.draw(6000, torch.Generator().manual_seed(0))
    shift = wrist[:, :3, 3] - parents.position[torch.arange(6000) % 3].to(wrist)
    assert shift.mean(0).abs().max() < 5e-4
    torch.testing.assert_close(shift.std(0), torch.full((3,), 0.01).to(wrist), rtol=0.05, atol=0)
    turned = wrist[:, :3, :3].mT @ near.rotation[torch.arange(6000) % 3]
    trace = turned.diagonal(dim1=1, dim2=2).sum(1)
    angle = ((trace - 1) / 2).clamp(-1, 1).acos()
    assert (angle.square().mean() / 3).sqrt() == pytest.approx(0.1, rel=0.05)
    reduced = robot.reduce_hand(parents.joints)[torch.arange(6000) % 3].to(joints)
    inside = (reduced > near.hand.lower + 0.1) & (reduced < near.hand.upper - 0.1)
    assert (joints - reduced)[inside].std() == pytest.approx(0.02, rel=0.05)
    assert ((joints >= near.hand.lower) & (joints <= near.hand.upper)).all()


def test_a_search_near_a_grasp_ends_near_it_and_is_measured_like_any(robot: RobotDescription):
    parent = load_candidates("jug").select([0])
    obj = load_object("jug")
    settings = Settings(iterations=20, starts=1, field_size=1.0, oversampling=1.5)
    found = optimise(obj, robot, 12, 1, obj.target, settings, near=parent)
    assert (found.position - parent.position).norm(dim=1).max() < 0.05
    assert rotation_angle(found.quaternion, parent.quaternion.expand(12, 4)).max() < 0.6
    assert len({tuple(row) for row in found.position.tolist()}) == 12
    assert found.contact_map.shape[1] == parent.contact_map.shape[1]
    assert found.penetration.isfinite().all()
    with pytest.raises(InputError, match="grasps of 'jug', not of 'hammer'"):
        optimise(load_object("hammer"), robot, 12, 1, near=parent)


class Store:
    """A set that is refined without search and simulation: children are worth more than their parents."""

    def __init__(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, region: bool = True):
        self.path, self.labels, self.executed, self.tables = tmp_path / "set.safetensors", [], [], []
        self.before = load_candidates("jug", region=region)
        monkeypatch.setattr(refining, "load_candidates", lambda name, region: self.before)
        monkeypatch.setattr(refining, "bundled_path", lambda name, region: self.path)
        monkeypatch.setattr(refining, "rank_in_task", self.rank)
        monkeypatch.setattr(refining, "bundle_feasibility_tables", self.tables.append)
        monkeypatch.setattr(SetMaker, "valid", self.valid)

    def valid(
        self, num: int, seed: int, label: str | None, usable: Any, near: GraspCandidates | None
    ) -> GraspCandidates | None:
        assert (num, usable) == (ROUND, None)
        assert near is not None
        self.labels.append((label, len(near)))
        if seed % 100 == 1:
            return None
        return replace(
            near, position=near.position + torch.tensor([0.0, 0.0, 1.0]), score=torch.full_like(near.score, torch.nan)
        )

    def rank(
        self, env_id: str, candidates: GraspCandidates, episodes: int, progress: Callable[[int, int], None], seed: int,
        region: bool,
    ) -> TaskRanking:  # fmt: skip
        self.executed.append((env_id, len(candidates), episodes, seed, region))
        count = len(candidates)
        return TaskRanking(torch.full((count,), episodes // count), self.worth(candidates), 1000)

    @staticmethod
    def worth(candidates: GraspCandidates) -> Tensor:
        """Higher ones are better, and among them those farther along x."""
        return (candidates.position[:, 2].floor() / 4 + 0.1 * candidates.position[:, 0].clamp(-1, 1)).clamp(0, 1)

    def refine(self, region: bool = True) -> GraspCandidates:
        assert refine_bundled_set("jug", ProgressDisplay(), region) == [self.path]
        return GraspCandidates.load(self.path)


@pytest.mark.parametrize("region", [True, False])
def test_the_best_of_two_generations_come_first_and_the_steps_are_counted(
    region: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    store = Store(tmp_path, monkeypatch, region)
    found = store.refine(region)
    target = torch.tensor([name == "HandleGrasp" for name in found.grasp_class])
    if region:
        assert int(target.sum()) == KEPT == int(target[:KEPT].sum())
        assert len(found) - KEPT == int((~store.before.of_class("HandleGrasp")).sum())
    else:
        assert len(found) == KEPT
    generation = found.position[:CONTENDERS, 2].floor()
    assert (generation[:PARENTS] == 2).all()
    assert set(store.labels) >= {("handle" if region else None, PARENTS), ("handle" if region else None, CONTENDERS)}
    assert all(env_id == "DoraJug-v1" and asked == region for env_id, _, _, _, asked in store.executed)
    counts = [count for _, count, _, _, _ in store.executed]
    assert counts == [min(5 * PARENTS, CHILDREN), CONTENDERS + PARENTS, CHILDREN, CONTENDERS + PARENTS, CONTENDERS]
    assert store.executed[-1][2] == FINAL_TRIES * CONTENDERS
    assert len({seed for *_, seed, _ in store.executed}) == len(store.executed)
    torch.testing.assert_close(found.score[:CONTENDERS], store.worth(found)[:CONTENDERS])
    score = found.score[: KEPT if region else len(found)]
    assert (score[:-1] >= score[1:]).all() or score[CONTENDERS:].max() <= score[:CONTENDERS].min()
    settings = json.loads(found.settings)
    assert settings["ranking_steps"] == (store.before.ranking_steps or 0) + 5000
    assert settings["generations"] == 2
    assert store.tables == ["jug"]


def test_parents_remain_where_nothing_is_found_near_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    store = Store(tmp_path, monkeypatch)
    monkeypatch.setattr(SetMaker, "valid", lambda *_: None)
    found = store.refine()
    assert len(store.executed) == 1
    assert len(found) == len(store.before)


@pytest.mark.parametrize(
    ("name", "words"), [("microwave", "DoraMicrowave-v1 has several arms"), ("spoon", "no object 'spoon'")]
)
def test_what_cannot_be_refined_is_said(name: str, words: str):
    with pytest.raises(InputError, match=words):
        refine_bundled_set(name, ProgressDisplay())


def test_a_set_is_ranked_before_it_is_refined(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    store = Store(tmp_path, monkeypatch)
    store.before = replace(store.before, settings="")
    with pytest.raises(InputError, match="dora grasps --object jug --rank-in-task"):
        store.refine()
    assert not store.path.exists()
