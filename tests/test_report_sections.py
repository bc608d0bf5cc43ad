"""Sections of a report against figures worked out by hand, from runs that are made up without files."""

from typing import Any

import numpy as np
import pytest
from made_runs import made, of, rows

from dora.agents.reports.comparison import of_the_paper
from dora.agents.reports.failures import failure_kinds
from dora.agents.reports.figures import draw_overlap
from dora.agents.reports.paper import PAPER
from dora.agents.reports.section import with_interval

# -------------------------------------------------------------- beside the paper


def test_the_present_rules_come_before_many_runs_and_these_before_few():
    old = [made(seed=seed, outdated=True) for seed in range(3)]
    few, many = (
        [made(task_config={"optimised": False})],
        [made(task_config={"optimised": True}, seed=k) for k in (1, 2)],
    )
    cell = ("DoraJug-v1", "PPO", "affordance")
    assert of_the_paper([*old, *few]) == {cell: few}
    assert of_the_paper([*few, *old]) == {cell: few}
    assert of_the_paper([*few, *many]) == of_the_paper([*many, *few]) == {cell: many}


def test_without_guided_runs_the_largest_budget_stands_beside_the_paper():
    small, large = made("none", total_steps=20_000), made("none", total_steps=3_000_000)
    assert of_the_paper([small, large]) == of_the_paper([large, small]) == {("DoraJug-v1", "PPO", "none"): [large]}


@pytest.mark.parametrize(
    ("more", "shown"),
    [
        ({}, "3000k"),
        ({"task_config": None}, "3000k"),
        ({"task_config": {"optimised": True, "tilted": True, "lift": 3}}, "3000k, grasps of the search"),
        ({"task_config": {"optimised": 1.0}}, "3000k"),
        ({"task_config": {"optimised": True}, "guidance": "none"}, "3000k"),
        ({"outdated": True}, "3000k, earlier rules"),
    ],
)
def test_a_cell_names_its_budget_and_the_switches_of_its_candidates(more: dict[str, Any], shown: str):
    found = rows([made(**more, total_steps=3_000_000)], "Overall success")
    assert [row[4] for row in found if row[3] == "1"] == [shown]
    assert [row[3:7] for row in found if row[3] != "1"] == [["0", "-", "-", "-"]] * (len(PAPER) - 1)


def test_shares_and_their_intervals_are_percentages():
    assert with_interval(0.5, (0.25, 0.75)) == "50.0 [25.0, 75.0]"
    assert with_interval(-0.125, (-0.5, 0.25), sign=True) == "-12.5 [-50.0, +25.0]"


def test_success_has_an_interval_where_the_episodes_are_there_and_overlap_is_told_where_all_know_it():
    runs = [made(rate=rate, raw_success_rate=raw, seed=seed) for rate, raw, seed in ((0.5, 0.75, 1), (1.0, 0.5, 2))]
    assert [row[5:7] for row in rows(runs, "Overall success") if row[3] == "2"] == [["75.0", "62.5"]]
    partly = [runs[0], made(rate=1.0, seed=3)]
    assert [row[5:7] for row in rows(partly, "Overall success") if row[3] == "2"] == [["75.0", "-"]]
    whole = [made(rate=1.0, episodes=of(1, 1, 1, 1))]
    assert [row[5] for row in rows(whole, "Overall success") if row[3] == "1"] == ["100.0 [51.0, 100.0]"]


def test_minutes_stand_beside_those_that_the_paper_gives():
    runs = [made(wall_seconds=seconds, other_load=0.0) for seconds in (600.0, 1200.0)]
    assert rows(runs, "Minutes") == [["DoraJug-v1", "PPO", "affordance", "15.0", "118.7"]]
    assert rows([made(env="DoraMicrowave-v1", agent="happo")], "Minutes") == []


def test_gains_need_both_and_their_means_over_training_every_curve():
    curve = [{"env_steps": 500.0, "wall_seconds": 60.0, "success_rate": 0.5}]
    guided = [made(rate=0.8, steps_to_80=steps, curve=curve) for steps in (2_500_000, 1_500_000, None)]
    plain = [made("none", 0.3, curve=[curve[0] | {"success_rate": 0.25}])]
    title = "What guidance gains"
    steps = ["2000k (2 of 3)", "never (0 of 1)"]
    assert rows([*guided, *plain], title) == [["DoraJug-v1", "PPO", "+50.0", "+27.7", "+25.0", *steps]]
    assert rows([*guided, made("none", 0.3)], title) == [["DoraJug-v1", "PPO", "+50.0", "+27.7", "-", steps[0], "-"]]
    assert rows(guided, title) == rows(plain, title) == []
    assert rows([guided[0], made("none", agent="sac")], title) == []


