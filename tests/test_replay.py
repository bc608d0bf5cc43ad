"""ManiSkill's replay opens our recordings by itself, and plays them by actions and by states."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from mani_skill.utils.wrappers.record import RecordEpisode

import dora.sim
from dora.datasets.episodes import Plan
from dora.datasets.record import record_dataset
from dora.datasets.sources import find_source
from dora.errors import InputError
from dora.tasks.mdp.randomisation import PRESETS

STEPS = 12
WAYS = {"actions": [], "first state": ["--use-first-env-state"], "states": ["--use-env-states"]}
"""How a recording is played, with the arguments for it."""
PLAYED = [
    *(("one", way) for way in WAYS), ("three", "first state"),
    ("three of other sizes", "states"), ("three of ManiSkill's", "states"),
    ("demonstrations", "actions"),
]  # fmt: skip
"""What is played. By actions alone ManiSkill's own tasks start as recorded only in a batch of the same seeds."""
PLAY = """
import sys
from mani_skill.trajectory.replay_trajectory import main, parse_args
assert not any(name.split(".")[0] == "dora" for name in sys.modules)
for line in sys.stdin:
    main(parse_args(line.split("\\t")[:-1]))
"""
"""Plays what its input says, line by line, in a process that has imported nothing of ours."""


def record(folder: Path, env_id: str, num_envs: int, **options: Any) -> Path:
    env: Any = RecordEpisode(
        gym.make(env_id, num_envs=num_envs, obs_mode="state", **options),  # pyright: ignore[reportArgumentType]
        str(folder),
        trajectory_name="recorded",
        save_video=False,
    )
    env.reset(seed=np.arange(num_envs) + 5)
    generator = np.random.default_rng(0)
    for _ in range(STEPS):
        env.step(0.3 * generator.uniform(-1, 1, env.action_space.shape or ()))
    env.flush_trajectory()
    env.close()
    return folder / "recorded.h5"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, batch = tmp_path_factory.mktemp("recordings"), {"sim_backend": dora.sim.BACKEND}
    dense = {"render_backend": "none"}
    source, plan = find_source("DoraCube-v1", "scripted", "none"), Plan(2, 5, True, 2)
    record_dataset("maniskill", source, plan, folder / "demonstrations")
    return {
        "one": record(folder / "one", "DoraCube-v1", 1),
        "three": record(folder / "three", "DoraCube-v1", 3),
        "three of other sizes": record(folder / "sizes", "DoraJug-v1", 3, preset="hard", **batch),
        "three of ManiSkill's": record(folder / "stock", "PickCube-v1", 3, **batch, **dense),
        "demonstrations": folder / "demonstrations" / "demonstrations.h5",
    }


@pytest.fixture(scope="module")
def played(recordings: dict[str, Path], project_root: Path) -> str:
    """What ManiSkill's replay printed."""
    lines = []
    for name, way in PLAYED:
        path = recordings[name]
        copy = path.parent / f"{way.replace(' ', '_')}.h5"
        copy.write_bytes(path.read_bytes())
        copy.with_suffix(".json").write_bytes(path.with_suffix(".json").read_bytes())
        words = ["--traj-path", str(copy), "--save-traj", "--record-rewards", *WAYS[way]]
        words += [] if name == "demonstrations" else ["--allow-failure"]
        words += ["--num-envs", "3"] if name == "three of other sizes" else []
        lines.append("\t".join([*words, "\n"]))
    paths = os.pathsep.join([str(project_root), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", PLAY],
        input="".join(lines),
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": paths},
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("name", "way"), PLAYED)
def test_recordings_are_played_again(recordings: dict[str, Path], played: str, name: str, way: str):
    path = recordings[name]
    (replay,) = path.parent.glob(f"{way.replace(' ', '_')}.state.*.h5")
    with h5py.File(path) as old_file, h5py.File(replay) as new_file:
        old: Any = old_file
        new: Any = new_file
        assert set(new) == set(old)
        for trajectory in old:
            before, after = (_last_places(file[trajectory]) for file in (old, new))
            np.testing.assert_allclose(after, before, atol=5e-3 if way == "states" else 0.02)
            np.testing.assert_allclose(old[f"{trajectory}/actions"], new[f"{trajectory}/actions"], atol=1e-6)


def _last_places(trajectory: Any) -> np.ndarray:
    """Places of all bodies after the last but one step, which is the last state that a replay by states sets [m]."""
    return np.stack([np.array(states)[-2, :3] for states in trajectory["env_states"]["actors"].values()])


@pytest.mark.slow
def test_a_recording_says_how_it_is_opened(recordings: dict[str, Path]):
    for name, path in recordings.items():
        info = json.loads(path.with_suffix(".json").read_text())["env_info"]
        assert info["env_id"].startswith("dora:")
        backend = "physx_cpu" if name == "one" else dora.sim.BACKEND
        assert info["env_kwargs"]["sim_backend"] == backend


def test_arguments_that_are_no_plain_data_are_stored_as_such(tmp_path: Path):
    config = gym.make("DoraCube-v1", preset="none").unwrapped.config  # pyright: ignore[reportAttributeAccessIssue]
    path = record(tmp_path, "DoraCube-v1", 1, config=config, sim_config={"scene_config": {"gravity": np.zeros(3)}})
    info = json.loads(path.with_suffix(".json").read_text())["env_info"]
    assert info["env_kwargs"]["config"]["randomisation"]["size"] == PRESETS["none"].size
    assert info["env_kwargs"]["sim_config"]["scene_config"]["gravity"] == [0, 0, 0]
    again = gym.make(info["env_id"], **info["env_kwargs"]).unwrapped
    assert again.config == config  # pyright: ignore[reportAttributeAccessIssue]


def test_what_cannot_be_stored_is_left_out(tmp_path: Path):
    grasps = dora.tasks.make_task("DoraCube-v1", 1).guide.choice.candidates
    path = record(tmp_path, "DoraCube-v1", 1, grasps=grasps)
    assert "grasps" not in json.loads(path.with_suffix(".json").read_text())["env_info"]["env_kwargs"]


@pytest.mark.skipif(dora.sim.can_render(), reason="there is a Vulkan driver: pictures are drawn")
def test_a_picture_without_a_driver_is_refused_when_it_is_asked_for():
    env = gym.make("DoraCube-v1", num_envs=2, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(torch.zeros(2, 26))
    with pytest.raises(InputError, match="nothing can be rendered"):
        env.render()
    wishes: list[dict[str, Any]] = [{"render_mode": "human"}, {"obs_mode": "rgb"}]
    for options in wishes:
        with pytest.raises(InputError, match="no Vulkan driver"):
            gym.make("DoraCube-v1", **options)
