"""A report compares what can be compared: the same task, the same starts, enough seeds, the rules of now."""

from typing import Any

import numpy as np
import pytest
from made_runs import made, of, rows
from matplotlib.axes import Axes

from dora.agents.reports.comparison import of_the_paper
from dora.agents.reports.run_results import Run, _with_zero
from dora.agents.reports.starts import draw_starts

JUG = "DoraJug-v1"
SUCCESS, CLAIMS, BEST, GAINS = "Overall success", "The paper's claims", "Both learners", "What guidance gains"
ON_THE_JUG = "affordance gains on the jug with PPO"


def seeds(count: int = 3, **more: Any) -> list[Run]:
    """Runs of several seeds, all of whose 20 episodes succeed where nothing else is said."""
    episodes = more.pop("episodes", of(*[1.0] * 20))
    known: dict[str, Any] = {"eval_episodes": 20, "episodes": episodes, "rate": float(episodes["success"].mean())}
    settings: dict[str, Any] = known | more
    return [made(**settings, seed=10 + k) for k in range(count)]


# ------------------------------------------------------------------ the same task


def test_no_verdict_is_given_over_tasks_with_other_numbers():
    numbers = [{"task_config": {"limit": limit, "optimised": limit == 1}} for limit in (1, 2)]
    ours, other = numbers[0], numbers[1]
    mixed = [*seeds(3, agent="ppo", **ours), *seeds(3, agent="sac", **other)]
    (verdict,) = (row[-1] for row in rows(mixed, BEST) if row[0] == JUG)
    assert verdict == "cannot be said: runs of DoraJug-v1 have other numbers of the task"
    guided, plain = seeds(3, **ours), seeds(3, guidance="none", episodes=of(*[0.0] * 20), **other)
    (verdict,) = (row[-1] for row in rows([*guided, *plain], CLAIMS) if row[0] == ON_THE_JUG)
    assert verdict.startswith("cannot be said")
    assert rows([*guided, *plain], GAINS)[0][2] == "the tasks have other numbers"
    same = seeds(guidance="none", episodes=of(*[0.0] * 20), task_config={"limit": 1, "optimised": False, "more": 3})
    (verdict,) = (row[-1] for row in rows([*guided, *same], CLAIMS) if row[0] == ON_THE_JUG)
    assert verdict == "reproduced"  # what chooses candidates may differ, and what one side does not say
    assert rows([*guided, *same], GAINS)[0][2] == "+100.0"


def test_a_cell_of_the_papers_tables_says_in_what_its_task_differs_from_that_of_the_others():
    numbers = {"ppo": 1, "sac": 2}
    runs = [run for agent, limit in numbers.items() for run in seeds(agent=agent, task_config={"limit": limit})]
    runs += seeds(guidance="none", agent="sac", task_config={"limit": 1})
    shown = {tuple(row[1:3]): row[4] for row in rows(runs, SUCCESS) if row[3] != "0"}
    assert shown == {("PPO", "affordance"): "1k", ("SAC", "affordance"): "1k, limit 2", ("SAC", "none"): "1k"}


@pytest.mark.parametrize(
    ("others", "budget"),
    [
        (seeds(1, total_steps=600_000, outdated=True), 300_000),
        (seeds(3, total_steps=600_000, outdated=True), 300_000),
        (seeds(2, total_steps=600_000), 300_000),
        (seeds(3, guidance="none", total_steps=600_000), 300_000),
        (seeds(3, total_steps=600_000), 600_000),
    ],
    ids=["earlier rules", "many of earlier rules", "few seeds", "unguided", "more steps"],
)
def test_the_budget_of_a_task_is_that_of_its_present_runs(others: list[Run], budget: int):
    cells = of_the_paper([*seeds(3, total_steps=300_000), *others])
    assert {run.budget for run in cells[JUG, "PPO", "affordance"]} == {budget}


def test_rates_are_over_the_episodes_of_all_runs():
    """Of 10 episodes one, of 90 none: .01 and not .05."""
    known = (10, 0.1), (90, 0.0)
    runs = [
        made(rate=rate, raw_success_rate=rate, stage_rates={"lift": rate}, eval_episodes=count, seed=count)
        for count, rate in known
    ]
    assert rows(runs, "Sub-tasks")[0][-1] == "lift 1.0"
    assert [row[5:7] for row in rows(runs, SUCCESS) if row[3] == "2"] == [["1.0", "1.0"]]


# ------------------------------------------------------------------ zero correction on the same starts


def test_zero_correction_comes_from_the_evaluation_that_has_its_episodes():
    learned = made(agent="sac", rate=0.5, episodes=of(1, 0, 1, 0))
    whole = made(agent="ppo", rate=0.5, episodes=of(1, 1, 0, 0), zero=of(1, 0, 0, 0), zero_success_rate=0.25)
    share = made(agent="ppo", seed=11, rate=0.5, zero_success_rate=0.25)
    for runs in ([learned, whole, share], [share, learned, whole]):
        found = {run.result["agent"]: run for run in _with_zero(runs)}
        assert list(found["sac"].zero["success"]) == [1, 0, 0, 0]
    alone = made(agent="zero", rate=0.25, episodes=of(1, 0, 0, 0), zero_success_rate=0.25)
    filled = _with_zero([learned, alone])
    assert list(filled[0].zero["success"]) == [1, 0, 0, 0]
    assert [row[2] for row in rows(filled, "Learned less zero")] == ["SAC"]  # not of itself


def test_a_seed_on_other_starts_is_left_out_of_the_difference_where_their_zero_correction_is_unknown():
    here = made(rate=0.75, zero_success_rate=0.25, eval_episodes=10)
    there = made(rate=0.05, seed=11, first_seed=6, eval_episodes=10)
    assert rows([here, there], "Learned less zero")[0][-2:] == ["1", "+50.0"]
    also = made(rate=0.5, seed=12, first_seed=7, eval_episodes=30, zero_success_rate=0.5)
    assert rows([here, there, also], "Learned less zero")[0][-2:] == ["2", "+12.5"]  # weighted by episodes


# ------------------------------------------------------------------ the figure of starts


def test_a_learner_has_one_colour_in_all_pictures_of_starts_and_zero_correction_is_drawn_once(
    monkeypatch: pytest.MonkeyPatch,
):
    def table(**columns: list[float]) -> dict[str, np.ndarray]:
        return {f"start/{name}": np.array(values, float) for name, values in columns.items()} | of(1, 0, 1, 0)

    drawn: list[tuple[str, Any]] = []
    monkeypatch.setattr(
        Axes, "errorbar", lambda axis, *_, label, color, **__: drawn.append((label, color)) or axis.plot([0], [0])[0]
    )
    zero = table(size=[1, 2, 3, 4], mass=[4, 3, 2, 1])
    runs = [
        made(agent="a", episodes=table(size=[1, 1, 1, 1], mass=[1, 2, 3, 4]), zero=zero),  # size tells nothing
        made(agent="b", episodes=table(size=[1, 2, 3, 4], mass=[1, 2, 3, 4]), zero=zero),
    ]
    assert draw_starts(runs, JUG, "standard").startswith(b"\x89PNG")
    first, second = ("A, guidance affordance (1)", "B, guidance affordance (1)")
    colours = {label: {color for name, color in drawn if name == label} for label, _ in drawn}
    assert set(colours) == {first, second, f"{first}, zero correction"}
    assert colours[first] == colours[f"{first}, zero correction"]
    assert all(len(own) == 1 for own in colours.values())
    assert colours[first] != colours[second]
