"""The run command refuses bad input with one sentence and exit status 2."""

import json
from pathlib import Path
from types import ModuleType

import pytest
from commands import call, load_command

from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import LEARNER_CONFIGS
from dora.agents.evaluation.play import load_policy
from dora.agents.runs.presets import PRESETS, recommended
from dora.agents.runs.run_folder import RunFolder

COMMITTED = sorted((Path(__file__).parents[1] / "results").rglob("policy.safetensors"))
"""Policies of the results that the README shows."""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_command("run")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "--env"),
        ("--env Nope-v1", "unknown environment 'Nope-v1'"),
        ("--env DoraCub-v1", "did you mean DoraCube-v1?"),
        ("--env DoraCube-v1 --num-envs 0", "--num-envs is 0"),
        ("--env DoraCube-v1 --total-steps -5", "--total-steps is -5"),
        ("--env DoraCube-v1 --workers -1", "--workers is -1"),
        ("--env DoraCube-v1 --noise-correlation 1", "--noise-correlation is 1.0"),
        ("--env DoraCube-v1 --agent mappo", "two arms"),
        ("--resume /nowhere", "not a run folder"),
        ("--eval-only", "--checkpoint"),
        ("--eval-only --checkpoint /nowhere.safetensors", "no checkpoint"),
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
    assert call(script, monkeypatch, *arguments.split()) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""


@pytest.mark.parametrize("arguments", ["--agent foo", "--no-such-option 1"])
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
    chosen = {env: recommended(env) for env in ("DoraCube-v1", "DoraJug-v1", "DoraHammer-v1", "PickCube-v1")}
    assert [config.agent for config in chosen.values()] == ["ppo", "sac", "sac", "ppo"]
    for config in chosen.values():
        assert isinstance(config.learner, LEARNER_CONFIGS[config.agent])
    assert chosen["DoraJug-v1"].total_steps == PRESETS["DoraJug-v1", "sac"]["total_steps"]
    assert recommended("DoraJug-v1", "ppo").agent == "ppo"


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parts[-3]}/{path.parts[-2]}")
def test_a_bundled_policy_is_that_of_the_result_beside_it(path: Path):
    checkpoint, result = read_checkpoint(path), json.loads((path.parent / "result.json").read_text())
    load_policy(checkpoint, path)
    assert (checkpoint.config.env, checkpoint.config.seed) == (result["env"], result["seed"])
    assert checkpoint.config.task.get("preset") == result.get("task", {}).get("preset")
    assert checkpoint.config.digest() == result["config_digest"]


def test_a_bundled_policy_can_be_evaluated_alone(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    policy = next(path for path in COMMITTED if "DoraCube-v1" in path.parts)
    arguments = f"--eval-only --checkpoint {policy} --episodes 4 --workers 1 --preset none --out {tmp_path / 'eval'}"
    assert call(script, monkeypatch, *arguments.split()) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'eval'}\n"
    assert "evaluation on 4 episodes" in captured.err
    assert "success 1.000, without any correction 1.000" in captured.err
    result = json.loads((tmp_path / "eval" / "result.json").read_text())
    assert (result["success_rate"], result["eval_episodes"], result["task"]) == (1.0, 4, {"preset": "none"})
    assert result["workers"] == 1
