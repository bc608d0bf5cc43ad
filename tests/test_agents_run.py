"""The run command refuses bad input with one sentence and exit status 2."""

import dataclasses
import json
import os
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from commands import call, load_command, refusal
from fake_task import PointMass

import dora.agents
from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import (
    LEARNER_CONFIGS,
)
from dora.agents.evaluation.evaluate import FINAL_SEED, first_seed
from dora.agents.evaluation.play import load_policy
from dora.agents.runs.recommended import learners_of, recommended
from dora.agents.runs.run_folder import RunFolder
from dora.commands import run
from dora.configs import plain
from dora.errors import RECORDS, InputError
from dora.tasks import find_task, make_task
from dora.tasks.cube import CubeConfig, paper_terms
from dora.tasks.env.options import task_config
from dora.tasks.mdp.randomisation import PRESETS

COMMITTED = sorted((Path(__file__).parents[1] / "results").rglob("policy.safetensors"))
"""Policies of the results that the README shows."""
FIRST = Path(dora.agents.__file__).parent / "first_numbers.yaml"
"""Numbers of runs whose settings hold none."""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_command("run")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "--env"),
        ("--env Nope-v1", "unknown environment 'Nope-v1'"),
        ("--env DoraCub-v1", "did you mean 'DoraCube-v1'?"),
        ("--env DoraCube-v1 --num-envs 0", "--num-envs is 0"),
        ("--env DoraCube-v1 --guidance x", "unknown guidance 'x'"),
        ("--env DoraCube-v1 --guidance-parts reward x", "unknown guidance part 'x'"),
        ("--env DoraCube-v1 --total-steps -5", "--total-steps is -5"),
        ("--env DoraCube-v1 --workers -1", "--workers is -1"),
        ("--env DoraCube-v1 --learner.noise-correlation 1", "--learner.noise-correlation is 1.0"),
        ("--env DoraCube-v1 --agent trpo", "use --agent with one of sac, ppo, mappo, happo"),
        ("--resume /nowhere", "not a run folder"),
        (
            "--env DoraCube-v1 --agent ppo --learner.learning-rate-min 0.1 --learner.learning-rate-max 0.01",
            "has to be the smaller",
        ),
        (
            "--env DoraCube-v1 --agent ppo --learner.log-std -4",
            "--learner.log-std-min is -3.0 and --learner.log-std -4.0",
        ),
        ("--env DoraCube-v1 --agent sac --learner.capacity 5", "--learner.capacity is 5"),
        ("--eval-only", "--checkpoint"),
        ("--eval-only --zero-correction", "--env"),
        ("--eval-only --zero-correction --env DoraCube-v1 --guidance none", "nothing to correct"),
        ("--eval-only --zero-correction --env DoraCube-v1 --seed 200000", "seeds from 0 to 199999"),
        ("--eval-only --zero-correction --env DoraCube-v1 --seed 1 --episodes 10001", "has to be from 1 to 10000"),
        ("--eval-only --checkpoint /nowhere.safetensors", "no checkpoint"),
        (
            f"--eval-only --checkpoint {COMMITTED[0]} --episodes 10001",
            "--episodes is 10001 and has to be from 1 to 10000",
        ),
        ("--eval-only --zero-correction --env DoraCube-v1 --learner.gamma 0.5", "--learner.* has no effect"),
        ("--eval-only --zero-correction --env DoraCube-v1 --total-steps 5", "--total-steps has no effect"),
        ("--eval-only --zero-correction --env DoraCube-v1 --num-envs 5", "--num-envs has no effect"),
        ("--eval-only --zero-correction --env DoraCube-v1 --learner-threads 3", "--learner-threads has no effect"),
        ("--eval-only --zero-correction --env DoraCube-v1 --collector ray", "--collector has no effect"),
        ("--env DoraCube-v1 --checkpoint missing", "--eval-only"),
    ],
)
def test_bad_input(
    script: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    words: str,
):
    assert words in refusal(script, monkeypatch, capsys, arguments)


@pytest.mark.parametrize("arguments", ["--env DoraCube-v1 --seed x", "--env DoraCube-v1 --no-such-option 1"])
def test_errors_of_the_parser(script: ModuleType, monkeypatch: pytest.MonkeyPatch, arguments: str):
    with pytest.raises(SystemExit) as exit_info:
        call(script, monkeypatch, *arguments.split())
    assert exit_info.value.code == 2


