"""What a run's result, log and folder say, worked out by hand: rates, shares of time, processor time, locks."""

import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v2 as imageio
import numpy as np
import psutil
import pytest
import torch
from fake_task import PointMass
from PIL import Image
from short_runs import BASE, SMALL_PPO
from test_agents_logs import events_of

from dora.agents.collecting import rollouts
from dora.agents.collecting.task_env import EpisodeColumns
from dora.agents.config import RunConfig
from dora.agents.evaluation.evaluate import Evaluation, outcome
from dora.agents.runs import trainer as trainer_module
from dora.agents.runs.interrupt import Interrupt
from dora.agents.runs.logging import FILM, RunLog, add_film, flat_settings
from dora.agents.runs.machine import OtherLoad, own_seconds
from dora.agents.runs.run_folder import RunFolder, make_result, steps_to
from dora.agents.runs.trainer import Trainer
from dora.errors import InputError

CONFIG = RunConfig("Fake-v1", "ppo", "grasps", guidance_parts=("prior",), seed=7, num_envs=5, workers=3)
COLUMNS = EpisodeColumns.of(("raw_success", "stage/reach", "stage/lift", "penetration_mm", "nonfinite", "reward/near"))


def evaluation_of(success: list[float], first_seed: int = 70, ranking_steps: int | None = 9) -> Evaluation:
    """Episodes that end so: each a millimetre deeper than the one before, of ten steps and a return of its number."""
    columns = {
        "success": success, "whole": [1.0] * len(success), "raw_success": [1.0] * len(success),
        "stage/reach": [1.0] * len(success), "stage/lift": success,
        "penetration_mm": [float(k) for k in range(len(success))], "nonfinite": [0.0, *[1.0] * (len(success) - 1)],
        "return": [float(k) for k in range(len(success))], "length": [10.0] * len(success),
        "reward/near": [5.0] * len(success),
    }  # fmt: skip
    table = torch.tensor([columns[name] for name in COLUMNS.names]).T
    return Evaluation(COLUMNS, table, first_seed, ranking_steps, {"mass": torch.arange(float(len(success)))})


def result_of(**changes: Any) -> dict[str, Any]:
    given: dict[str, Any] = {
        "env_steps": 12_345, "wall_seconds": 100.00049, "episodes": 11,
        "evaluation": evaluation_of([1.0, 0.0, 1.0, 0.0]),
        "zero": evaluation_of([1.0, 0.0, 0.0, 0.0]), "finished": True, "nonfinite": 4,
        "other_seconds": 25.0, "commit": "abc",
        "curve": [[100, 1.0, 0.5], [200, 2.0, 0.79], [300, 3.0, 0.8], [400, 4.0, 1.0]],
    }  # fmt: skip
    return make_result(CONFIG, **given | changes)


def test_a_result_says_what_was_evaluated_and_how_fast_it_was():
    found = result_of()
    wanted = {
        "env_steps": 12_345, "wall_seconds": 100.0, "env_steps_per_second": 123.4, "episodes": 11, "success_rate": 0.5,
        "zero_success_rate": 0.25, "stage_rates": {"reach": 1.0, "lift": 0.5}, "return_mean": 1.5,
        "penetration_max_mm": 3.0, "penetration_p95_mm": pytest.approx(2.85), "eval_episodes": 4,
        "guidance_parts": ["prior"], "raw_success_rate": 1.0, "success_at_end_rate": 0.5, "nonfinite_episodes": 7,
        "ranking_steps": 9, "steps_to_50": 100, "steps_to_80": 300, "first_seed": 70, "finished": True, "seed": 7,
        "num_envs": 5, "workers": 3, "reward": "dense", "other_load": pytest.approx(0.25, rel=1e-4),
        "config_digest": CONFIG.digest(), "commit": "abc",
    }  # fmt: skip
    assert {name: found[name] for name in wanted} == wanted
    assert found["success_interval"] == pytest.approx([0.1500, 0.8500], abs=1e-4)


