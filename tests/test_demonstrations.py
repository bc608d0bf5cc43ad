"""Demonstrations: what is recorded, and that ManiSkill's recorder works with a batch."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

import dora.tasks as tasks
from dora.errors import InputError
from dora.tools.demonstrations import record_demonstrations


@pytest.mark.slow
def test_successes_are_recorded_and_can_be_played_again(tmp_path: Path):
    made = record_demonstrations("DoraJug-v1", tmp_path, tries=3, num_envs=3, seed=5, preset="none")
    assert made.tried == 3
    assert 1 <= made.recorded <= 3
    index = json.loads(made.path.with_suffix(".json").read_text())
    assert index["env_info"]["env_id"] == "dora:DoraJug-v1"
    assert len(index["episodes"]) == made.recorded
    with h5py.File(made.path) as file:
        assert len(file) == made.recorded
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


def test_no_try_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="at least one try"):
        record_demonstrations("DoraCube-v1", tmp_path, tries=0)
