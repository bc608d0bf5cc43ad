"""Policies of stored results are evaluated again: whether they have the stored episodes."""

import dataclasses
import re
import shutil
from pathlib import Path

import pytest
import torch

from dora.agents.config import RunConfig
from dora.agents.runs.agreement import agreement
from dora.commands import run

RESULTS = Path(__file__).parents[1] / "results"
ROW = RESULTS / "tasks" / "DoraJug-v1" / "sac-affordance-s10"
STARTS = 50
"""Episodes that are evaluated again: as many as final evaluations run together, for products depend on that."""
RUNS = (
    "tasks/DoraCube-v1/sac-affordance-s10", "tasks/DoraJug-v1/sac-affordance-hard-s11",
    "tasks/DoraHammer-v1/sac-affordance-s12", "tasks/DoraMicrowave-v1/mappo-affordance-s10",
    "unguided/DoraCube-v1/ppo-none-s10",
)  # fmt: skip
"""One of each task, and one without guidance."""
MADE_WITH = "AVX512"
"""Instructions of the processor on which the stored results were made; others round other digits."""


@pytest.fixture
def row(tmp_path: Path) -> tuple[Path, Path, RunConfig, int]:
    """A stored result, the table of an evaluation of its first ten starts, the settings and the seed of that."""
    folder = tmp_path / "row"
    shutil.copytree(ROW, folder)
    table = tmp_path / "eval.csv"
    table.write_text("".join((folder / "eval.csv").read_text().splitlines(keepends=True)[:11]))
    args = run.parse(["--eval-only", "--checkpoint", str(folder), "--episodes", "10"])
    return folder, table, args.run, args.first_seed


def test_the_same_episodes_are_found_to_be_the_same(row: tuple[Path, Path, RunConfig, int]):
    folder, table, config, seed = row
    said = agreement(folder / "policy.safetensors", table, config, seed)
    assert said == f"10 of 10 episodes are those of {folder}, to the last digit."


def test_a_digit_and_an_end_that_differ_are_counted(row: tuple[Path, Path, RunConfig, int]):
    folder, table, config, seed = row
    lines = table.read_text().splitlines()
    names = lines[0].split(",")
    for line, name in ((3, "return"), (5, "success")):
        cells = lines[line].split(",")
        cells[names.index(name)] = str(1.0 - float(cells[names.index(name)]))
        lines[line] = ",".join(cells)
    table.write_text("\n".join(lines) + "\n")
    said = agreement(folder / "policy.safetensors", table, config, seed) or ""
    assert said.startswith(f"8 of 10 episodes are those of {folder}, to the last digit, 9 end alike: ")


def test_nothing_is_said_of_other_starts_or_settings(row: tuple[Path, Path, RunConfig, int], tmp_path: Path):
    folder, table, config, seed = row
    policy, other = folder / "policy.safetensors", dataclasses.replace(config, preset="hard")
    assert agreement(policy, table, config, seed + 1) is None
    assert agreement(policy, table, other, seed) is None
    assert agreement(folder / "checkpoints" / "best.safetensors", table, config, seed)
    assert agreement(folder / "checkpoints" / "latest.safetensors", table, config, seed) is None
    (folder / "eval.csv").unlink()
    assert agreement(policy, table, config, seed) is None


def test_damaged_figures_beside_a_policy_are_told_and_end_nothing(row: tuple[Path, Path, RunConfig, int]):
    folder, table, config, seed = row
    path = folder / "result.json"
    path.write_text(path.read_text().replace('"success_rate": 0.', '"success_rate": 0.1'))
    said = agreement(folder / "policy.safetensors", table, config, seed) or ""
    assert said.startswith(f"Not compared with the run of its policy: {path} is damaged")


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_stored_run_is_evaluated_again_as_it_was(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """To the last digit where the processor computes as that of the stored results did."""
    words = ["run", "--eval-only", "--checkpoint", str(RESULTS / name), "--episodes", str(STARTS)]
    monkeypatch.setattr("sys.argv", [*words, "--out", str(tmp_path / "again")])
    assert run.main() == 0
    said = re.search(
        r"(\d+) of (\d+) episodes are those of .*?, to the last digit(?:, (\d+) end alike)?", capsys.readouterr().err
    )
    assert said
    same, count, alike = (int(number or STARTS) for number in said.groups())
    assert count == STARTS
    if torch.backends.cpu.get_cpu_capability() == MADE_WITH:
        assert same == STARTS
    assert alike >= 0.9 * STARTS
