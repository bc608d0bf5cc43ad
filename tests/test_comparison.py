"""What a report says beside its main table: intervals, differences, failures, and the paper's numbers and claims."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dora.agents.reports import statistics
from dora.agents.reports.comparison import Section, of_the_paper, sections
from dora.agents.reports.failures import failure_kinds, first_causes
from dora.agents.reports.paper import BETTER, MEAN_GAIN, ONE_ARM, PAPER
from dora.agents.reports.report import write_report
from dora.agents.reports.run_results import find_runs
from dora.agents.reports.statistics import aggregates, crossed_interval, mean_of_curve, paired_difference

EPISODES = 400
"""Of an evaluation."""


def write_run(
    folder: Path,
    env: str,
    agent: str,
    guidance: str,
    success: float,
    seed: int = 10,
    zero: float | None = None,
    episodes: bool = True,
    **more: object,
) -> None:
    """A finished run of which so large a share of episodes succeeded, the first ones; of the others half overlapped."""
    folder.mkdir(parents=True)
    hits = round(success * EPISODES)
    result = {
        "env": env, "agent": agent, "guidance": guidance, "preset": "standard", "seed": seed, "env_steps": 1000,
        "total_steps": 1000, "wall_seconds": 600.0, "success_rate": hits / EPISODES, "zero_success_rate": zero,
        "raw_success_rate": 1.0, "penetration_p95_mm": 2.0, "finished": True, "eval_episodes": EPISODES,
        "first_seed": 5, "stage_rates": {"grasp": 0.9, "lift": success}, "steps_to_80": 500 if success >= 0.8 else None,
    } | more  # fmt: skip
    (folder / "result.json").write_text(json.dumps(result))
    head = "env_steps,wall_seconds,success_rate,return_mean,penetration_p95_mm"
    (folder / "curve.csv").write_text(f"{head}\n500,45,{success},3,2\n")
    if episodes:
        write_episodes(folder / "eval.csv", hits)
        if zero is not None:
            write_episodes(folder / "zero.csv", round(zero * EPISODES))


def write_episodes(path: Path, hits: int) -> None:
    rows = [
        f"{k},{int(k < hits)},{int(k < hits or k % 2)},1,{int(k < hits or k % 2)},{k / 10}" for k in range(EPISODES)
    ]
    path.write_text("\n".join(["episode,success,raw_success,stage/grasp,stage/lift,penetration_mm", *rows, ""]))


def whole(root: Path, gain: float = 0.2, seeds: Sequence[int] = (10, 11, 12), episodes: bool = True) -> Path:
    """Three runs of each cell of the paper's tables; guidance gains so much."""
    for (env, agent, guidance), printed in PAPER.items():
        guided = guidance == "affordance"
        base = printed.success / 100 if guided else PAPER[env, agent, "affordance"].success / 100 - gain
        for seed in seeds:
            share = min(base + 0.1, 1.0)
            name = f"{agent}-{guidance}-{seed}"
            write_run(root / env / name, env, agent.lower(), guidance, share, seed, episodes=episodes)
    return root


def table(root: Path, title: str) -> list[list[str]]:
    (found,) = [section for section in sections(find_runs(root)) if section.title.startswith(title)]
    return found.rows


# ---------------------------------------------------------------- statistics


def test_an_interval_over_seeds_and_starts_is_wider_than_one_over_episodes():
    """Seeds that differ, and starts that are hard for all, are fewer than their episodes."""
    outcomes = np.zeros((3, 100))
    outcomes[:, :50], outcomes[0] = 1.0, 1.0
    low, high = crossed_interval(outcomes)
    assert low < outcomes.mean() < high
    naive = 1.96 * np.sqrt(outcomes.mean() * (1 - outcomes.mean()) / outcomes.size)
    assert high - low > 3 * naive
    assert crossed_interval(np.ones((2, 50))) == pytest.approx((0.929, 1.0), abs=1e-3)  # 50 of 50 starts
    assert crossed_interval(np.zeros((3, 50))) == pytest.approx((0.0, 0.071), abs=1e-3)


def test_intervals_are_the_same_whatever_is_held_at_once(monkeypatch: pytest.MonkeyPatch):
    generator = np.random.default_rng(3)
    ours, theirs = (generator.random((3, 400)) < 0.9).astype(float), (generator.random((1, 400)) < 0.7).astype(float)
    found = []
    for most in (statistics.BLOCK, 5000, 1):
        monkeypatch.setattr(statistics, "BLOCK", most)
        found.append((crossed_interval(ours), paired_difference(ours, theirs)))
    assert found[0] == found[1] == found[2]
    draws = np.random.default_rng(statistics.SEED)
    means = [
        ours[draws.integers(3, size=3)][:, draws.integers(400, size=400)].mean() for _ in range(statistics.SAMPLES)
    ]
    assert found[0][0] == pytest.approx(np.percentile(means, statistics.PERCENTILES), abs=1e-12)


