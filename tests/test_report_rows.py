"""Which finished runs are seeds of one row of a report, and which are not."""

import dataclasses
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from short_runs import BASE, SMALL_PPO, run

from dora.agents.reports.comparison import sections
from dora.agents.reports.figures import COLOURS, OTHERS, _together
from dora.agents.reports.report import table_rows
from dora.agents.reports.run_results import find_runs, grouped

CONFIG = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=512, eval_every=256)


def write(folder: Path, seed: int = 10, rate: float = 0.5, episodes: int = 400, **more: Any) -> None:
    """A finished run on the cube."""
    folder.mkdir(parents=True)
    result = {
        "env": "DoraCube-v1", "agent": "ppo", "guidance": "affordance", "preset": "standard", "seed": seed,
        "env_steps": 1000, "total_steps": 1000, "wall_seconds": 60.0, "success_rate": rate, "zero_success_rate": None,
        "penetration_p95_mm": 2.0, "finished": True, "eval_episodes": episodes, "first_seed": 5,
    } | more  # fmt: skip
    (folder / "result.json").write_text(json.dumps(result))


def cells(root: Path) -> list[tuple[str, str, str]]:
    """Guidance, seeds and each seed's success of the rows."""
    return [(row[3], row[4], row[6]) for row in table_rows(find_runs(root))]


def test_trainings_with_other_settings_are_no_seeds_of_one_row(tmp_path: Path):
    """By the results that the runs write themselves."""
    for name, changes in {
        "a": {}, "b": {"seed": 1}, "c": {"after_success": 20}, "d": {"num_envs": 8}, "e": {"stop_success": 1.0},
        "f": {"stagger": False},
    }.items():  # fmt: skip
        run(tmp_path / name, dataclasses.replace(CONFIG, **changes))
    found = {guidance: seeds for guidance, seeds, _ in cells(tmp_path)}
    assert found.pop("affordance") == "2"
    assert sorted(found.values()) == ["1"] * 4
    for words in ("after_success 20", "environments 8", "stop_success 1.0", "stagger False"):
        assert sum(words in guidance for guidance in found) == 1, words


def test_a_result_that_lacks_settings_joins_what_most_have_and_hides_no_other(tmp_path: Path):
    for k, gamma in enumerate((0.97, 0.97, 0.5, None)):
        more: Any = {} if gamma is None else {"learner_config": {"gamma": gamma}}
        write(tmp_path / str(k), seed=10 + k, **more)
    assert [(guidance, seeds) for guidance, seeds, _ in cells(tmp_path)] == [
        ("affordance", "3"), ("affordance, learner.gamma 0.5", "1"),
    ]  # fmt: skip


def test_a_run_that_was_repeated_counts_once(tmp_path: Path):
    """It takes other minutes, and its last evaluation may be longer."""
    for k, (seconds, episodes, rate) in enumerate(((60.0, 200, 0.6), (70.0, 400, 0.5), (80.0, 400, 0.5))):
        more: Any = {"wall_seconds": seconds, "config_digest": "a" * 12}
        write(tmp_path / f"run{k}", episodes=episodes, rate=rate, **more)
    write(tmp_path / "other", seed=11, config_digest="b" * 12)
    assert cells(tmp_path) == [("affordance", "2", "50.0, 50.0")]
    write(tmp_path / "elsewhere", config_digest="a" * 12, first_seed=7)  # the same policy on other starts
    assert cells(tmp_path) == [("affordance", "2", "50.0, 50.0, 50.0")]