def test_a_result_without_an_evaluation_says_nothing_of_it():
    found = result_of(evaluation=None, zero=None, wall_seconds=0.0, curve=[])
    missing = ("success_rate", "zero_success_rate", "return_mean", "penetration_max_mm", "penetration_p95_mm",
               "success_interval", "raw_success_rate", "ranking_steps", "first_seed", "other_load", "steps_to_50",
               "steps_to_80", "success_at_end_rate")  # fmt: skip
    assert [found[name] for name in missing] == [None] * len(missing)
    assert (found["stage_rates"], found["eval_episodes"], found["nonfinite_episodes"]) == ({}, 0, 4)
    assert found["env_steps_per_second"] == 0.0
    assert result_of(wall_seconds=0.5, env_steps=1)["env_steps_per_second"] == 2.0
    assert result_of(wall_seconds=0.5)["other_load"] == 50.0
    assert result_of(other_seconds=None)["other_load"] is None
    assert result_of(wall_seconds=0.12345)["wall_seconds"] == 0.123
    assert steps_to(0.5, [[1, 1.0, 0.5]]) == 1


def test_rows_of_an_evaluation_hold_means_per_step_and_how_episodes_began():
    header, rows = evaluation_of([1.0, 0.0]).rows()
    assert header == ("episode", "success", "raw_success", "stage/reach", "stage/lift", "penetration_mm", "nonfinite",
                      "return", "length", "reward/near", "start/mass")  # fmt: skip
    assert rows == [[0, 1, 1, 1, 1, 0, 0, 0, 10, 0.5, 0], [1, 0, 1, 1, 0, 1, 1, 1, 10, 0.5, 1]]
    text = outcome(evaluation_of([1.0, 0.0, 1.0]), evaluation_of([0.0, 0.0, 0.0]))
    assert text.startswith("success 0.667")
    assert ", without any correction 0" in text
    assert text.endswith(", penetration p95 1.9 mm")
    assert "without" not in outcome(evaluation_of([1.0]), None)


# -------------------------------------------------------------------------- machine


def test_processor_time_is_summed_over_processes_and_kinds(monkeypatch: pytest.MonkeyPatch):
    class Process:
        def __init__(self, scale: float = 1.0, gone: bool = False):
            self.scale, self.gone = scale, gone

        def children(self, recursive: bool) -> list["Process"]:
            assert recursive
            return [Process(10.0), Process(1.0, gone=True), Process(100.0)]

        def cpu_times(self) -> SimpleNamespace:
            if self.gone:
                raise psutil.NoSuchProcess(1)
            s = self.scale
            return SimpleNamespace(user=1 * s, system=2 * s, children_user=3 * s, children_system=4 * s, iowait=5 * s)

    total = SimpleNamespace(user=1000.0, nice=500.0, system=200.0, irq=20.0, softirq=3.0, idle=9e9, iowait=7e9)
    monkeypatch.setattr(psutil, "Process", Process)
    monkeypatch.setattr(psutil, "cpu_times", lambda: total)
    assert own_seconds() == 10 * (1 + 10 + 100)
    load = OtherLoad()
    assert load.seconds() == 0
    total.nice = 512.0
    assert load.seconds() == 12.0
    assert OtherLoad._others() == 1735.0 - 1110.0


# ------------------------------------------------------------------------- interrupt


def test_a_signal_is_a_request_and_none_ends_a_run_that_closes(capfd: pytest.CaptureFixture[str]):
    with Interrupt() as asked:
        assert (asked.requested, asked.number, asked.at_once, asked.closing) == (False, None, False, False)
        os.kill(os.getpid(), signal.SIGINT)
        assert (asked.requested, asked.number, asked.at_once) == (True, signal.SIGINT, False)
        assert capfd.readouterr().err.startswith("Interrupted: saving")
        os.kill(os.getpid(), signal.SIGINT)
        assert not asked.at_once  # some senders repeat the first one
        asked._since -= 2.0
        asked.closing = True
        os.kill(os.getpid(), signal.SIGTERM)
        assert (asked.at_once, asked.number) == (False, signal.SIGINT)


# --------------------------------------------------------------------------- folder


def test_a_lock_is_a_file_that_all_may_read_and_only_its_owner_writes(tmp_path: Path):
    before = os.umask(0o022)
    try:
        with RunFolder(tmp_path).locked():
            assert (tmp_path / ".lock").stat().st_mode & 0o777 == 0o644
            with pytest.raises(InputError, match="Another process is at work"), RunFolder(tmp_path).locked():
                pass
        with RunFolder(tmp_path).locked():
            pass
    finally:
        os.umask(before)


def test_a_folder_has_to_be_writable_and_searchable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def access(path: Any, mode: int) -> bool:
        asked.append((path, mode))
        return len(asked) == 1

    monkeypatch.setattr(os, "access", access)
    folder = RunFolder(tmp_path / "a" / "b")
    folder.check_free()
    assert asked == [(tmp_path, os.W_OK | os.X_OK)]
    with pytest.raises(InputError, match="nothing can be written"):
        folder.check_free()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="Cannot make the run folder"):
        RunFolder(tmp_path / "file" / "run").check_free()