@pytest.mark.parametrize(("seeds", "shown"), [((1, 2), ["2"]), ((1,), []), ((), [])])
def test_means_over_tasks_are_of_two_seeds_that_all_tasks_have(seeds: tuple[int, ...], shown: list[str]):
    pytest.importorskip("rliable.library")
    rates = {"DoraCube-v1": 0.5, "DoraJug-v1": 0.25, "DoraHammer-v1": 0.75}
    runs = [made(rate=rate, env=env, seed=seed) for env, rate in rates.items() for seed in seeds]
    runs += [made(env="DoraCube-v1", seed=7), made(env="DoraJug-v1", seed=8)]
    found = rows(runs, "Over tasks")
    assert [row[:2] for row in found] == [["PPO, affordance", count] for count in shown]
    assert [row[2:] for row in found] == [["50.0 [50.0, 50.0]", "50.0 [50.0, 50.0]"] for _ in shown]


# ------------------------------------------------------------------ of all tasks


@pytest.mark.parametrize(
    ("more", "shown"),
    [
        ({"episodes": of(1, 0, 1, 0), "zero": of(1, 0, 1, 0)}, "+0.0 ["),
        ({"episodes": of(1, 1, 1, 1), "zero": of(0, 0, 0, 0)}, "+100.0 [+100.0, +100.0]"),
        ({"episodes": of(1, 0, 1, 0)}, "+25.0"),  # the rates alone are known of one of both
        ({"zero": of(1, 0, 0, 0)}, "+25.0"),
        ({}, "+25.0"),
        ({"episodes": of(1, 0, 1, 0), "zero": of(1, 0)}, "+25.0"),  # not the same starts
    ],
)
def test_learned_less_zero_correction_is_paired_where_both_have_the_same_episodes(more: dict[str, Any], shown: str):
    ((*_, found),) = rows([made(zero_success_rate=0.25, **more)], "Learned less zero")
    assert found.startswith(shown)
    assert ("[" in found) == ("[" in shown)
    assert rows([made(**{name: value for name, value in more.items() if name != "zero"})], "Learned less zero") == []


def test_stages_are_told_that_all_runs_know():
    runs = [made(stage_rates={"grasp": 0.75, "lift": 0.5, "turn": 0.1}), made(stage_rates={"grasp": 0.5, "lift": 0.0})]
    assert [row[4] for row in rows(runs, "Sub-tasks")] == ["grasp 62.5, lift 25.0"]
    assert rows([made(), made(stage_rates={"grasp": 0.5})], "Sub-tasks") == []


def test_overlap_is_told_by_its_quantiles_over_all_episodes():
    parts = np.split(np.arange(202.0), 2)
    runs = [made(episodes=of(*part) | {"penetration_mm": part}) for part in (parts[0][::-1], parts[1])]
    runs.append(made(episodes=of(1, 0)))
    assert [row[4:] for row in rows(runs, "Largest overlap")] == [["202", "100.5", "180.9", "190.9", "199.0", "201.0"]]
    assert rows(runs[2:], "Largest overlap") == []


def test_failures_are_shares_of_all_episodes_and_the_most_frequent_comes_first():
    tables = [
        {"success": np.array([1.0, 0, 0, 0]), "stage/reach": np.array([1.0, 0, 1, 0]), "unreachable": np.zeros(4)},
        {"success": np.array([0.0, 0, 1, 1]), "stage/reach": np.array([0.0, 0, 1, 1]),
         "unreachable": np.array([0.0, 2, 0, 0])},
    ]  # fmt: skip
    kinds = failure_kinds(tables)
    assert list(kinds.items()) == [("reach not done", 3 / 8), ("lost again at the end", 1 / 8),
                                   ("no grasp within reach", 1 / 8)]  # fmt: skip
    runs = [made(episodes=table) for table in tables]
    text = "reach not done 37.5, lost again at the end 12.5, no grasp within reach 12.5"
    assert [row[4] for row in rows([*runs, made()], "Why episodes fail")] == [text]
    assert [row[4] for row in rows([made(episodes=of(1, 1))], "Why episodes fail")] == ["none"]
    assert rows([made()], "Why episodes fail") == []


def test_the_figure_of_overlap_has_zero_correction_once_for_the_learners_that_share_it(monkeypatch: pytest.MonkeyPatch):
    from matplotlib import pyplot

    figures: list[Any] = []
    monkeypatch.setattr(pyplot, "close", figures.append)
    shared, other = {"penetration_mm": np.array([3.0, 1.0, 2.0])}, {"penetration_mm": np.array([7.0, 6.0])}
    learned = {"penetration_mm": np.array([0.5, 4.0])}
    runs = [
        made(agent="ppo", episodes=learned, zero=shared),
        made(agent="sac", episodes=learned, zero=shared),
        made("grasps", agent="sac", episodes=learned, zero=other),
        made(agent="sac", env="DoraCube-v1", episodes=learned, zero={"penetration_mm": np.array([9.0])}),
    ]
    assert draw_overlap(runs, "DoraJug-v1", "standard").startswith(b"\x89PNG")
    (figure,) = figures
    dotted = {
        line.get_label(): line.get_xdata().tolist() for line in figure.axes[0].lines if line.get_linestyle() == ":"
    }
    assert sorted(dotted.values()) == [[1.0, 2.0, 3.0], [6.0, 7.0]]
    assert [name.split(", guidance ")[0] for name in dotted] == ["PPO", "SAC"]
    assert all(name.endswith(", zero correction") for name in dotted)
    assert len(figure.axes[0].lines) == 5
