"""Ranking candidates by executing them in their task, and what of it comes with Dora."""

from dataclasses import replace
from inspect import unwrap
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from dora.affordance.bundled_sets import load_candidates
from dora.affordance.candidates import concatenate
from dora.affordance.objects.catalogue import load_object, own_objects
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.reach.feasibility_table import file_name
from dora.errors import InputError
from dora.tasks import make_task
from dora.tasks.cube import hand_made_candidates
from dora.tools.in_task import ranking
from dora.tools.in_task.ranking import (
    TaskRanking,
    _Balanced,
    as_mapping,
    rank_bundled_set,
    rank_in_task,
    ranked,
    tasks_of,
    usable_in_task,
)


@pytest.mark.slow
def test_a_proof_tells_a_good_grasp_from_one_in_the_air():
    good = hand_made_candidates().select([0])
    away = replace(good, position=good.position + torch.tensor([0.0, 0.0, 0.10]))
    found = rank_in_task("DoraCube-v1", concatenate([away, good]), 64, preset="none")
    assert found.tries.sum() <= 64
    assert (found.tries > 10).all()
    assert found.score[1] > 0.8
    assert found.score[0] == 0
    best_first = ranked(concatenate([away, good]), found)
    torch.testing.assert_close(best_first.position[0], good.position[0])
    assert best_first.score.tolist() == sorted(found.score.tolist(), reverse=True)


def test_every_reachable_candidate_is_tried_equally_often_and_no_other():
    pick = _Balanced(4, first=1)
    reachable = torch.tensor([[True, True, False, False]] * 6 + [[True, True, True, False]] * 6)
    only = pick(reachable)
    assert (only.sum(-1) == 1).all()
    assert (only & ~reachable).sum() == 0
    assert pick.tries[3] == 0
    assert pick.tries[:3].sum() == 12
    assert pick.tries[:3].max() - pick.tries[:3].min() <= 1
    assert pick.led[:3].tolist() == [1, 0, 1]


@pytest.mark.parametrize("settings", ["seat=1", "[" * 100_000, '{"a":' * 50 + "1" + "}" * 50, "[1, 2]"])
def test_settings_of_early_files_are_those_of_the_search_whatever_they_are(settings: str):
    assert as_mapping(settings) == {"search": settings}
    assert as_mapping('{"ranking_steps": 3}') == {"ranking_steps": 3}
    assert as_mapping("") == {}


def test_a_start_without_any_candidate_is_no_try():
    pick = _Balanced(2)
    only = pick(torch.zeros(3, 2, dtype=torch.bool))
    assert not only.any()
    assert not pick.possible.any()
    assert pick.tries.sum() == 0


def test_among_equals_the_one_reached_more_often_is_first():
    two = load_candidates("cube").select([0, 1])
    best_first = ranked(two, TaskRanking(torch.tensor([3, 9]), torch.tensor([1.0, 1.0]), 0))
    torch.testing.assert_close(best_first.position, two.position[[1, 0]])


@pytest.mark.parametrize("env_id", ["DoraCube-v1", "DoraJug-v1"])
def test_the_table_of_reachable_candidates_comes_along(env_id: str):
    task = make_task(env_id, 1)
    table = task.arm.reach_table
    task.close()
    assert table is not None
    assert (own_objects() / task.arm.spec.object / file_name(table.digest)).is_file()
    feasible = table.reason == 0
    print(f"{feasible.any(1).float().mean():.2f} of the starts, {feasible.sum(1).float().mean():.1f} candidates each")
    assert feasible.any(1).float().mean() > 0.95


def test_tasks_say_which_object_they_use():
    found = {name: tasks_of(load_object(name)) for name in ("cube", "hammer", "jug", "microwave")}
    assert found == {
        "cube": ["DoraCube-v1", "DoraMicrowave-v1"], "hammer": ["DoraHammer-v1"], "jug": ["DoraJug-v1"],
        "microwave": ["DoraMicrowave-v1"],
    }  # fmt: skip
    assert tasks_of(replace(load_object("jug"), mass=1.0)) == []  # another jug than the task's
    assert [name for name in found if usable_in_task(name) is not None] == ["hammer", "microwave"]


def test_ranking_needs_a_task(tmp_path: Path):
    folder = write_object_folder(load_object("cube"), tmp_path / "block").parent
    with pytest.raises(InputError, match=f"no task uses the object '{folder}'"):
        rank_bundled_set(folder, lambda title: pytest.fail(title))


def test_without_regions_each_arm_counts_by_what_it_has_done_cleanly(monkeypatch: pytest.MonkeyPatch):
    """Of three episodes the second has failed, and the third has an overlap above two thirds of the limit."""
    done = {"left": torch.tensor([True, True, True]), "right": torch.tensor([False, True, True])}
    failed, success = torch.tensor([False, True, False]), torch.zeros(3, dtype=torch.bool)
    monkeypatch.setattr(ranking, "play_out", lambda *_: (success, failed, {}))
    task = SimpleNamespace(
        reset=lambda seed: None, arms=dict.fromkeys(done), snapshot=SimpleNamespace(of=lambda arm: f"view of {arm}"),
        memory=SimpleNamespace(max_penetration=torch.tensor([0.0019, 0.0, 0.0021])),
        config=SimpleNamespace(penetration_limit=0.003),
        task=SimpleNamespace(held=lambda s, arm: done[arm] if s == f"view of {arm}" else None),
    )  # fmt: skip
    counted = unwrap(ranking._executed)(task, 0, region=False)
    assert {arm: won.tolist() for arm, won in counted.items()} == {"left": [True, False, False], "right": [False] * 3}