# ------------------------------------------------------------------------ TensorBoard


def test_figures_that_are_not_known_are_not_logged_and_settings_are_plain(tmp_path: Path):
    log = RunLog(tmp_path / "a")
    log.add_final({"success_rate": 0.5, "zero_success_rate": None, "other": 3.0}, 40)
    log.add_learner({"policy": 1.0, "policy/left": 2.0, "kl": 3.0}, 40)
    log.close()
    events = events_of(tmp_path / "a")
    assert {(tag, events.Scalars(tag)[0].value) for tag in events.Tags()["scalars"]} == {
        ("final/success_rate", 0.5), ("loss/policy", 1.0), ("loss/policy/left", 2.0), ("learner/kl", 3.0)
    }  # fmt: skip
    assert {event.step for tag in events.Tags()["scalars"] for event in events.Scalars(tag)} == {40}
    assert any(tag.startswith("tags") for tag in events.Tags()["tensors"])
    later = RunLog(tmp_path / "b", 7)
    later.close()
    assert not events_of(tmp_path / "b").Tags()["tensors"]
    flat = flat_settings(CONFIG)
    assert (flat["seed"], flat["stagger"], flat["stop_success"], flat["env"]) == (7, True, "None", "Fake-v1")


def test_a_film_in_tensorboard_is_as_fast_as_the_film_and_begins_again(tmp_path: Path):
    shades: Any = [np.full((16, 32, 3), 20 * k, np.uint8) for k in range(8)]
    imageio.mimwrite(tmp_path / "a.mp4", shades, fps=8, macro_block_size=8)
    add_film(tmp_path, tmp_path / "a.mp4", 3)
    (image,) = events_of(tmp_path).Images(FILM)
    (tmp_path / "a.gif").write_bytes(image.encoded_image_string)
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.info["duration"] == 250  # every second frame of eight a second
        assert gif.info["loop"] == 0  # for ever
        assert getattr(gif, "n_frames", 1) == 4


# --------------------------------------------------------------------------- trainer


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, float], int]]:
    """What a run logs; each look at the clock takes a second."""
    seconds, found = iter(range(10**6)), []
    monkeypatch.setattr(trainer_module.time, "perf_counter", lambda: float(next(seconds)))
    monkeypatch.setattr(RunLog, "add", lambda _, prefix, values, step: found.append((prefix, dict(values), step)))
    return found


def test_shares_of_time_and_rates_are_those_of_the_clock(
    tmp_path: Path, logged: list[tuple[str, dict[str, float], int]], monkeypatch: pytest.MonkeyPatch
):
    """Of each iteration: a look before it, after collecting, after learning, and one for the time of the run."""
    config: Any = BASE
    config = config.__class__(**vars(config) | {"learner": SMALL_PPO, "total_steps": 768, "eval_every": 10**6})
    folder = RunFolder(tmp_path / "run")
    folder.create(config)
    made = Trainer(config, PointMass, folder, zero=False)
    shown: list[tuple[Any, ...]] = []
    monkeypatch.setattr(trainer_module.ProgressDisplay, "bar", lambda *_: lambda *given: shown.append(given))
    result = made.run()
    speeds = [values for prefix, values, _ in logged if prefix == "speed"]
    assert [values["steps_per_second"] for values in speeds] == [128.0] * 3  # 256 steps in two seconds
    walls = []
    for k, values in enumerate(speeds, 1):
        walls.append(k / values["collect_share"])
        assert values["learn_share"] == values["collect_share"]
        assert values["evaluate_share"] == 0.0
    assert np.diff(walls).tolist() == pytest.approx([4.0, 4.0])
    assert [given[:2] for given in shown] == [(256, 768), (512, 768), (768, 768)]
    assert [given[2] for given in shown] == pytest.approx([256 * k / wall for k, wall in enumerate(walls, 1)])
    assert shown[0][3].endswith("(evaluated -)")
    assert result["env_steps"] == made.counters.env_steps == 768


@pytest.mark.parametrize(
    ("status", "words"),
    [
        (-9, "ended by SIGKILL"),
        (-15, "ended by SIGTERM"),
        (0, "exit status 0"),
        (3, "exit status 3"),
        (None, "exit status None"),
    ],
)
def test_the_end_of_a_process_is_told_by_its_status(status: int | None, words: str):
    assert rollouts._how(status) == words
