"""How episodes began: numbers of the tasks, columns of an evaluation, success against them in a report."""

import math
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from fake_task import PointMass
from scipy.spatial.transform import Rotation
from test_report import write_run

import dora  # noqa: F401  (registers the tasks)
from dora.affordance.reach.feasibility_table import Grid
from dora.agents.collecting.task_env import TaskEnv
from dora.agents.evaluation.evaluate import Evaluation, run_batch
from dora.agents.reports import report
from dora.agents.reports.report import write_report
from dora.agents.reports.run_results import find_runs
from dora.agents.reports.starts import bins, starts_section
from dora.errors import InputError
from dora.tasks.env.starts import TRIES, standing


@pytest.fixture(scope="module", params=["DoraJug-v1", "DoraMicrowave-v1"])
def env(request: pytest.FixtureRequest):
    made = gym.make(request.param, num_envs=4, sim_backend="physx_cpu_batch").unwrapped
    yield made
    made.close()


def test_the_numbers_are_those_that_the_simulator_has(env):
    env.reset(seed=[1, 2, 3, 4])
    numbers, several = env.start_numbers, len(env.objects) > 1
    for k, (name, body) in enumerate(env.objects.items()):
        end = f"_{name}" if several else ""
        torch.testing.assert_close(numbers[f"size{end}"], env.scale[:, k])
        links = getattr(body, "links", None)
        if links is None:
            mass = torch.tensor([one.components[-1].mass for one in _entities(body)])
            torch.testing.assert_close(numbers[f"mass{end}"], mass, rtol=1e-5, atol=1e-6)


def _entities(body):
    return [body_.entity for body_ in body._bodies]


def test_the_error_of_the_candidate_is_within_the_presets_bounds(env):
    env.reset(seed=[1, 2, 3, 4])
    r = env.config.randomisation
    for name, value in env.start_numbers.items():
        if name.startswith("candidate_error_mm"):
            assert (value > 0).all()
            assert (value <= 1e3 * math.sqrt(3) * r.candidate_position * 1.001).all()
        if name.startswith("candidate_error_deg"):
            bound = math.degrees(math.sqrt(3) * r.candidate_rotation) * 1.001
            assert (value > 0).all()
            assert (value <= bound).all()
        assert value.shape == (4,)
    assert any(name.startswith("candidate_error_mm") for name in env.start_numbers)


def test_the_error_of_the_candidate_is_how_far_the_used_one_is_from_the_stored_one(env):
    """In millimetres and degrees, by another library."""
    env.reset(seed=[1, 2, 3, 4])
    for name, choice in env.arms.choices.items():
        end = f"_{name}" if len(env.arms) > 1 else ""
        chosen, used = choice.buffers.chosen.long(), choice.buffers
        away = np.linalg.norm((used.position[:, 0] - choice.candidates.position[chosen]).numpy(), axis=-1)
        np.testing.assert_allclose(env.start_numbers[f"candidate_error_mm{end}"], 1000 * away, rtol=1e-4)
        stored, found = (
            Rotation.from_quat(q.numpy(), scalar_first=True)
            for q in (choice.candidates.quaternion[chosen], used.quaternion[:, 0])
        )
        turn = np.degrees((stored.inv() * found).magnitude())
        np.testing.assert_allclose(env.start_numbers[f"candidate_error_deg{end}"], turn, atol=0.05)


def test_without_randomisation_there_is_no_error():
    env: Any = gym.make("DoraCube-v1", preset="none", num_envs=2, sim_backend="physx_cpu_batch").unwrapped
    env.reset(seed=0)
    numbers = env.start_numbers
    assert (numbers["candidate_error_mm"] < 1e-3).all()
    assert (numbers["candidate_error_deg"] < 0.1).all()
    assert (numbers["size"] == 1).all()
    env.close()


class _Begun(PointMass):
    """Says with which number its episodes began: one that the reset draws and each step changes."""

    def reset(self, seed=None, options=None):
        out = super().reset(seed, options)
        self.number = torch.tensor([float(s % 100) for s in seed]) if isinstance(seed, list) else torch.zeros(2)
        return out

    def step(self, action):
        self.number = self.number + 1
        return super().step(action)

    @property
    def start_numbers(self):
        return {"number": self.number}


def test_an_evaluation_stores_the_numbers_of_the_start_and_not_of_the_end():
    env = TaskEnv(_Begun(2))
    table = run_batch(env, lambda observation: torch.zeros(2, env.sizes[1]), 7)
    assert table.shape == (2, len(env.columns.names) + 1)
    evaluation = Evaluation(env.columns, table[:, :-1], 7, None, {"number": table[:, -1]})
    header, rows = evaluation.rows()
    assert header[-1] == "start/number"
    assert [row[-1] for row in rows] == [7.0, 8.0]


