"""Sweeps: which runs, and which are finished already."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fake_run import fake_words
from fake_sweep import few, nothing, result, states

from dora.affordance.bundled_sets import bundled_path
from dora.commands import run
from dora.errors import InputError
from dora.sweeps.board import duration, summary
from dora.sweeps.launching import LocalLauncher, resuming
from dora.sweeps.plan import MECHANISM, Row, rows_of
from dora.sweeps.sweep import State, Sweep
from dora.tasks import find_task

# ------------------------------------------------------------------- the plan


def test_the_papers_tables_and_the_ladder_are_planned():
    rows = rows_of("paper")
    parts = {title: sum(row.title == title for row in rows) for title in {row.title for row in rows}}
    assert parts == {"Table II": 36, "Table IV": 12, "ladder": 18}
    assert len({row.name for row in rows}) == len({row.config.digest() for row in rows}) == 66
    assert [row.config.seed for row in rows] == sorted(row.config.seed for row in rows)
    assert {row.config.guidance_parts for row in rows} == {None, MECHANISM}
    assert all(row.config.final_episodes == 500 for row in rows)
    for row in rows:
        for arm in find_task(row.config.env).ARMS.values():
            assert bundled_path(arm.object, region=row.config.guidance != "grasps").exists(), row.name


@pytest.mark.parametrize("index", [0, 9, 13, 19])
def test_the_settings_of_a_row_are_those_of_the_command(index: int):
    row = rows_of("paper")[index]
    c = row.config
    words = ["--env", c.env, "--agent", c.agent, "--guidance", c.guidance, "--seed", str(c.seed), "--episodes", "500",
             "--workers", "2", "--total-steps", str(c.total_steps)]  # fmt: skip
    words += ["--guidance-parts", *c.guidance_parts] if c.guidance_parts else []
    assert run.parse(words).run == c


def test_only_some_rows_may_be_asked_for():
    rows = rows_of("paper", envs=["DoraMicrowave-v1"], agents=["happo"], guidance=["none"], seeds=[7], total_steps=9)
    assert [(row.config.env, row.config.seed, row.config.total_steps) for row in rows] == [("DoraMicrowave-v1", 7, 9)]
    with pytest.raises(InputError, match="--agent 'ddpg' is not in the sweep paper: there are happo, mappo, ppo, sac"):
        rows_of("paper", agents=["ddpg"])
    with pytest.raises(InputError, match="fits all of"):
        rows_of("paper", envs=["DoraCube-v1"], agents=["happo"])


def test_kinds_of_guidance_are_asked_for_by_the_names_of_the_table():
    rows = rows_of("paper", envs=["DoraCube-v1"], guidance=["affordance observation reward filter", "grasps"])
    assert [row.name.name for row in rows[:2]] == ["sac-grasps-s10", "sac-affordance-observation-reward-filter-s10"]
    assert [row.config.seed for row in rows] == [10, 10, 11, 11, 12, 12]
    (quick,) = rows_of("quick", envs=["DoraCube-v1"], guidance=["none"])
    assert (quick.config.seed, quick.config.total_steps, quick.config.final_episodes) == (10, 20_000, 50)
    (shorter,) = rows_of("quick", envs=["DoraCube-v1"], guidance=["none"], episodes=7)
    assert shorter.config.final_episodes == 7
    with pytest.raises(InputError, match="There is no sweep 'papers': use one of paper, quick"):
        rows_of("papers")


def test_zero_correction_is_the_same_for_any_learner_and_seed_in_the_same_task():
    (row,) = few(1)

    def same(**change: Any) -> bool:
        return row.same_zero(Row("another part", replace(row.config, **change)))

    assert same()
    assert same(agent="sac", seed=7, total_steps=9)
    others: list[dict[str, Any]] = [
        {"env": "DoraJug-v1"}, {"preset": "hard"}, {"guidance": "grasps"}, {"guidance_parts": MECHANISM},
        {"final_episodes": 7}, {"task": row.config.task | {"lift": 0.3}},
    ]  # fmt: skip
    assert [change for change in others if same(**change)] == []


# -------------------------------------------------------- what is finished already


def test_a_finished_run_counts_whichever_command_made_it(tmp_path: Path):
    rows = few(4)
    result(rows[0], tmp_path / "known" / "any" / "name")
    result(rows[1], tmp_path / "known" / "short", total_steps=rows[1].config.total_steps - 1)
    result(rows[2], tmp_path / "known" / "half", finished=False)
    result(rows[3], tmp_path / "known" / "judged-again", checkpoint="somewhere")
    sweep = Sweep(rows, tmp_path / "out", [tmp_path / "known"])
    assert states(sweep) == [State.DONE, State.WAITING, State.WAITING, State.WAITING]
    assert (sweep.entries[0].success_rate, sweep.entries[0].seconds) == (0.75, 600.0)
    assert not (tmp_path / "out").exists()


def test_zero_correction_is_evaluated_once_for_all_seeds_and_learners(tmp_path: Path):
    rows = rows_of("paper", envs=["DoraCube-v1"], seeds=[10, 11])
    asked: dict[Path, bool] = {}

    class Noting(LocalLauncher):
        def start(self, row: Row, folder: Path, zero: bool) -> None:
            asked[row.name] = zero
            if zero and row.config.has_prior:
                (folder / "zero.csv").touch()
            super().start(row, folder, zero)

    sweep = Sweep(rows, tmp_path / "out", [])
    sweep.run(Noting(lambda folder, zero: fake_words(folder, "well")), nothing, nothing)
    assert set(states(sweep)) == {State.DONE}
    guided = [row for row in rows if row.config.has_prior]
    assert [row.name.name for row in guided if asked[row.name]] == ["ppo-affordance-s10", "sac-grasps-s10"]
    assert len(guided) == 6
    assert resuming(tmp_path, zero=False) == [*resuming(tmp_path), "--no-zero-correction"]


def test_a_run_that_leaves_zero_correction_out_does_not_count_for_another_one(tmp_path: Path):
    """The first run evaluates it, and fails; while it is repeated, the second one is trained without."""
    rows = rows_of("paper", envs=["DoraCube-v1"], agents=["ppo"], guidance=["affordance"], seeds=[10, 11])
    asked: list[tuple[int, bool]] = []

    class Noting(LocalLauncher):
        def start(self, row: Row, folder: Path, zero: bool) -> None:
            asked.append((row.config.seed, zero))
            super().start(row, folder, zero)

    modes = {10: "fails-once", 11: "slow"}
    by_seed = {str(tmp_path / row.name): modes[row.config.seed] for row in rows}
    sweep = Sweep(rows, tmp_path, jobs=2)
    sweep.run(Noting(lambda folder, zero: fake_words(folder, by_seed[str(folder)])), nothing, nothing)
    assert asked == [(10, True), (11, False), (10, True)]


def test_a_run_that_was_good_enough_early_shows_the_steps_that_it_took(tmp_path: Path):
    (row,) = few(1)
    result(row, tmp_path / "known" / "early", env_steps=1234)
    (entry,) = Sweep([row], tmp_path / "out", [tmp_path / "known"]).entries
    assert (entry.state, entry.env_steps, entry.seconds_left) == (State.DONE, 1234, 0.0)


def test_time_that_is_left_is_that_of_runs_of_the_same_kind(tmp_path: Path):
    rows = few(3)
    result(rows[0], tmp_path / "known" / "one")  # ten minutes
    sweep = Sweep(rows, tmp_path / "out", [tmp_path / "known"])
    assert sweep.seconds_left == pytest.approx(1200)
    sweep.jobs = 2
    assert sweep.seconds_left == pytest.approx(600)
    assert summary(sweep) == "1 of 3 runs done, 0 running, 2 waiting; about 10 min left"
    assert duration(3 * 3600.0) == "3.0 h"


def test_a_damaged_result_is_named(tmp_path: Path):
    result(few(1)[0], tmp_path / "known" / "one", success_rate="high")
    with pytest.raises(InputError, match=r"known/one/result\.json is damaged"):
        Sweep(few(1), tmp_path / "out", [tmp_path / "known"])