def test_resume_refuses_another_task(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    RunFolder(tmp_path).create(recommended("DoraCube-v1", "ppo"))
    assert call(script, monkeypatch, "--resume", str(tmp_path), "--env", "DoraJug-v1") == 2
    assert "has env DoraCube-v1, not DoraJug-v1" in capsys.readouterr().err


def test_a_bare_command_takes_the_learner_recommended_for_the_task():
    chosen = {env: run.parse(["--env", env]).run for env in ("DoraCube-v1", "DoraJug-v1", "DoraHammer-v1")}
    assert [config.agent for config in chosen.values()] == ["sac", "sac", "sac"]
    for env, config in chosen.items():
        assert isinstance(config.learner, LEARNER_CONFIGS[config.agent])
        assert config.total_steps == find_task(env).LEARNERS[config.agent]["total_steps"]
    assert run.parse(["--env", "DoraJug-v1", "--agent", "ppo"]).run.agent == "ppo"
    assert recommended("PickCube-v1").agent == "ppo"


@pytest.mark.parametrize(
    ("words", "like"),
    [
        ("--env DoraJug-v1 --env DoraCube-v1", "--env DoraCube-v1"),
        ("--env=DoraCube-v1 --preset none --preset=hard", "--env DoraCube-v1 --preset hard"),
        ("--env DoraCube-v1 --agent ppo --agent sac", "--env DoraCube-v1 --agent sac"),
        ("--env DoraCube-v1 --guidance=none", "--env DoraCube-v1 --guidance none"),
        ("--env DoraCube-v1 --guidance_parts reward filter", "--env DoraCube-v1 --guidance-parts reward filter"),
        ("--env DoraJug-v1 --guidance-parts prior --guidance-parts=reward", "--env DoraJug-v1 --guidance-parts=reward"),
        ("--eval_only --zero_correction --env=DoraCube-v1", "--eval-only --zero-correction --env DoraCube-v1"),
        ("--eval-only --checkpoint {} --seed=3", "--eval-only --checkpoint {} --seed 3"),
    ],
)  # fmt: skip
def test_every_spelling_of_an_option_is_the_same(words: str, like: str):
    assert run.parse(words.format(COMMITTED[0]).split()) == run.parse(like.format(COMMITTED[0]).split())


def test_an_evaluation_under_another_preset_has_all_numbers_of_it():
    for env_id in ("DoraJug-v1", "DoraMicrowave-v1"):
        path = next(path for path in COMMITTED if path.parents[1].name == env_id and "hard" not in path.parent.name)
        config = run.parse(f"--eval-only --checkpoint {path} --preset hard".split()).run
        wanted = task_config(find_task(env_id).CONFIG, "hard", None)
        assert config.task["randomisation"] == plain(wanted.randomisation)
        assert config.task["pose_filter"] == wanted.pose_filter


def test_settings_of_training_do_not_change_an_evaluation(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = f"--eval-only --checkpoint {COMMITTED[0]}"
    assert "--env has no effect" in refusal(script, monkeypatch, capsys, f"{words} --env PickCube-v1")
    assert "--agent has no effect" in refusal(script, monkeypatch, capsys, f"{words} --agent happo")


def test_every_number_of_task_and_learner_is_an_option():
    words = "--env DoraCube-v1 --preset hard --task.lift 0.12 --task.weights.lift 2 --learner.gamma 0.9"
    config = run.parse([*words.split(), "--task.randomisation.push", "0.1"]).run
    assert (config.task["lift"], config.task["weights"]["lift"], config.learner.gamma) == (0.12, 2.0, 0.9)
    assert config.task["randomisation"] == plain(PRESETS["hard"]) | {"push": 0.1}
    assert config.digest() != run.parse(["--env", "DoraCube-v1"]).run.digest()
    task = make_task("DoraCube-v1", 1, **config.task_options)
    assert isinstance(task.config, CubeConfig)
    assert (task.config.lift, task.terms.terms["lift"].weight, task.config.randomisation.push) == (0.12, 2.0, 0.1)
    task.close()


@pytest.mark.parametrize("words", ["", "--env DoraCube-v1", "--env DoraJug-v1 --agent ppo"])
def test_help_shows_the_defaults_of_the_chosen_task(words: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        run.parse([*words.split(), "--help"])
    shown = re.sub(r"[\s│]+", " ", capsys.readouterr().out)
    env = words.split()[1] if words else run.SHOWN
    learners = find_task(env).LEARNERS
    agent = words.split()[3] if "--agent" in words else next(iter(learners))
    assert f"(default: {env})" in shown
    budget = "--total-steps INT Budget in environment steps, summed over all environments."
    assert f"{budget} (default: {learners[agent]['total_steps']})" in shown
    assert f"{{{','.join(learners_of(learners))}}}" in shown
    assert "--task.weights.penetration" in shown


def test_a_run_goes_on_with_the_numbers_of_its_folder(tmp_path: Path):
    config = run.parse(["--env", "DoraCube-v1", "--task.lift", "0.12", "--learner.gamma", "0.9"]).run
    RunFolder(tmp_path).create(config)
    again = run.parse(["--resume", str(tmp_path), "--total-steps", "7"]).run
    assert again == dataclasses.replace(config, total_steps=7)
    run.refuse_other_settings(tmp_path, config, again)
    other = run.parse(["--resume", str(tmp_path), "--task.lift", "0.1"]).run
    with pytest.raises(InputError, match="has task"):
        run.refuse_other_settings(tmp_path, config, other)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lerner": {}}, "lerner"),
        ({"seed": "zero"}, "seed must be int, not 'zero'"),
        ({"learner": {"gama": 0.9}}, "did you mean 'gamma'"),
        ({"learner": {"gamma": "high"}}, "gamma must be float"),
        ({"agent": "dqn"}, "learner 'dqn'"),
        ({"task": [1]}, "mapping"),
        ({"task": {"lifd": 0.1}}, "did you mean 'lift'"),
        ({"task": {"lift": "high"}}, "lift must be float"),
    ],
)
def test_settings_of_a_folder_are_checked(tmp_path: Path, change: dict[str, Any], words: str):
    folder = RunFolder(tmp_path)
    folder.create(run.parse(["--env", "DoraCube-v1"]).run)
    content = yaml.safe_load((tmp_path / "config.yaml").read_text())
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(content | change))
    with pytest.raises(InputError, match=words):
        run.parse(["--resume", str(tmp_path)])


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parts[-3]}/{path.parts[-2]}")
def test_a_bundled_policy_is_that_of_the_result_beside_it(path: Path):
    checkpoint, result = read_checkpoint(path), json.loads((path.parent / "result.json").read_text())
    load_policy(checkpoint, path)
    assert (checkpoint.config.env, checkpoint.config.seed) == (result["env"], result["seed"])
    task = result if "preset" in result else result.get("task", {})
    assert checkpoint.config.preset == task.get("preset", "standard")
    if "checkpoint" in result:  # evaluated again, on more episodes
        assert result["checkpoint"] == str(path.relative_to(Path(__file__).parents[1]))
    else:
        assert checkpoint.config_digest == result["config_digest"]


