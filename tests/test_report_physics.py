"""A report tells what trained policies do under other physics, beside the runs that trained them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import made_runs
import numpy as np
import pytest
from made_runs import of

from dora.agents.reports.physics import apart, physics_section
from dora.agents.reports.report import write_report
from dora.agents.reports.run_results import Run, find_runs
from dora.agents.runs.stored_results import with_digests
from dora.files import write_csv, write_json

TASK = {"definition": 1, "lift": 0.1, "physics_frequency": 100, "solver_iterations": 6, "persistent_contacts": True}
LEARNER = {"gamma": 0.97}


def made(folder: str, task: dict[str, Any] | None = None, won: str = "1100", **more: Any) -> Run:
    """A run whose episodes end as the digits say, with an overlap of .1 mm times the episode's number plus 1."""
    episodes = of(*map(float, won)) | {"penetration_mm": np.arange(1.0, len(won) + 1) / 10}
    numbers = {"task_config": TASK | (task or {}), "learner_config": LEARNER, "eval_episodes": len(won)}
    rate = float(episodes["success"].mean())
    return replace(
        made_runs.made(rate=rate, episodes=episodes, **numbers | {"agent": "sac"} | more), folder=Path(folder)
    )


def again(folder: str, task: dict[str, Any], won: str = "1000", **more: Any) -> Run:
    return made(folder, task, won, checkpoint="runs/policy.safetensors", **more)


def cells(*runs: Run) -> list[list[str]]:
    others, checks = apart(runs)
    return physics_section(others, checks).rows


FINER = {"physics_frequency": 200}


def test_an_evaluation_stands_beside_the_run_that_trained_its_policy():
    runs = made("a", zero_success_rate=0.25), again("b", FINER, zero_success_rate=0.5)
    (row,) = cells(*runs)
    assert row[:8] == ["DoraJug-v1", "standard", "SAC", "affordance", "1", "physics_frequency 200 Hz (100)", "50.0",
                       "25.0"]  # fmt: skip
    assert row[8].startswith("-25.0 [-75.0, ")
    assert row[9:] == ["0.4", "0.4", "25.0", "50.0"]
    assert apart(runs)[0] == [runs[0]]


def test_seeds_make_one_row_and_each_physics_its_own():
    trained = [made(f"t{seed}", won="1111", seed=seed) for seed in (10, 11)]
    finer = [again(f"f{seed}", FINER, "1110", seed=seed) for seed in (10, 11)]
    anew = again("n", {"persistent_contacts": False, "solver_iterations": 8}, "0011", seed=11)
    found = cells(*finer, *trained, anew)
    assert [(row[4], row[5], row[7]) for row in found] == [
        ("2", "physics_frequency 200 Hz (100)", "75.0"),
        ("1", "solver_iterations 8 (6), persistent_contacts False (True)", "50.0"),
    ]
    assert [row[6] for row in found] == ["100.0", "100.0"]
    assert found[0][8] == "-25.0 [-75.0, +0.0]"


def test_of_several_runs_the_one_with_the_policys_settings_is_taken():
    others = [made("o1", {"lift": 0.2}), made("o2", learner_config={"gamma": 0.9}), made("o3", seed=11),
              made("o4", agent="ppo"), made("o5", guidance="grasps"), made("o6", reward="paper"),
              made("o7", preset="hard"), made("o8", total_steps=9000)]  # fmt: skip
    evaluation = again("b", FINER)
    assert cells(*others, evaluation) == []
    assert apart([*others, evaluation])[0] == [*others, evaluation]
    (row,) = cells(*others, made("a", won="1111"), evaluation)
    assert row[6] == "100.0"
    (old,) = (made("a", learner_config=None, won="1111"),)
    assert cells(*others, old, evaluation)[0][6] == "100.0"


@pytest.mark.parametrize(
    "other",
    [
        again("b", {}),
        again("b", {"definition": 2, "physics_frequency": 200}),
        again("b", FINER, seed=11),
        again("b", FINER, policy_seed=11),
        made("b", FINER),
        again("b", FINER, task_config=None),
    ],
    ids=["same physics", "other rules", "other seed", "other policy", "a training", "unknown"],
)
def test_what_is_no_such_evaluation_stays_a_row_of_its_own(other: Run):
    runs = [made("a"), other]
    assert apart(runs) == (runs, [])


def test_other_starts_are_no_pairs():
    trained = made("a", won="1111")
    assert cells(trained, again("b", FINER, "1000", first_seed=6, policy_seed=10))[0][8] == "-75.0"
    assert cells(made("a", won="1000"), again("b", FINER, "11"))[0][6:9] == ["25.0", "100.0", "+50.0 [+0.0, +100.0]"]
    assert cells(trained, again("b", FINER, "1111"))[0][8] == "+0.0 [+0.0, +0.0]"


def test_the_run_that_trained_a_policy_is_told_by_its_file_else_by_its_seed():
    """The seed of an evaluation is that of its starts, if one was given."""
    trained = [
        made(f"t{seed}", won=won, seed=seed, policy_digest=f"of {seed}") for seed, won in ((10, "1111"), (11, "1000"))
    ]
    of_ten: dict[str, Any] = {"policy_seed": 10, "seed": 11, "first_seed": 6}
    assert cells(*trained, again("b", FINER, "1000", **of_ten, policy_digest="of 10"))[0][6] == "100.0"
    assert cells(*trained, again("b", FINER, "1000", **of_ten))[0][6] == "100.0"
    assert cells(*trained, again("b", FINER, "1000", **of_ten, policy_digest="of another run of seed 10")) == []
    assert cells(*trained, again("b", FINER, seed=11, first_seed=6)) == []  # of an earlier version: either seed


def test_environments_of_an_evaluation_and_numbers_that_one_side_lacks_do_not_matter():
    trained, evaluation = made("a", num_envs=16, workers=2), again("b", FINER, num_envs=16, workers=8)
    assert cells(trained, evaluation)[0][5] == "physics_frequency 200 Hz (100)"
    del trained.result["task_config"]["persistent_contacts"]
    assert cells(trained, evaluation)[0][5] == "physics_frequency 200 Hz (100)"


def test_a_report_of_two_folders_has_the_section_and_no_row_of_the_evaluations(tmp_path: Path):
    for root, run in (("runs", made("a")), ("other", again("b", FINER))):
        folder = tmp_path / root / "one"
        folder.mkdir(parents=True)
        lines = [[k, won] for k, won in enumerate(run.episodes["success"])]
        write_csv(folder / "eval.csv", ["episode", "success"], lines)
        write_json(folder / "result.json", with_digests(run.result | {"finished": True}, folder))
    roots = [tmp_path / "runs", tmp_path / "other"]
    assert len(find_runs([*roots, tmp_path])) == 2
    table, compared, page, *_ = write_report(roots, tmp_path / "out")
    assert len(table.read_text().split("\n\n")[0].splitlines()) == 3
    assert "evaluated again" not in compared.read_text()
    assert "| physics\\_frequency 200 Hz (100) | 50.0 | 25.0 |" in compared.read_text()
    assert "Trained policies under other physics" in page.read_text()
    assert "Runs in runs and other" in page.read_text()