def test_differences_on_the_same_starts_have_a_narrow_interval():
    """Where every start but five goes alike, the difference is those five, however the starts differ."""
    ours = np.tile(np.arange(200) % 2, (1, 1)).astype(float)
    theirs = ours.copy()
    theirs[:, 1:11:2] = 0.0
    difference, (low, high) = paired_difference(ours, theirs)
    assert difference == pytest.approx(5 / 200)
    assert 0 < low < difference < high < 0.06


def test_the_mean_of_a_curve_holds_its_ends():
    curve = [{"env_steps": 200.0, "success_rate": 0.5}, {"env_steps": 400.0, "success_rate": 1.0}]
    assert mean_of_curve(curve, 1000) == pytest.approx((200 * 0.5 + 200 * 0.75 + 600 * 1.0) / 1000)
    assert mean_of_curve(curve, 400) == pytest.approx((200 * 0.5 + 200 * 0.75) / 400)
    assert mean_of_curve([], 400) is None


def test_the_interquartile_mean_leaves_out_the_extremes():
    pytest.importorskip("rliable.library")
    scores = {"a": np.array([[0.0, 0.5, 0.5, 0.6], [0.5, 0.5, 0.5, 0.5]])}
    found = aggregates(scores)
    assert found is not None
    (mean, around), (middle, _) = found["a"]
    assert (mean, middle) == pytest.approx((0.45, 0.5))
    assert around[0] < 0.5 < around[1]


def test_intervals_over_tasks_are_the_same_each_time_and_leave_other_draws_alone():
    pytest.importorskip("rliable.library")
    scores = {"a": np.random.default_rng(0).uniform(size=(3, 4))}
    np.random.seed(5)  # noqa: NPY002
    expected = np.random.uniform()  # noqa: NPY002
    np.random.seed(5)  # noqa: NPY002
    found = aggregates(scores)
    assert np.random.uniform() == expected  # noqa: NPY002
    assert aggregates(scores) == found


def test_without_rliable_a_report_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def missing(name: str) -> object:
        raise ImportError(name)

    monkeypatch.setattr(statistics.importlib, "import_module", missing)
    whole(tmp_path)
    assert table(tmp_path, "Over tasks") == [["needs rliable: pip install rliable 'pandas<3'"]]


# ------------------------------------------------------------------- sections


def test_failures_are_counted_once_by_the_first_reason():
    columns = {
        "success": [1, 0, 0, 0, 0, 0], "raw_success": [1, 1, 0, 0, 0, 0], "nonfinite": [0, 0, 1, 0, 0, 0],
        "unreachable": [0, 0, 0, 1, 0, 0], "stage/grasp": [1, 1, 0, 0, 0, 1], "stage/lift": [1, 1, 0, 0, 0, 1],
    }  # fmt: skip
    kinds = failure_kinds([{name: np.array(values, float) for name, values in columns.items()}])
    assert kinds == pytest.approx({
        "the simulation was not finite": 1 / 6, "no grasp within reach": 1 / 6, "too much overlap": 1 / 6,
        "grasp not done": 1 / 6, "lost again at the end": 1 / 6,
    })  # fmt: skip


def test_with_the_longest_episode_a_loss_is_told_from_want_of_time():
    done = {
        "success": 0,
        "raw_success": 0,
        "nonfinite": 0,
        "unreachable": 0,
        "stage/reach": 1,
        "stage/lift": 1,
        "length": 100,
    }
    rows = [
        {"success": 1, "raw_success": 1},
        {"raw_success": 1},
        {"raw_success": 1, "length": 50},
        {"stage/lift": 0},
        {"stage/lift": 0, "length": 50},
        {"stage/reach": 0, "stage/lift": 0},
        {"stage/reach": 0, "stage/lift": 0, "nonfinite": 1, "length": 9},
        {"stage/reach": 0, "stage/lift": 0, "unreachable": 1, "length": 1},
        {"length": 90},
    ]
    table = {name: np.array([(done | row)[name] for row in rows], float) for name in done}
    assert first_causes(table, 100) == {
        "the simulation was not finite": 1, "no grasp within reach": 1, "too much overlap": 2,
        "object lost before lift": 1, "lift not done in time": 1, "reach not done in time": 1,
        "lost again at the end": 1,
    }  # fmt: skip