def test_a_bundled_policy_can_be_evaluated_alone(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    policy = next(path for path in COMMITTED if path.parts[-3:-1] == ("DoraCube-v1", "ppo-affordance-s10"))
    arguments = f"--eval-only --checkpoint {policy} --episodes 4 --workers 1 --preset none --out {tmp_path / 'eval'}"
    assert call(script, monkeypatch, *arguments.split()) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'eval'}\n"
    assert "evaluation on 4 episodes" in captured.err
    assert "success 1.000 [0.510, 1.000], penetration" in captured.err
    result = json.loads((tmp_path / "eval" / "result.json").read_text())
    assert (result["success_rate"], result["eval_episodes"], result["preset"]) == (1.0, 4, "none")
    assert result["workers"] == 1
    assert (result["zero_success_rate"], result["first_seed"]) == (None, FINAL_SEED)
    assert result["success_interval"] == pytest.approx([0.5101, 1.0], abs=1e-4)
    assert (result["raw_success_rate"], result["success_at_end_rate"], result["nonfinite_episodes"]) == (1.0, 1.0, 0)
    assert 0 < result["steps_to_50"] <= result["steps_to_80"] <= result["env_steps"]


@pytest.fixture
def point_mass(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands get a point mass in place of the task that they name."""
    monkeypatch.setattr(run, "make_task", lambda env, num_envs, **options: PointMass(num_envs))


def rows(folder: Path) -> list[str]:
    """Lines of the episodes of an evaluation."""
    return (folder / "eval.csv").read_text().splitlines()[1:]


@pytest.mark.usefixtures("point_mass")
def test_a_seed_chooses_the_starts_of_an_evaluation(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    words = "--env DoraCube-v1 --total-steps 2048 --num-envs 16 --workers 0 --episodes 5 --no-zero-correction --out"
    assert call(script, monkeypatch, *words.split(), str(tmp_path / "run")) == 0
    trained = json.loads((tmp_path / "run" / "result.json").read_text())
    assert trained["zero_success_rate"] is None
    evaluate = ["--eval-only", "--checkpoint", str(tmp_path / "run"), "--workers", "1"]
    more = {"same": "", "a": "--seed 3", "b": "--seed 3 --episodes 9 --zero-correction", "c": "--seed 4"}
    for name, options in more.items():
        assert call(script, monkeypatch, *evaluate, "--out", str(tmp_path / name), *options.split()) == 0
    results = {name: json.loads((tmp_path / name / "result.json").read_text()) for name in more}
    assert rows(tmp_path / "same") == rows(tmp_path / "run")  # without a seed those of the end of training
    assert rows(tmp_path / "a") == rows(tmp_path / "b")[:5]
    assert len({rows(tmp_path / name)[0] for name in ("same", "a", "c")}) == 3
    assert [results[name]["zero_success_rate"] is None for name in more] == [True, True, False, True]
    assert (results["a"]["seed"], results["a"]["first_seed"]) == (3, first_seed(3, 5))
    assert os.environ[RECORDS] == str(tmp_path / "c" / "nonfinite")  # where an evaluation puts its last states
    assert results["a"]["checkpoint"] == str(tmp_path / "run" / "checkpoints" / "best.safetensors")
    assert (trained["seed"], results["a"]["policy_seed"]) == (0, 0)  # of the policy, not of the starts
    assert {result["policy_digest"] for result in (trained, *results.values())} == {trained["policy_digest"]}


@pytest.mark.usefixtures("point_mass")
def test_a_run_that_has_ended_is_not_evaluated_again(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    words = "--env DoraCube-v1 --total-steps 2048 --num-envs 16 --workers 0 --episodes 5 --no-zero-correction --out"
    folder = str(tmp_path / "run")
    assert call(script, monkeypatch, *words.split(), folder) == 0
    before = (tmp_path / "run" / "result.json").read_bytes()
    assert call(script, monkeypatch, "--resume", folder, "--no-zero-correction") == 2
    assert "has ended, its figures are in result.json" in capsys.readouterr().err.splitlines()[-1]
    assert (tmp_path / "run" / "result.json").read_bytes() == before
    assert call(script, monkeypatch, "--resume", folder, "--no-zero-correction", "--total-steps", "4096") == 0
    assert json.loads((tmp_path / "run" / "result.json").read_text())["env_steps"] >= 4096


@pytest.mark.usefixtures("point_mass")
def test_a_film_comes_before_the_evaluation_that_was_asked_for_with_it(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(run, "film", lambda path, config, film, seed: print("film", film.name, seed, file=sys.stderr))
    words = "--eval-only --zero-correction --env DoraCube-v1 --seed 1 --episodes 3 --workers 1 --video"
    assert call(script, monkeypatch, *words.split(), "--out", str(tmp_path / "zero")) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == f"film zero.mp4 {first_seed(1, 3)}"
    assert lines[1:3] == ["evaluation on 3 episodes ...", lines[2]]
    assert lines[2].startswith("without any correction: success ")


def test_zero_correction_of_a_task_is_evaluated_without_any_policy(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    words = "--eval-only --zero-correction --env DoraCube-v1 --preset none --episodes 2 --workers 1"
    assert call(script, monkeypatch, *words.split(), "--out", str(tmp_path / "zero")) == 0
    result = json.loads((tmp_path / "zero" / "result.json").read_text())
    assert (result["agent"], result["success_rate"], result["zero_success_rate"]) == ("zero", 1.0, 1.0)
    assert (result["env_steps"], result["steps_to_50"], result["eval_episodes"]) == (0, None, 2)


def test_the_reward_of_the_paper_trains(script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    words = (
        "--env DoraCube-v1 --agent ppo --reward paper --total-steps 128 --num-envs 8 --workers 0 --episodes 2 "
        "--eval-envs 2 --no-zero-correction --learner.rollout 16 --learner.minibatch 64"
    )
    assert call(script, monkeypatch, *words.split(), "--out", str(tmp_path / "run")) == 0
    config = RunFolder(tmp_path / "run").read_config()
    assert (config.reward, config.task_options["reward_mode"]) == ("paper", "paper")
    assert json.loads((tmp_path / "run" / "result.json").read_text())["reward"] == "paper"
    header = (tmp_path / "run" / "eval.csv").read_text().splitlines()[0].split(",")
    assert [name.removeprefix("reward/") for name in header if name.startswith("reward/")] == [
        *paper_terms(CubeConfig()).terms
    ]
