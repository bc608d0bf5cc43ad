"""What a card says of a policy, which runs a bundle may hold, and what a policy that is loaded says of itself."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import dora
from dora.agents.checkpoint import Checkpoint, read_checkpoint
from dora.agents.reports.run_results import DEFAULT_PRESET
from dora.configs import plain
from dora.digests import sealed
from dora.errors import InputError
from dora.policies import bundle, policy
from dora.policies.bundle import is_usual
from dora.policies.card import HEADINGS, Card
from dora.policies.policy import _words, bundled_files, bundled_ids, load_policy
from dora.tasks.mdp.guidance_parts import FILTER, OBSERVATION, PRIOR, REGION, REWARD

CARD = Card(
    env="DoraCube-v1", agent="ppo", guidance="affordance", preset="standard", seed=3, env_steps=250_400,
    total_steps=300_000, minutes=12.34, chosen_among=4, training_success=0.95, training_episodes=64, success_rate=0.9,
    success_interval=(0.8, 0.96), zero_success_rate=0.455, episodes=200, first_seed=7000, overlap_p95_mm=1.26,
    overlap_limit_mm=3.0, stage_rates={"reach": 1.0, "lift": 0.905}, counted_successes=180,
    failures={"lost": 5, "too much overlap": 15}, run="DoraCube-v1/ppo-s3", run_commit=None, commit="0123456789ab",
    date="2026-01-02",
)  # fmt: skip


def test_a_row_of_the_table_of_cards_says_the_figures_of_a_policy():
    row = CARD.row()
    assert len(row) == len(HEADINGS)
    assert row[:5] == ["DoraCube-v1", "PPO", "standard", "250k", "3"]
    assert row[5].startswith("90.0")
    assert row[6:] == ["45.5", "1.3 (limit 3)", "too much overlap 7.5 %, lost 2.5 %"]
    unknown = dataclasses.replace(CARD, zero_success_rate=None, overlap_p95_mm=None, failures={})
    assert unknown.row()[6:] == ["-", "-", "nothing in these episodes"]


def test_a_card_as_text_has_a_line_for_every_figure():
    lines = [" ".join(line.split()) for line in str(CARD).splitlines()]
    for line in (
        "guidance affordance", "task DoraCube-v1", "what it fails at too much overlap 7.5 %", "lost 2.5 %",
        "starts 200, seeds from 7000", "stages done reach 100.0 %, lift 90.5 %",
        "chosen by training 0.95 of 64 episodes, best of 4 runs", "training 12.3 minutes",
        "run DoraCube-v1/ppo-s3 (unknown commit)", "card made 2026-01-02 (0123456789ab)",
    ):  # fmt: skip
        assert line in lines, line


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([1], "is no card of a policy"),
        (plain(CARD), "its digest differs"),
        (sealed(plain(CARD) | {"minutes": float("inf")}), "minutes"),
        (sealed(plain(CARD) | {"chosen_among": 0}), "chosen_among of the card .* has to be from 1"),
        (sealed(plain(CARD) | {"colour": "red"}), "no field 'colour'"),
    ],
)
def test_what_is_no_card_is_refused(content: Any, words: str, tmp_path: Path):
    (tmp_path / "card.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        Card.read(tmp_path / "card.json")


# ------------------------------------------------------------ which runs


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    return read_checkpoint(bundled_files("DoraCube-v1")[0])


def test_only_what_gym_makes_without_options_is_usual(checkpoint: Checkpoint):
    config = checkpoint.config

    def usual(**change: Any) -> bool:
        return is_usual(dataclasses.replace(config, **change))

    assert usual()
    assert usual(task=config.task | {"lift": 0.12})
    assert config.preset == DEFAULT_PRESET
    others: list[dict[str, Any]] = [
        {"guidance": "none"}, {"guidance_parts": ("reward",)}, {"reward": "paper"}, {"preset": "hard"},
        {"task": config.task | {"optimised": True}}, {"task": config.task | {"pose_filter": 0.5}},
    ]  # fmt: skip
    assert [change for change in others if usual(**change)] == []


def test_a_run_needs_its_policy_and_an_evaluation_during_training(
    checkpoint: Checkpoint, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    found = {name: dataclasses.replace(checkpoint, progress=checkpoint.progress | {"best": best})
             for name, best in (("a", [0.5, 1.0]), ("b", [0.5, 3.0]), ("c", None), ("d", [0.9, 1.0]))}  # fmt: skip
    monkeypatch.setattr(bundle, "read_checkpoint", lambda path: found[path.parent.name])
    needed = {"env": "DoraCube-v1", "seed": 1, "eval_episodes": 5, "stage_rates": {}}
    runs = [SimpleNamespace(folder=tmp_path / name, outdated=False, result=needed) for name in found]
    for name in ("a", "b", "c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / bundle.POLICY).touch()
    runs.append(SimpleNamespace(folder=tmp_path / "a", outdated=False, result=needed | {"env": "DoraJug-v1"}))
    chosen: Any = bundle.chosen
    monkeypatch.setattr(bundle, "Choice", lambda run, checkpoint, among: (run.folder.name, among))
    chosen = getattr(chosen, "__wrapped__", chosen)
    assert chosen(runs, "DoraCube-v1") == ("b", 2), "the return decides between equal rates of success"
    assert chosen(runs, "DoraJug-v1") == ("a", 1)
    assert chosen(runs, "DoraHammer-v1") is None


# ------------------------------------------------------------ what a policy says


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({OBSERVATION, REWARD, PRIOR, FILTER, REGION}, "affordance"), ({REGION, PRIOR}, "affordance (prior alone)"),
        ({REGION, OBSERVATION, REWARD}, "affordance (observation alone)"), ({OBSERVATION, PRIOR}, "grasps"),
        ({OBSERVATION}, "grasps (observation alone)"), (set(), "none"), ({REGION, REWARD}, "affordance"),
    ],
)  # fmt: skip
def test_the_guidance_that_a_policy_meets_is_named(parts: set[str], words: str):
    assert _words(frozenset(parts)) == words


def test_a_task_without_a_policy_is_said_to_have_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    cube = bundled_files("DoraCube-v1")[0]
    monkeypatch.setattr(policy, "BUNDLED", tmp_path)
    (tmp_path / "DoraCube-v1.safetensors").write_bytes(cube.read_bytes())
    assert bundled_ids() == ["DoraCube-v1"]
    assert load_policy("DoraCube-v1").card is None
    with pytest.raises(InputError, match=r"no policy of DoraJug-v1 comes with Dora \(there are those of DoraCube-v1\)"):
        load_policy("DoraJug-v1")


def test_a_policy_says_what_it_is_and_where_it_was_trained():
    mine = dora.load_policy("DoraCube-v1")
    assert repr(mine) == f"TaskPolicy(DoraCube-v1, {mine.config.agent}, 211 -> 26)"
    assert mine.env_kwargs == {"obs_mode": "state", **mine.config.task_options}
    assert mine.card is not None
    assert mine.env_steps == mine.card.env_steps
    nothing = mine(np.zeros((0, 211)))
    assert nothing.shape == (0, 26)
    bad = torch.full((211,), float("inf"))
    bad[0], bad[1] = float("-inf"), float("nan")
    assert torch.equal(mine(bad), mine(torch.zeros(211)))
    assert mine(torch.zeros(1, 211, dtype=torch.float64)).dtype == torch.float32
    for wrong in (np.zeros((1, 1, 211)), np.zeros(212), np.zeros((2, 210))):
        with pytest.raises(InputError, match=r"takes \(211,\) or \(n, 211\)"):
            mine(wrong)