def test_a_run_that_was_repeated_on_another_machine_or_with_more_episodes_counts_once(tmp_path: Path):
    """Its digest is another one then; what tells seeds of a row from repetitions is what the row is made of."""
    known: dict[str, Any] = {"learner_config": {"gamma": 0.9}, "training_config": {"stagger": True}, "num_envs": 16}
    for k, (workers, episodes) in enumerate(((2, 200), (2, 500), (None, 100))):
        count = {"num_envs": 32} if workers is None else {}
        more: Any = known | {"workers": workers, "config_digest": f"{k}" * 12} | count
        write(tmp_path / f"run{k}", episodes=episodes, rate=0.5 + k / 100, **more)
    assert cells(tmp_path) == [("affordance", "1", "51.0")]
    write(tmp_path / "other", **known | {"workers": 2, "learner_config": {"gamma": 0.5}})
    assert sorted(seeds for _, seeds, _ in cells(tmp_path)) == ["1", "1"]


def test_evaluations_of_policies_are_told_apart_by_their_files(tmp_path: Path):
    """Not by their paths, which may be the same for several, or several for the same."""
    for k, (path, digest) in enumerate((("best", "x"), ("/a/best", "x"), ("best", "y"), ("best", "w"), ("best", "z"))):
        more: Any = {"checkpoint": path, "policy_seed": 10 + (digest == "z"), "policy_digest": digest}
        write(tmp_path / f"run{k}", config_digest="a" * 12, **more)
    assert cells(tmp_path) == [("affordance", "4", "50.0, 50.0, 50.0, 50.0")]
    (row,) = table_rows(find_runs(tmp_path))
    assert row[2] == "PPO, evaluated again"
    assert row[-1] == "-"  # minutes: nothing was trained


def test_runs_behind_links_are_found_once_and_loops_end(tmp_path: Path):
    write(tmp_path / "disk" / "one")
    (tmp_path / "runs").mkdir()
    write(tmp_path / "runs" / "two", seed=11)
    (tmp_path / "runs" / "linked").symlink_to(tmp_path / "disk")
    (tmp_path / "runs" / "again").symlink_to(tmp_path / "disk" / "one")
    (tmp_path / "runs" / "loop").symlink_to(tmp_path / "runs")
    assert cells(tmp_path / "runs") == [("affordance", "2", "50.0, 50.0")]


def test_curves_of_runs_that_were_evaluated_at_other_steps_are_compared_at_the_same_ones():
    """Two runs on one straight line, every 50 and every 100 steps; the second was good enough early."""
    fine, coarse = [(float(x), x / 500) for x in range(50, 301, 50)], [(100.0, 0.2), (200.0, 0.4)]
    at, values = _together([fine, coarse])
    assert at.tolist() == [100, 150, 200, 250, 300]
    np.testing.assert_allclose(values[0], at / 500)
    np.testing.assert_allclose(values[1], [0.2, 0.3, 0.4, 0.4, 0.4])


def test_no_two_lines_of_a_stored_figure_have_the_same_colour():
    runs = find_runs(Path(__file__).parents[1] / "results" / "tasks")
    figures = Counter(group[:2] for group in grouped(runs) if group[2:4] not in COLOURS)
    assert max(figures.values()) <= len(set(OTHERS) - set(COLOURS.values()))


@pytest.mark.parametrize("steps", [1000, 600_000])
def test_the_table_beside_the_paper_says_what_its_runs_are(tmp_path: Path, steps: int):
    write(tmp_path / "a", total_steps=steps, task_config={"hand_action": "fingers", "optimised": False},
          learner_config={"minibatch": 64})  # fmt: skip
    write(tmp_path / "b", guidance="none", total_steps=steps, overlap_share=0.04, learner_config={"minibatch": 64})
    named = {section.title: section.rows for section in sections(find_runs(tmp_path))}
    success = {tuple(row[:3]): row[4] for row in named["Overall success beside the paper's tables II and IV"]}
    budget = f"{steps / 1000:.0f}k"
    assert success["DoraCube-v1", "PPO", "affordance"] == f"{budget}, one number a finger, grasp made by hand"
    assert success["DoraCube-v1", "PPO", "none"] == f"{budget}, overlap eased"
    differences = {row[0]: row[2] for row in named["How the set-ups differ"]}
    assert differences["training"] == f"{steps:,} steps, minibatches of 64 (PPO)"
    assert differences["evaluation"].startswith("400 starts")
