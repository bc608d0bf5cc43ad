"""Demonstrations: what is recorded, and that ManiSkill's recorder works with a batch."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

import dora.tasks as tasks
from dora.datasets.episodes import Plan
from dora.datasets.record import record_dataset
from dora.datasets.sources import find_source


@pytest.mark.slow
def test_successes_are_recorded_and_can_be_played_again(tmp_path: Path):
    path = tmp_path / "new" / "demonstrations.h5"
    made = record_dataset("maniskill", find_source("DoraJug-v1", "scripted", "none"), Plan(2, 5, True, 3), path.parent)
    assert (made.episodes, made.successes) == (2, 2)
    index = json.loads(path.with_suffix(".json").read_text())
    assert index["env_info"]["env_id"] == "dora:DoraJug-v1"
    assert len(index["episodes"]) == 2
    with h5py.File(path) as file:
        assert len(file) == 2
        group: Any = file["traj_0"]
        episode = index["episodes"][0]
        actions, success = np.array(group["actions"]), np.array(group["success"])
        poses = np.array(group["env_states"]["actors"]["jug"])[:, :7]
    assert success[-1]
    assert np.isfinite(actions).all()
    assert poses[:, 2].max() - poses[0, 2] > 0.1
    task = tasks.make_task("DoraJug-v1", 1, guidance="none", preset="none")
    task.reset(seed=[episode["episode_seed"]])
    for action in torch.from_numpy(actions):
        *_, info = task.step(action[None])
    assert info["success"].all()
    np.testing.assert_allclose(task.snapshot.object.p[0].numpy(), poses[-1, :3], atol=0.01)
    task.close()
