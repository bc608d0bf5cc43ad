"""Rates, their errors and verdicts about the paper's claims, worked out by hand; which runs are compared."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from made_runs import made, of, rows

from dora.agents.reports.claims import Rates, above_the_best, claims
from dora.agents.reports.paper import BETTER, ONE_ARM, PAPER, Cell
from dora.agents.reports.report import file_name, pooled, table_rows
from dora.agents.reports.run_results import Run, grouped, shared_mark, zero_shares
from dora.agents.reports.section import error_of, outcomes_of, rate_of
from dora.agents.reports.starts import bins, has_starts, joined, starts_section
from dora.agents.reports.statistics import crossed_interval, mean_of_curve, paired_difference

CUBE, JUG = ("DoraCube-v1", "PPO", "affordance"), ("DoraJug-v1", "PPO", "affordance")
WORDS = ("above", "below")


def seeds_of(rate: float, count: int = 3, episodes: Any = None, **more: Any) -> list[Run]:
    """Runs of so many seeds with the same rate."""
    own = {} if episodes is None else {"episodes": episodes}
    return [made(rate=rate, seed=seed, **own, **more) for seed in range(count)]


# --------------------------------------------------------------- rates and errors


def test_a_rate_is_that_of_all_episodes_where_their_numbers_are_known():
    runs = [made(rate=0.5, eval_episodes=100), made(rate=1.0, eval_episodes=300)]
    assert rate_of(runs) == pytest.approx(87.5)
    unknown = made(rate=1.0)
    del unknown.result["eval_episodes"]
    assert rate_of([runs[0], unknown]) == pytest.approx(75.0)
    assert pooled([(0.5, 100), (1.0, 0)]) == "75.0"
    assert pooled([]) == "-"


def test_outcomes_are_those_of_all_seeds_on_the_same_starts():
    first, other = of(1, 0, 1), of(0, 0, 1)
    found = outcomes_of([first, other], [5, 5])
    assert found is not None
    assert found.tolist() == [[1, 0, 1], [0, 0, 1]]
    assert outcomes_of([], []) is None
    for tables, starts in (
        ([first, {}], [5, 5]),
        ([{}], [5]),
        ([first, of(1, 0)], [5, 5]),
        ([first, other], [5, 6]),
        ([first, {}, of(1, 0)], [5, 5, 6]),
    ):
        assert outcomes_of(tables, starts) is None


def test_the_standard_error_is_that_of_a_normal_distribution_with_the_interval():
    """Of 100 starts of which half succeed, about 100 sqrt(0.5 * 0.5 / 100) = 5 points."""
    half = of(*[1.0, 0.0] * 50)
    (run,) = runs = seeds_of(0.5, 1, half)
    low, high = crossed_interval(half["success"][None])
    assert error_of(runs) == pytest.approx(100 * (high - low) / 3.92)
    assert error_of(runs) == pytest.approx(5.0, rel=0.1)
    assert error_of([run, made()]) == float("inf")


def test_the_interval_of_one_seed_is_over_its_starts_and_of_equal_outcomes_wilsons():
    assert crossed_interval(np.zeros((2, 4))) == pytest.approx((0.0, 0.4899), abs=1e-4)
    assert crossed_interval(np.ones((2, 4))) == pytest.approx((0.5101, 1.0), abs=1e-4)
    wide, narrow = (crossed_interval(np.tile([[1.0, 0.0]], (1, n))) for n in (8, 200))
    assert wide[1] - wide[0] == pytest.approx(5 * (narrow[1] - narrow[0]), rel=0.15)


def test_a_difference_counts_the_seeds_of_both_sides():
    ours, theirs = np.array([[1.0, 1, 0, 1], [1, 0, 0, 1]]), np.array([[0.0, 1, 0, 0]])
    difference, (low, high) = paired_difference(ours, theirs)
    assert difference == pytest.approx(5 / 8 - 1 / 4)
    assert -1.0 <= low < difference < high <= 1.0
    assert paired_difference(ours, ours[:1])[0] == pytest.approx(-1 / 8)


def test_the_mean_of_a_curve_lasts_to_its_last_evaluation_and_needs_a_budget():
    curve = [{"env_steps": 200.0, "success_rate": 0.5}, {"env_steps": 400.0, "success_rate": 1.0}]
    assert mean_of_curve(curve, 300) == mean_of_curve(curve, 1) == pytest.approx(0.625)
    assert mean_of_curve(curve, 0) is None


# ---------------------------------------------------------------------- verdicts


def test_errors_of_cells_add_up_as_those_of_independent_sums():
    episodes = of(*[1.0, 0.0] * 8)
    rates = Rates({CUBE: seeds_of(0.5, 3, episodes), JUG: seeds_of(0.25, 1, of(1, 0, 0, 0))})
    assert (rates.rate(CUBE), rates.rate(JUG), rates.rate(("x", "y", "z"))) == (50.0, 25.0, 0.0)
    one, other = rates.error([CUBE]), rates.error([JUG])
    assert one == pytest.approx(error_of(rates.cells[CUBE]))
    assert rates.error([CUBE, JUG]) == pytest.approx(np.hypot(one, other))
    assert rates.error([("x", "y", "z")]) == 0.0


@pytest.mark.parametrize(
    ("margin", "error", "verdict"),
    [
        (2.0, 1.0, "above"), (-2.0, 1.0, "below"), (1.9, 1.0, "undecided"), (-1.9, 1.0, "undecided"),
        (0.0, 0.0, "undecided"), (9.0, float("inf"), "undecided"), (9.0, float("nan"), "undecided"),
    ],
)  # fmt: skip
def test_a_verdict_needs_196_standard_errors(margin: float, error: float, verdict: str):
    rates = Rates({CUBE: seeds_of(0.5), JUG: seeds_of(0.5)})
    assert rates.verdict([CUBE, JUG], margin, error, WORDS) == verdict
    assert rates.row(["a", "b"], [CUBE], "ours", margin, error, WORDS) == ["a", "b", "ours", verdict]


def test_a_verdict_needs_three_seeds_of_every_cell():
    few = Rates({CUBE: seeds_of(0.5), JUG: [*seeds_of(0.5, 2), made(seed=1)]})
    assert few.verdict([CUBE, JUG], 9.0, 1.0, WORDS) == "too few runs: 2 of 3 seeds"
    assert few.verdict([CUBE], 9.0, 1.0, WORDS) == "above"
    other: Cell = ("DoraHammer-v1", "SAC", "none")
    assert few.verdict([CUBE, other], 9.0, 1.0, WORDS) is None
    missing = few.row(["a"], [CUBE, other, JUG], "ours", 9.0, 1.0, WORDS)
    assert missing == ["a", "-", "runs are missing: DoraHammer-v1 SAC none"]


def cells_of(rates: dict[Cell, float]) -> dict[Cell, list[Run]]:
    """Three seeds of each cell, all of whose episodes end alike where the rate is 0 or 1; else without episodes."""
    found = {}
    for (env, agent, guidance), rate in rates.items():
        episodes = of(*[rate] * 400) if rate in (0, 1) else of(*[float(k % 400 < 400 * rate) for k in range(400)])
        found[env, agent, guidance] = seeds_of(
            rate, 3, episodes, env=env, agent=agent.lower(), guidance=guidance, eval_episodes=400
        )
    return found


def test_gains_are_those_of_all_learners_and_of_the_jug():
    rates = {cell: 0.75 if cell[2] == "affordance" else 0.5 for cell in PAPER if cell[0] in ONE_ARM}
    rates["DoraJug-v1", "PPO", "none"] = 0.25
    average, jug, _ = claims(cells_of(rates)).rows
    assert average[1:3] == ["+15.4", f"{(5 * 25 + 50) / 6:+.1f}"]
    assert average[3] == "reproduced"  # 13.8 points above, with errors of 2.5 points in each cell
    assert jug[1:] == ["+27.7", "+50.0", "reproduced"]
    close = cells_of({JUG: 0.75, (*JUG[:2], "none"): 0.5})
    assert claims(close).rows[1][2:] == ["+25.0", "undecided"]


@pytest.mark.parametrize(
    ("ahead", "verdict"),
    [
        ({"DoraCube-v1": (1.0, 0.0), "DoraJug-v1": (1.0, 0.0), "DoraHammer-v1": (1.0, 0.0)}, "reproduced"),
        ({"DoraCube-v1": (1.0, 0.0), "DoraJug-v1": (0.53, 0.5), "DoraHammer-v1": (1.0, 0.0)}, "undecided"),
        ({"DoraCube-v1": (1.0, 0.0), "DoraJug-v1": (1.0, 0.0), "DoraHammer-v1": (0.0, 1.0)}, "not reproduced"),
    ],
)
def test_the_order_of_learners_is_judged_where_it_is_least_sure(ahead: dict[str, tuple[float, float]], verdict: str):
    rates = {}
    for env, (better, worse) in ahead.items():
        for agent in ("PPO", "SAC"):
            rates[env, agent, "affordance"] = better if agent == BETTER[env] else worse
    (*_, row) = claims(cells_of(rates)).rows
    shown = ", ".join(f"{env}: {BETTER[env]} {100 * (a - b):+.1f}" for env, (a, b) in ahead.items())
    assert row[1:] == ["yes", shown, verdict]


def test_the_worse_learner_is_set_beside_the_papers_better_one():
    rates: dict[Cell, float] = {("DoraCube-v1", "PPO", "affordance"): 1.0, ("DoraCube-v1", "SAC", "affordance"): 0.5}
    found = {row[0]: row[1:] for row in above_the_best(cells_of(rates)).rows}
    assert found["DoraCube-v1"] == ["73.2 (PPO)", "50.0", "no"]
    assert found["DoraMicrowave-v1"][0] == "68.1 (HAPPO)"
    rates["DoraCube-v1", "SAC", "affordance"] = 1.0
    assert above_the_best(cells_of(rates)).rows[0][2:] == ["100.0", "yes"]


# ------------------------------------------------------------ which runs are alike


def test_a_row_names_the_thousands_of_its_steps_and_the_deviation_of_its_minutes():
    runs = [made(total_steps=3_000_000, wall_seconds=60.0 * k, other_load=0.0, seed=k) for k in (1, 3)]
    (row,) = table_rows(runs)
    assert (row[9], row[10]) == ("3000k", "2.0 ± 1.4")
    assert table_rows(runs[:1])[0][10] == "1.0"


def test_learners_tell_runs_apart_and_one_that_does_not_say_how_it_learned_is_as_most_are():
    """Results of earlier versions do not."""
    settings = [made(learner_config={"gamma": gamma}, seed=k) for k, gamma in enumerate((0.9, 0.9, 0.5))]
    assert [key[3] for key in grouped(settings)] == ["affordance", "affordance, learner.gamma 0.5"]
    for unknown in (made(), made(learner_config=None)):
        rows = grouped([*settings, unknown])
        assert {key[3]: len(runs) for key, runs in rows.items()} == {
            "affordance": 3, "affordance, learner.gamma 0.5": 1,
        }  # fmt: skip


@pytest.mark.parametrize("turned", [False, True])
def test_of_the_same_starts_the_longest_evaluation_of_zero_correction_counts(turned: bool):
    runs = [made(zero_success_rate=rate, eval_episodes=count) for rate, count in ((0.5, 100), (0.25, 200), (None, 300))]
    assert zero_shares(runs[::-1] if turned else runs) == [(0.25, 200)]
    same = [made(zero_success_rate=rate) for rate in (0.5, 0.25)]
    assert zero_shares(same) == [(0.25, 4)]  # the later one


@pytest.mark.parametrize(
    ("loads", "mark"), [([0.1], ""), ([0.1, 0.11], " †"), ([None, 0.5], " †"), ([None, 0.0], " ?"), ([0.0, 0.0], "")]
)
def test_one_run_beside_other_programs_marks_the_minutes_of_its_row(loads: Sequence[float | None], mark: str):
    assert shared_mark([made(other_load=load) for load in loads]) == mark


def test_names_of_files_are_cut_only_where_they_are_too_long():
    assert file_name("a/b" + "x" * 175) == "a%2Fb" + "x" * 175  # 180 characters
    cut = file_name("a" * 181)
    assert cut[:181] == "a" * 180 + "-"
    assert len(cut) == 189


# ------------------------------------------------------------------------- starts


def test_quarters_need_four_episodes_and_a_number_that_is_not_the_same_in_all():
    four = of(1, 0, 0, 1)["success"]
    assert bins({"success": four, "start/e": np.array([4.0, 2, 3, 1])}, "start/e") == [
        (1, 1, 1, 1), (2, 2, 1, 0), (3, 3, 1, 0), (4, 4, 1, 1)
    ]  # fmt: skip
    assert bins({"success": four[:3], "start/e": np.array([4.0, 2, 3])}, "start/e") == []
    assert bins({"success": four, "start/e": 1000 + np.array([0, 0, 0, 5e-4])}, "start/e") == []  # of single precision
    assert len(bins({"success": four, "start/e": -1 + np.array([0, 0, 0, 5e-4])}, "start/e")) == 4


def test_columns_that_all_tables_have_are_joined_and_tables_without_starts_left_out():
    tables = [
        of(1, 0) | {"start/e": np.array([1.0, 2.0]), "start/f": np.zeros(2)},
        of(1, 1),
        of(0) | {"start/e": np.array([3.0])},
    ]
    found = joined(tables)
    assert {name: values.tolist() for name, values in found.items()} == {"success": [1, 0, 0], "start/e": [1, 2, 3]}
    assert joined([of(1, 1)]) == joined([]) == {}


def test_success_in_quarters_is_that_of_a_row_of_the_table():
    episodes = of(1, 1, 1, 0, 0, 0, 0, 0) | {"start/size": np.arange(8.0)}
    nothing = of(*[0] * 8) | {"start/size": np.arange(8.0)}  # left out: there is nothing to tell
    runs = [made(episodes=episodes), made(episodes=of(1), seed=11), made("none", episodes=nothing)]
    (row,) = starts_section(runs).rows
    assert row[:5] == ["DoraJug-v1", "standard", "PPO", "affordance", "size"]
    assert row[5:] == ["100.0 (0 to 1)", "50.0 (2 to 3)", "0.0 (4 to 5)", "0.0 (6 to 7)"]
    assert has_starts(runs, "DoraJug-v1", "standard")
    assert not has_starts(runs, "DoraJug-v1", "hard")
    assert not has_starts(runs, "DoraCube-v1", "standard")
    assert not has_starts(runs[1:2], "DoraJug-v1", "standard")
    assert rows(runs, "Success against") == []  # it stands with the figures, see `write_report`