def _write_episodes(path: Path, success: np.ndarray, error: np.ndarray) -> None:
    lines = [f"{i},{s:.0f},{e:.3f},1" for i, (s, e) in enumerate(zip(success, error, strict=True))]
    path.write_text("\n".join(["episode,success,start/candidate_error_mm,start/size", *lines]) + "\n")


def test_quarters_hold_equally_many_episodes_in_the_order_of_the_number():
    error = np.array([8.0, 1, 2, 7, 3, 6, 5, 4])
    found = bins({"success": (error < 4.5).astype(float), "start/e": error}, "start/e")
    assert found == [(1, 2, 2, 2), (3, 4, 2, 2), (5, 6, 2, 0), (7, 8, 2, 0)]
    assert bins({"success": error, "start/e": np.ones(8)}, "start/e") == []


def test_a_report_shows_success_against_the_start(tmp_path: Path):
    error = np.linspace(0, 8, 40)
    for seed in (0, 1):
        write_run(tmp_path / "runs" / str(seed), seed, 0.5, episodes=40)
        _write_episodes(tmp_path / "runs" / str(seed) / "eval.csv", error < 3.9, error)
    _write_episodes(tmp_path / "runs" / "0" / "zero.csv", error > 4, error)
    write_run(tmp_path / "runs" / "old", 3, 0.5, episodes=2)  # whose episodes do not say
    (tmp_path / "runs" / "old" / "eval.csv").write_text("episode,success\n0,1\n1,0\n")
    section = starts_section(find_runs(tmp_path / "runs"))
    assert [row[4] for row in section.rows] == ["candidate_error_mm"]  # the size is the same everywhere
    assert [cell.split()[0] for cell in section.rows[0][5:]] == ["100.0", "100.0", "0.0", "0.0"]
    paths = write_report(tmp_path / "runs", tmp_path / "out")
    assert "Success against how episodes began" in (tmp_path / "out" / "comparison.md").read_text()
    picture = next(path for path in paths if path.name == "Toy-v1-starts.png")
    assert imageio.imread(picture).std() > 1


def test_names_of_numbers_are_drawn_as_they_are_and_not_too_many(tmp_path: Path):
    """A name that matplotlib would take for a formula; a hundred numbers are in the table, thirty in the picture."""
    count, names = 40, ["$x^{$", *(f"n{k}" for k in range(99))]
    write_run(tmp_path / "runs" / "0", 0, 0.5, episodes=count)
    values = np.random.default_rng(0).random((count, len(names)))
    lines = [",".join(map(str, [i, i % 2, *row])) for i, row in enumerate(values)]
    header = ",".join(["episode", "success", *(f"start/{name}" for name in names)])
    (tmp_path / "runs" / "0" / "eval.csv").write_text("\n".join([header, *lines]) + "\n")
    assert len(starts_section(find_runs(tmp_path / "runs")).rows) == 100
    picture = next(p for p in write_report(tmp_path / "runs", tmp_path / "out") if p.name == "Toy-v1-starts.png")
    assert imageio.imread(picture).shape[0] < 5000


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("episode,success,penetration_mm\n", "has no episode"),
        (f"episode,success,{'x' * 201}\n0,1,2\n", "more than 200"),
    ],
)
def test_an_empty_table_of_episodes_and_endless_names_are_refused(content: str, words: str, tmp_path: Path):
    write_run(tmp_path / "runs" / "0", 0, 0.5)
    (tmp_path / "runs" / "0" / "eval.csv").write_text(content)
    with pytest.raises(InputError, match=words):
        write_report(tmp_path / "runs", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_report_that_cannot_be_drawn_replaces_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_run(tmp_path / "runs" / "0", 0, 0.5)
    columns = [",".join([str(i), str(i % 2), str(i)]) for i in range(8)]
    (tmp_path / "runs" / "0" / "eval.csv").write_text("\n".join(["episode,success,start/a", *columns]) + "\n")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tables.md").write_text("those of before")

    def interrupted(*_: Any) -> bytes:
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "draw_starts", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_report(tmp_path / "runs", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["tables.md"]
    assert (tmp_path / "out" / "tables.md").read_text() == "those of before"


def test_the_first_place_that_leaves_a_candidate_is_taken_and_the_very_first_where_none_does():
    """Reached is what lies beyond x = 0.1; of the third row nothing does."""
    wanted = [0, 2, 0]
    u = torch.full((3, TRIES, 3), 0.25)
    u[0, 0, 0], u[0, 2, 0], u[1, 2:, 0] = 0.9, 0.8, torch.linspace(0.95, 0.75, TRIES - 2)
    heights = torch.tensor([0.1, 0.2, 0.3])
    p, q = standing(u.flatten(1), heights, Grid((0.0, 0.0), (1.0, 1.0)), lambda p, q: p[:, :1] > 0.1)
    x = 2 * u[torch.arange(3), torch.tensor(wanted), 0] - 1
    torch.testing.assert_close(p, torch.stack([x, torch.full((3,), -0.5), heights], -1))
    assert q.shape == (3, 4)
