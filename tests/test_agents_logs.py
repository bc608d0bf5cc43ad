"""What a run leaves to look at: its policy, TensorBoard's tags and charts, films."""

import dataclasses
import errno
import functools
import os
import re
import threading
import time
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from fake_task import PointMass
from short_runs import BASE, SMALL_PPO, run
from tensorboard.summary.writer.record_writer import RecordWriter
from torch import Tensor

from dora.agents.evaluation import play
from dora.agents.evaluation.play import evaluate_checkpoint, record
from dora.agents.runs.logging import FILM, LAYOUT, LOST, TAGS, RunLog, add_film, tags_table
from dora.agents.runs.run_folder import RunFolder


def test_a_checkpoint_is_evaluated_with_its_own_networks(tmp_path: Path):
    config = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=256)
    run(tmp_path / "run", config)
    others = dataclasses.replace(config, learner=dataclasses.replace(SMALL_PPO, hidden=(8, 8)))
    best = RunFolder(tmp_path / "run").best
    tables = [evaluate_checkpoint(best, asked, PointMass)[1].table for asked in (config, others)]
    assert torch.equal(*tables)


def test_every_tag_written_is_explained(tmp_path: Path):
    config = dataclasses.replace(BASE, learner=SMALL_PPO, total_steps=1024, eval_every=512)
    run(tmp_path / "run", config)
    tags = events_of(tmp_path / "run").Tags()["scalars"]
    assert {"loss/policy", "training/reward/distance", "evaluation/stage/reach", "speed/learn_share"} <= set(tags)
    families = ("training/reward/", "training/stage/", "evaluation/stage/", "training/")
    unexplained = [t for t in tags if t not in TAGS and not t.startswith(families)]
    assert not unexplained
    assert min(tags).startswith("evaluation/")  # TensorBoard shows tags in this order, and success is to come first
    assert min(TAGS).startswith("evaluation/")


def events_of(folder: Path) -> Any:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return events


def test_settings_stand_beside_the_last_figures(tmp_path: Path):
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData  # pyright: ignore

    config = dataclasses.replace(BASE, learner=dataclasses.replace(SMALL_PPO, gamma=0.75), total_steps=1024)
    result = run(tmp_path / "run", config)
    events = events_of(tmp_path / "run")
    for name in ("success_rate", "zero_success_rate"):
        assert [event.value for event in events.Scalars(f"final/{name}")] == [pytest.approx(result[name])]
    plugin = events.summary_metadata
    start = HParamsPluginData.FromString(plugin["_hparams_/session_start_info"].plugin_data.content).session_start_info
    assert start.hparams["learner.gamma"].number_value == 0.75
    assert start.hparams["env"].string_value == "Fake-v1"
    names = HParamsPluginData.FromString(plugin["_hparams_/experiment"].plugin_data.content).experiment.metric_infos
    assert {info.name.tag for info in names} == {tag for tag in TAGS if tag.startswith("final/")}
    assert len(names) == 3
    assert "_hparams_/session_end_info" in plugin


def test_each_chart_of_the_layout_shows_a_tag():
    tags = [tag.replace("<name>", "x").replace("<term>", "x") for tag in TAGS]
    for charts in LAYOUT.values():
        for kind, patterns in charts.values():
            assert kind == "Multiline"
            assert all(any(re.fullmatch(pattern, tag) for tag in tags) for pattern in patterns), patterns


def test_the_page_about_agents_has_the_table_of_tags(project_root: Path):
    assert tags_table() in (project_root / "docs" / "agents.md").read_text()


def test_a_full_disk_under_tensorboard_is_told_once_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    shown: list[type[BaseException]] = []
    monkeypatch.setattr(threading, "excepthook", lambda met: shown.append(met.exc_type))
    log = RunLog(tmp_path)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(RecordWriter, "write", full)
    step = 0
    while not capsys.readouterr().err.startswith(f"{LOST} (No space left on device)."):
        step += 1
        assert step < 1000
        log.add("training", {"success_rate": 1.0}, step)
        time.sleep(0.01)
    log.add_learner({"policy": 0.0}, step)
    log.add_final({"success_rate": 1.0}, step)
    log.close()
    assert not capsys.readouterr().err
    assert not shown
    other = threading.Thread(target=full)
    other.start()
    other.join()
    assert shown == [OSError]


def test_a_film_is_written(tmp_path: Path):
    path = tmp_path / "video" / "a.mp4"
    record(functools.partial(PointMass, 1), lambda o: torch.zeros(len(o), 2), path, episodes=1)
    assert path.stat().st_size > 500


def test_a_film_shows_episodes_that_begin_with_successive_seeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Filmed(PointMass):
        """Its picture is as bright as the seed of the episode."""

        def reset(self, seed: Any = None, options: Any = None) -> Any:
            self.seed = seed
            return super().reset(seed, options)

        def render(self) -> Tensor:
            return torch.full((1, 16, 16, 3), self.seed, dtype=torch.uint8)

    shown: list[int] = []

    def kept(path: Path, episodes: Any, rate: int) -> None:
        shown.extend(int(frame[0, 0, 0]) for frames in episodes for frame in frames)

    monkeypatch.setattr(play, "write_film", kept)
    record(lambda: Filmed(1), None, tmp_path / "a.mp4", 3, first_seed=7)
    length = Filmed(1).max_steps + 1
    assert shown == [7] * length + [8] * length + [9] * length


def test_tensorboard_shows_a_film_as_moving_pictures(tmp_path: Path):
    shades: Any = [np.full((32, 48, 3), 20 * k, np.uint8) for k in range(11)]
    imageio.mimwrite(tmp_path / "a.mp4", shades, fps=20, macro_block_size=8)
    add_film(tmp_path, tmp_path / "a.mp4", 70)
    (image,) = events_of(tmp_path).Images(FILM)
    frames = imageio.mimread(image.encoded_image_string, format="GIF")
    assert (image.step, image.height, image.width) == (70, 16, 24)
    assert [frame.shape[:2] for frame in frames] == [(16, 24)] * 6
    assert [float(frame[..., :3].mean()) for frame in frames] == pytest.approx([0, 40, 80, 120, 160, 200], abs=8)