def test_ours_stand_beside_the_papers_numbers(tmp_path: Path):
    write_run(tmp_path / "a", "DoraCube-v1", "ppo", "affordance", 0.9)
    rows = table(tmp_path, "Overall success")
    assert len(rows) == len(PAPER)
    (own,) = [row for row in rows if row[3] == "1"]
    assert own[:3] == ["DoraCube-v1", "PPO", "affordance"]
    assert own[4] == "1k"
    assert own[5].startswith("90.0 [")
    assert own[6:] == ["100.0", "73.2 ± 1.1"]
    assert table(tmp_path, "Minutes") == [["DoraCube-v1", "PPO", "affordance", "10.0 ?", "115.8"]]


@pytest.mark.parametrize("other", [{"preset": "hard"}, {"reward": "paper"}, {"checkpoint": "x"}])
def test_other_runs_are_not_compared_with_the_paper(tmp_path: Path, other: Any):
    write_run(tmp_path / "a", "DoraCube-v1", "ppo", "affordance", 0.9, **other)
    assert of_the_paper(find_runs(tmp_path)) == {}


def test_the_printed_mean_gain_is_that_of_the_printed_table():
    gains = [
        PAPER[env, agent, "affordance"].success - PAPER[env, agent, "none"].success
        for env in ONE_ARM
        for agent in ("PPO", "SAC")
    ]
    assert np.mean(gains) == pytest.approx(MEAN_GAIN, abs=0.05)


def test_claims_are_judged_when_all_their_runs_are_there(tmp_path: Path):
    write_run(tmp_path / "a", "DoraCube-v1", "ppo", "affordance", 0.9)
    verdicts = [row[-1] for row in table(tmp_path, "The paper's claims")]
    assert all(verdict.startswith("runs are missing: ") for verdict in verdicts)
    few = [row[-1] for row in table(whole(tmp_path / "few", gain=0.2, seeds=(10,)), "The paper's claims")]
    assert set(few) == {"too few runs: 1 of 3 seeds"}
    whole(tmp_path / "close", gain=0.17)
    close = {row[0]: row[2:] for row in table(tmp_path / "close", "The paper's claims")}
    assert close["affordance gains on average over tasks 1 to 3 and both learners"][1] == "undecided"
    whole(tmp_path / "all", gain=0.2)
    found = {section.title: section.rows for section in sections(find_runs(tmp_path / "all"))}
    claims = {row[0]: row[2:] for row in found["The paper's claims"]}
    assert claims["affordance gains on average over tasks 1 to 3 and both learners"][1] == "reproduced"
    assert claims["affordance gains on the jug with PPO"][1] == "not reproduced"
    above = {row[0]: row[1:] for row in found["Both learners with affordance beside the paper's best"]}
    assert above["DoraHammer-v1"] == ["75.1 (SAC)", above["DoraHammer-v1"][1], "yes"]
    assert above["DoraJug-v1"][-1] == "undecided"  # 68 of 65.6 %
    assert above["DoraMicrowave-v1"][-1] == "undecided"


def test_without_episodes_no_claim_is_decided(tmp_path: Path):
    """How far seeds and starts carry is not known from rates alone."""
    whole(tmp_path, gain=0.2, episodes=False)
    assert {row[-1] for row in table(tmp_path, "The paper's claims")} == {"undecided"}


@pytest.mark.parametrize(
    ("better", "worse", "verdict"), [(0.9, 0.5, "reproduced"), (0.9, 0.89, "undecided"), (0.5, 0.9, "not reproduced")]
)
def test_the_order_of_learners_needs_more_than_their_errors(tmp_path: Path, better: float, worse: float, verdict: str):
    for env, best in BETTER.items():
        for agent in ("PPO", "SAC"):
            for seed in (10, 11, 12):
                share = better if agent == best else worse
                write_run(tmp_path / f"{env}-{agent}-{seed}", env, agent.lower(), "affordance", share, seed)
    claims = {row[0]: row[2:] for row in table(tmp_path, "The paper's claims")}
    assert claims["PPO is better on cube and jug, SAC on the hammer"][1] == verdict


def test_what_guidance_gains_is_told_three_ways(tmp_path: Path):
    write_run(tmp_path / "a", "DoraJug-v1", "ppo", "affordance", 0.9)
    write_run(tmp_path / "b", "DoraJug-v1", "ppo", "none", 0.4)
    assert table(tmp_path, "What guidance gains") == [
        ["DoraJug-v1", "PPO", "+50.0", "+27.7", "+50.0", "0k (1 of 1)", "never (0 of 1)"]
    ]


