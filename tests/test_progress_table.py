"""The table of iterations: complete after every row, mended after a crash, cut where a run goes on."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
from fake_task import PointMass

from dora.agents.config import PPOConfig, RunConfig
from dora.agents.reports.figures import smoothed
from dora.agents.runs.progress_table import COLUMNS, ProgressTable, read_progress
from dora.agents.runs.run_folder import RunFolder, steps_to
from dora.agents.runs.trainer import Trainer
from dora.errors import InputError

CONFIG = RunConfig(
    "Fake-v1", "ppo", num_envs=16, workers=0, eval_envs=16, eval_episodes=16, final_episodes=16, total_steps=1024,
    learner=PPOConfig(rollout=16, minibatch=128, hidden=(8,)),
)  # fmt: skip


def test_each_row_is_there_at_once_and_unknown_values_are_empty(tmp_path: Path):
    table = ProgressTable(tmp_path / "progress.csv", ["reach", "lift"])
    table.add({"env_steps": 1_234_567, "seconds": 1.5, "episodes": 0, "success_rate": float("nan")})
    assert (tmp_path / "progress.csv").read_text().splitlines()[1] == "1234567,1.5,0,,,,,,"
    table.add({"env_steps": 2_000_000, "seconds": 3.25, "episodes": 4, "success_rate": 1 / 3, "stage/lift": 0.5})
    columns = read_progress(tmp_path / "progress.csv")
    assert list(columns) == [*COLUMNS, "stage/reach", "stage/lift"]
    assert columns["env_steps"].tolist() == [1_234_567, 2_000_000]
    assert columns["success_rate"][1] == pytest.approx(1 / 3, abs=1e-6)
    assert np.isnan(columns["success_rate"][0])
    assert columns["stage/lift"][1] == 0.5


@pytest.mark.parametrize(
    "torn", ["300,3.", "300,3,0,,,,\n", "300,3\x00\x00,0,,,,,\n", "400", "," * len(COLUMNS) + "\n"]
)
def test_a_torn_last_row_is_left_out_and_mended(tmp_path: Path, torn: str):
    path = tmp_path / "progress.csv"
    table = ProgressTable(path, ["reach"])
    for step in (100, 200):
        table.add({"env_steps": step, "seconds": step / 100})
    whole = path.read_text()
    path.write_text(whole + torn)
    assert read_progress(path)["env_steps"].tolist() == [100, 200]
    ProgressTable(path, ["reach"], 250)
    assert path.read_text() == whole


def test_rows_beyond_the_checkpoint_are_dropped(tmp_path: Path):
    path = tmp_path / "progress.csv"
    table = ProgressTable(path, ["reach"])
    for step in (100, 200, 300):
        table.add({"env_steps": step})
    ProgressTable(path, ["reach"], 200).add({"env_steps": 300})
    assert read_progress(path)["env_steps"].tolist() == [100, 200, 300]
    ProgressTable(path, ["other"], 200)  # a table with other columns does not go on
    assert read_progress(path)["env_steps"].tolist() == []
    ProgressTable(tmp_path / "new.csv", ["reach"], 200)  # nor one of a version that wrote none
    assert read_progress(tmp_path / "new.csv")["env_steps"].tolist() == []


def test_a_folder_that_is_gone_is_said(tmp_path: Path):
    (tmp_path / "run").mkdir()
    table = ProgressTable(tmp_path / "run" / "progress.csv", [])
    (tmp_path / "run" / "progress.csv").unlink()
    with pytest.raises(InputError, match="Cannot write"):
        table.add({"env_steps": 1})


def test_a_run_writes_a_row_per_iteration_and_goes_on_where_it_was(tmp_path: Path):
    folder = RunFolder(tmp_path / "run")
    folder.create(CONFIG)
    Trainer(CONFIG, PointMass, folder).run()
    expected = [256, 512, 768, 1024]
    columns = read_progress(folder.progress)
    assert columns["env_steps"].tolist() == expected
    assert (np.diff(columns["seconds"]) > 0).all()
    assert columns["episodes"].sum() == 3 * 16
    assert {"stage/approach", "stage/reach"} < set(columns)
    with folder.progress.open("a") as stream:  # as a killed run leaves it, beyond its checkpoint
        stream.write("1280,9,16,1,,2,0,1,1\n1536,9,1")
    Trainer(dataclasses.replace(CONFIG, total_steps=1536), PointMass, folder, resume=True).run()
    assert read_progress(folder.progress)["env_steps"].tolist() == [*expected, 1280, 1536]
    with folder.progress.open() as stream:
        assert len(list(csv.DictReader(stream))) == 6


def test_smoothing_is_a_gaussian_over_episodes():
    steps, values = np.array([0.0, 100.0, 200.0]), np.array([0.0, np.nan, 1.0])
    at = np.array([0.0, 100.0, 1e6])
    out = smoothed(at, steps, values, np.array([1.0, 5.0, 3.0]), 100.0)
    far = np.exp(-2.0)
    assert out[:2] == pytest.approx([3 * far / (1 + 3 * far), 0.75])
    assert np.isnan(out[2])
    constant = smoothed(np.linspace(0, 200, 5), steps, np.full(3, 0.4), np.ones(3), 20.0)
    assert constant == pytest.approx(np.full(5, 0.4))


def test_steps_to_a_success_rate_are_those_of_the_first_evaluation_that_has_it():
    curve = [[100, 1.0, 0.4], [200, 2.0, 0.85], [300, 3.0, 0.6]]
    assert (steps_to(0.5, curve), steps_to(0.8, curve), steps_to(0.9, curve)) == (200, 200, None)
