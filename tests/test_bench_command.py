"""What `dora bench` prints of a measurement: a table, or with --json one object on the last line."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from commands import call

from dora.affordance.reach.approach_paths import OK
from dora.commands import bench
from dora.errors import InputError
from dora.parallel import available_cores
from dora.policies.policy import load_policy
from dora.tools.filter_benchmark import Outcomes
from dora.tools.physics_benchmark import Physics, PhysicsRow


@dataclass(frozen=True)
class Speed:
    """A measurement."""

    steps_per_second: float = 1234.5
    note: str = "[idle]"


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """What the measurements are asked for, none of which is made."""
    asked: list[tuple[Any, ...]] = []

    def noted(*given: Any) -> Speed:
        asked.append(given)
        return Speed()

    for module in (bench.benchmark, bench.grasp_benchmark, bench.learner_benchmark, bench.page_rate):
        monkeypatch.setattr(module, "measure", noted)
    monkeypatch.setattr(bench, "profile_training", noted)
    monkeypatch.setattr(bench.play, "find_players", lambda args: [args])
    return asked


@pytest.mark.parametrize("words", ["env", "grasp", "learner --env DoraCube-v1", "page", "training"])
def test_a_measurement_is_printed_as_a_table_or_as_an_object(
    words: str, asked: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert call(bench, monkeypatch, *words.split()) == 0
    table = [[cell.strip() for cell in line.split("│")[1:-1]] for line in capsys.readouterr().out.splitlines()]
    assert [row for row in table if row] == [["steps_per_second", "1234.5"], ["note", "[idle]"]]
    assert call(bench, monkeypatch, *words.split(), "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"steps_per_second": 1234.5, "note": "[idle]"}
    assert len(asked) == 2


def test_a_training_is_profiled_with_the_recommended_settings(asked: list[Any]):
    bench.bench_training("DoraHammer-v1", None, 60_000, json=True)
    bench.bench_training("DoraHammer-v1", "ppo", json=True)
    ((config, make_tasks, _, steps, cores), (other, *_)) = asked
    assert (config.env, config.agent, other.agent, steps) == ("DoraHammer-v1", "sac", "ppo", 60_000)
    assert cores == config.workers == available_cores()
    assert make_tasks.args == ("DoraHammer-v1",)
    assert make_tasks.keywords == config.task_options


def test_a_learner_is_measured_with_the_sizes_of_the_task(asked: list[Any]):
    """Its networks are those that a policy of the task has."""
    bench.bench_learner("DoraCube-v1", "ppo", bench.LONGEST, json=True)
    ((config, observation, action, seconds),) = asked
    policy = load_policy("DoraCube-v1")
    assert (observation, action, seconds) == (policy.observation_size, policy.action_size, bench.LONGEST)
    assert (config.env, config.agent) == ("DoraCube-v1", "ppo")
    for wrong in (0.0, 2 * bench.LONGEST):
        with pytest.raises(InputError, match="give a time above 0 and up to 86400 seconds"):
            bench.bench_learner("DoraCube-v1", "ppo", wrong)


@pytest.mark.parametrize("zero", [False, True])
def test_the_zero_action_acts_on_the_page_if_that_is_asked_for(
    zero: bool, asked: list[Any], monkeypatch: pytest.MonkeyPatch
):
    threads = []
    monkeypatch.setattr(bench.torch, "set_num_threads", threads.append)
    assert (
        call(bench, monkeypatch, "page", "DoraJug-v1", "--seconds", "3", *(["--zero-correction"] if zero else [])) == 0
    )
    ((env, (args,), seconds, preset),) = asked
    assert (env, args.env, args.zero_correction, seconds, preset) == ("DoraJug-v1", "DoraJug-v1", zero, 3.0, "standard")
    assert threads == [1]


@pytest.fixture
def filtered(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, Any]]:
    """Calls `dora bench filter` without episodes; returns by the choice of candidates what was asked for."""
    found = Outcomes(torch.tensor([OK, OK + 1]), torch.tensor([True, False]))
    monkeypatch.setattr(bench, "load_policy", lambda env: SimpleNamespace(env=env))

    def called(*words: str) -> dict[str, Any]:
        asked: dict[str, Any] = {}

        def noted(env: str, episodes: int, preset: str, choice: str, act: Any) -> Outcomes:
            asked[choice] = env, episodes, preset, act and act.env
            return found

        monkeypatch.setattr(bench, "outcomes", noted)
        assert call(bench, monkeypatch, "filter", *words) == 0
        return asked

    return called


def test_the_zero_action_acts_for_the_filter_unless_the_policy_is_asked_for(
    filtered: Callable[..., dict[str, Any]], capsys: pytest.CaptureFixture[str]
):
    assert filtered() == {choice: ("DoraJug-v1", 1000, "standard", None) for choice in ("nearest", "random")}
    printed = capsys.readouterr().out
    assert "DoraJug-v1, standard, random candidates:" in printed
    assert printed.endswith("failed: 0.000 of the accepted, 1.000 of the rejected\n")
    most = str(bench.MOST_EPISODES)
    asked = filtered("DoraCube-v1", "--episodes", most, "--preset", "hard", "--policy", "--json")
    assert asked["random"] == ("DoraCube-v1", bench.MOST_EPISODES, "hard", "DoraCube-v1")
    summary = {"accepted": 1, "rejected": 1, "accepted_failed": 0.0, "rejected_failed": 1.0}
    assert json.loads(capsys.readouterr().out) == {
        "env": "DoraCube-v1", "preset": "hard", "policy": True, "nearest": summary, "random": summary
    }  # fmt: skip


def test_settings_of_physics_are_rows_of_a_table_or_of_an_object(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("COLUMNS", "250")
    asked = []

    def noted(env: str, settings: list[Physics], starts: int, preset: str, progress: Any) -> list[PhysicsRow]:
        asked.append((env, settings, starts, preset))
        progress(len(settings), len(settings))
        return [PhysicsRow(physics, 0.75, 3.5, 0.25, 1.5, 0.0, 812.34567) for physics in settings]

    monkeypatch.setattr(bench.task_physics, "measure_physics", noted)
    assert call(bench, monkeypatch, "physics", "--settings", "240:10:8", "120:2:4", "--starts", "5") == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if "│" in line]
    assert rows == [
        ["240", "8", "1", "0.01", "0.75", "3.5", "0.25", "1.5", "0", "812.3"],
        ["120", "4", "1", "0.002", "0.75", "3.5", "0.25", "1.5", "0", "812.3"],
    ]
    assert call(bench, monkeypatch, "physics", "--settings", "240:10:8", "--json") == 0
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    rows = printed.pop("rows")
    assert printed == {"env": "DoraHammer-v1", "starts": 64, "preset": "none"}
    assert rows == [
        {"rate": 240.0, "position_iterations": 8, "velocity_iterations": 1, "contact_offset": 0.01, "success": 0.75,
         "stages": 3.5,
         "overlap_median_mm": 0.25, "overlap_p95_mm": 1.5, "tunnelled": 0.0, "microseconds": 812.34567}
    ]  # fmt: skip
    assert [(env, len(settings), starts, preset) for env, settings, starts, preset in asked] == [
        ("DoraHammer-v1", 2, 5, "none"), ("DoraHammer-v1", 1, 64, "none")
    ]  # fmt: skip