def test_differences_to_zero_correction_are_paired_where_the_episodes_are_there(tmp_path: Path):
    write_run(tmp_path / "a", "DoraJug-v1", "ppo", "affordance", 0.9, zero=0.5)
    write_run(tmp_path / "b", "DoraCube-v1", "ppo", "affordance", 0.9, zero=0.5, episodes=False)
    cube, jug = (row[-1] for row in table(tmp_path, "Learned less zero correction"))
    assert cube == "+40.0"
    assert jug.startswith("+40.0 [+3")


def test_stages_are_means_over_the_seeds_that_tell_them(tmp_path: Path):
    for seed, success in ((10, 0.9), (11, 0.7)):
        write_run(tmp_path / str(seed), "DoraJug-v1", "ppo", "affordance", success, seed)
    write_run(tmp_path / "none", "DoraCube-v1", "ppo", "affordance", 0.9, stage_rates={})
    (row,) = table(tmp_path, "Sub-tasks")
    assert row[-1] == "grasp 90.0, lift 80.0"


def test_cells_beside_the_paper_have_the_same_and_the_largest_budget(tmp_path: Path):
    write_run(tmp_path / "a", "DoraJug-v1", "sac", "affordance", 0.9, total_steps=300_000)
    write_run(tmp_path / "b", "DoraJug-v1", "sac", "affordance", 0.1, total_steps=20_000)
    write_run(tmp_path / "c", "DoraJug-v1", "sac", "none", 0.2, total_steps=20_000)
    write_run(tmp_path / "d", "DoraJug-v1", "ppo", "none", 0.3, total_steps=3_000_000)  # to see what that many do
    runs = of_the_paper(find_runs(tmp_path))
    assert {cell: [run.folder.name for run in some] for cell, some in runs.items()} == {
        ("DoraJug-v1", "SAC", "affordance"): ["a"]
    }


def test_a_copy_of_a_run_counts_once_and_learners_share_zero_correction(tmp_path: Path):
    write_run(tmp_path / "a", "DoraMicrowave-v1", "happo", "affordance", 0.9, zero=0.5)
    shutil.copytree(tmp_path / "a", tmp_path / "copy")
    write_run(tmp_path / "b", "DoraMicrowave-v1", "mappo", "affordance", 0.7)
    write_run(tmp_path / "c", "DoraMicrowave-v1", "mappo", "affordance", 0.7, seed=11, task_config={"lift": 1})
    runs = find_runs(tmp_path)
    assert [run.result["zero_success_rate"] for run in runs] == [0.5, 0.5, None]
    rows = table(tmp_path, "Learned less zero correction")
    assert [row[-1].split()[0] for row in rows] == ["+40.0", "+20.0"]


def test_runs_whose_learners_have_other_settings_have_rows_of_their_own(tmp_path: Path):
    for seed, prior in ((10, 0.05), (11, 0.01)):
        settings = {"prior": prior, "gamma": 0.97}
        write_run(tmp_path / str(seed), "DoraJug-v1", "sac", "affordance", 0.9, seed, learner_config=settings)
    rows = table(tmp_path, "Sub-tasks")
    assert [row[3] for row in rows] == ["affordance, learner.prior 0.01", "affordance, learner.prior 0.05"]


def test_zero_correction_of_one_run_is_that_of_all_seeds(tmp_path: Path):
    write_run(tmp_path / "a", "DoraJug-v1", "ppo", "affordance", 0.9, seed=10)
    write_run(tmp_path / "b", "DoraJug-v1", "ppo", "affordance", 0.7, seed=11, zero=0.5)
    ((*_, seeds, text),) = table(tmp_path, "Learned less zero correction")
    assert seeds == "2"
    assert text.startswith("+30.0 [+")


def test_a_page_needs_no_other_file(tmp_path: Path):
    write_run(tmp_path / "a", "DoraJug-v1", "ppo", "affordance", 0.9, zero=0.5)
    written = write_report(tmp_path, tmp_path / "out")
    assert [path.name for path in written] == [
        "tables.md", "comparison.md", "report.html", "DoraJug-v1.png", "DoraJug-v1-overlap.png",
    ]  # fmt: skip
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count('src="data:image/png;base64,') == 2
    assert "src=" not in page.replace('src="data:', "")
    text = (tmp_path / "out" / "comparison.md").read_text()
    assert all(f"## {section.title}" in text for section in sections(find_runs(tmp_path)))
    assert isinstance(sections(find_runs(tmp_path))[0], Section)
