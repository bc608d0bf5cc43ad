"""The run command refuses bad input with one sentence and exit status 2."""

from pathlib import Path
from types import ModuleType

import pytest
from commands import call, load_command

from dora.agents.config import LEARNER_CONFIGS
from dora.agents.presets import PRESETS, recommended
from dora.agents.runfolder import RunFolder


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
