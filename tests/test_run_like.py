"""A new run with the settings of an earlier one: `dora run --like`."""

import dataclasses
import shutil
from pathlib import Path

import pytest
from commands import load_command
from refusals import refused

from dora.agents.checkpoint import read_checkpoint
from dora.agents.runs.run_folder import RunFolder
from dora.agents.runs.stored_results import read_result
from dora.commands import run
from dora.tasks import find_task
from dora.tasks.env.options import task_config

RESULTS = Path(__file__).parents[1] / "results" / "tasks"
JUG, UNGUIDED = RESULTS / "DoraJug-v1" / "sac-affordance-s10", RESULTS / "DoraCube-v1" / "ppo-none-s10"
"""Rows of the tables: a guided one and one without guidance."""


def of(path: Path, more: str = "") -> run.Args:
    return run.parse(["--like", str(path), *more.split()])


@pytest.mark.parametrize(
    "path", sorted(RESULTS.glob("*/*-s1[0-4]")), ids=lambda path: f"{path.parent.name}-{path.name}"
)
def test_every_row_of_the_tables_can_be_trained_anew(path: Path):
    """By the rules of now: where these are those of the row, the settings have its digest."""
    args, stored = of(path), read_checkpoint(path / "policy.safetensors").config
    definition = task_config(find_task(stored.env).CONFIG, stored.preset, None).definition
    assert not args.eval_only
    assert args.run == dataclasses.replace(stored, task=args.run.task)
    assert args.run.task["definition"] == definition
    if stored.task.get("definition", definition) == definition:
        assert args.run.digest() == (read_result(path / "result.json") or {})["config_digest"]


def test_options_change_single_settings():
    usual = of(JUG).run
    changed = of(JUG, "--seed 77 --learner.gamma 0.9 --task.lift 0.12 --total-steps 5000").run
    task = usual.task | {"lift": 0.12}
    learner = dataclasses.replace(usual.learner, gamma=0.9)
    assert changed == dataclasses.replace(usual, seed=77, total_steps=5000, task=task, learner=learner)


def test_another_preset_brings_its_numbers():
    hard = of(JUG, "--preset hard").run
    assert hard.task == run.parse(["--env", "DoraJug-v1", "--preset", "hard"]).run.task
    assert hard.learner == of(JUG).run.learner


def test_a_run_folder_and_a_checkpoint_have_settings_too(tmp_path: Path):
    config = of(JUG, "--seed 5").run
    folder = RunFolder(tmp_path / "run")
    folder.create(config)  # interrupted before its first evaluation: it has no best checkpoint
    assert of(folder.path).run == config
    file = tmp_path / "a.safetensors"
    shutil.copy(JUG / "policy.safetensors", file)
    assert of(file).run == of(JUG).run
    (tmp_path / "config.yaml").write_text("env: 1")
    with refused("config.yaml"):
        of(tmp_path)


def test_a_run_of_earlier_rules_is_trained_anew_by_those_of_now(tmp_path: Path):
    config = of(RESULTS / "DoraHammer-v1" / "sac-affordance-s10").run
    assert config.task["definition"] > 1
    folder = RunFolder(tmp_path / "run")
    folder.create(dataclasses.replace(config, task=config.task | {"definition": 1}))
    assert of(folder.path).run == config


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("--env DoraCube-v1", "--env is DoraCube-v1, and the settings of .* are for DoraJug-v1"),
        ("--agent ppo", "--agent is ppo, and the settings of .* are for sac"),
        ("--guidance none", "are for corrections of a reference"),
        ("--guidance-parts observation reward", "are for corrections of a reference"),
        ("--eval-only", "--eval-only does not go with --like"),
        ("--checkpoint x.safetensors", "--checkpoint does not go with --like"),
        ("--resume runs/x", "--like does not go with --resume"),
        ("--preset nope", "unknown preset 'nope'"),
        ("--learner.gamma 2", "--learner.gamma is 2"),
    ],
)
def test_what_does_not_go_with_those_settings_is_refused(more: str, words: str):
    with refused(words):
        of(JUG, more)


def test_settings_without_a_reference_are_refused_for_one_and_taken_for_other_parts():
    assert of(UNGUIDED, "--guidance affordance --guidance-parts reward").run.guidance_parts == ("reward",)
    with refused("are for actions without a reference"):
        of(UNGUIDED, "--guidance affordance")


def test_the_same_task_and_learner_may_be_named():
    assert of(JUG, "--env DoraJug-v1 --agent sac") == of(JUG)
    assert of(JUG, "--guidance grasps").run.guidance == "grasps"


def test_what_is_no_run_is_refused(tmp_path: Path):
    with refused("best.safetensors"):
        of(tmp_path)
    with refused("x.safetensors"):
        of(tmp_path / "x.safetensors")


def test_a_stored_result_is_evaluated_by_its_folder():
    folder, file = (
        load_command("run").parse(["--eval-only", "--checkpoint", str(p)]) for p in (JUG, JUG / "policy.safetensors")
    )
    assert folder.run == file.run
