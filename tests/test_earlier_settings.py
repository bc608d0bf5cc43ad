"""Settings, digests and policies that earlier versions stored: what they mean now."""

import copy
import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

import dora.agents
from dora.agents.checkpoint import read_checkpoint
from dora.agents.config import (
    NEUTRAL,
    NEUTRAL_LEARNER,
    NOT_USUAL,
    UNUSED,
    config_from_dict,
    stored_digests,
)
from dora.agents.runs.recommended import recommended
from dora.agents.runs.run_folder import RunFolder
from dora.commands import run
from dora.configs import plain
from dora.digests import digest_of
from dora.errors import InputError
from dora.tasks import find_task
from dora.tasks.env.options import task_config

COMMITTED = sorted((Path(__file__).parents[1] / "results").rglob("policy.safetensors"))
FIRST = Path(dora.agents.__file__).parent / "first_numbers.yaml"


def test_policies_from_before_poses_were_filtered_meet_poses_as_measured():
    path = next(path for path in COMMITTED if path.parent.name == "sac-affordance-hard-s10")
    content: dict[str, Any] = plain(read_checkpoint(path).config)
    assert content["task"].pop("pose_filter") < 1
    config = config_from_dict(content)
    numbers: Any = task_config(find_task(config.env).CONFIG, config.preset, config.task)
    assert (config.preset, numbers.pose_filter) == ("hard", 1.0)
    assert find_task(config.env).CONFIG.BY_PRESET["hard"]["pose_filter"] < 1


@pytest.mark.parametrize(
    ("options", "equal"),
    [
        ("", False), ("--guidance grasps", False), ("--guidance none", True),
        ("--guidance-parts prior reward", True), ("--guidance-parts observation", False),
    ],
)  # fmt: skip
def test_a_candidate_that_nobody_observes_does_not_change_the_digest(options: str, equal: bool):
    config = run.parse(["--env", "DoraHammer-v1", *options.split()]).run
    seen, unseen = (dataclasses.replace(config, task=config.task | {"observe_candidate": it}) for it in (True, False))
    assert (seen.digest() == unseen.digest()) == equal
    before = dataclasses.replace(config, task={k: v for k, v in config.task.items() if k != "observe_candidate"})
    assert unseen.digest() == before.digest()
    assert config_from_dict(plain(before)).task["observe_candidate"] is False


def test_a_policy_is_evaluated_by_the_rules_of_now(tmp_path: Path):
    """Whatever rules it was trained by; its digest says that these are others."""
    path = next(path for path in COMMITTED if path.parents[1].name == "DoraHammer-v1")
    checkpoint = read_checkpoint(path)
    earlier = dataclasses.replace(checkpoint.config, task=checkpoint.config.task | {"definition": 1})
    old = dataclasses.replace(checkpoint, config=earlier, config_digest=earlier.digest())
    old.write(tmp_path / "old.safetensors")
    assert run.parse(f"--eval-only --checkpoint {tmp_path / 'old.safetensors'}".split()).run.task["definition"] == 2


def test_settings_of_earlier_versions_can_be_read_and_are_refused_for_new_runs(tmp_path: Path):
    stored = recommended("DoraCube-v1", "ppo")
    wide = dataclasses.replace(stored, final_episodes=20_000, learner=dataclasses.replace(stored.learner, log_std=0.3))
    RunFolder(tmp_path).create(wide)
    assert RunFolder(tmp_path).read_config() == wide
    assert run.parse(["--resume", str(tmp_path)]).run.final_episodes == 20_000
    for option, value in (("--episodes", "20000"), ("--eval-episodes", "20000"), ("--learner.log-std", "0.3")):
        with pytest.raises(InputError, match=option):
            run.parse(["--env", "DoraCube-v1", "--agent", "ppo", option, value])


@pytest.mark.parametrize("path", COMMITTED, ids=lambda path: f"{path.parts[-3]}/{path.parts[-2]}")
def test_policies_of_versions_without_numbers_mean_the_numbers_of_then(path: Path):
    config = read_checkpoint(path).config
    task = find_task(config.env).CONFIG
    known = json.loads((path.parent / "result.json").read_text()).get("task_config")
    if known is not None:  # a later version, which says its numbers
        known = NOT_USUAL | known
        assert task_config(task, config.preset, config.task) == task_config(task, config.preset, known)
        return
    first = yaml.safe_load(FIRST.read_text())
    assert config.task == first["tasks"][config.env] | {"randomisation": first["presets"][config.preset]}
    task_config(task, config.preset, config.task)  # every name is known


def test_settings_without_a_reward_mean_the_dense_one_and_keep_their_digest():
    config = run.parse(["--env", "DoraCube-v1"]).run
    content = copy.deepcopy(plain(config))
    assert {name: content.pop(name) for name in UNUSED} == UNUSED
    assert config_from_dict(content) == config
    del content["total_steps"]
    whole = digest_of(content)[:12]
    there = {name: value for name, value in NEUTRAL.items() if name in content["task"]}
    assert {name: content["task"].pop(name) for name in there} == there
    assert len(there) > 1
    neutral = NEUTRAL_LEARNER["sac"]
    assert {name: content["learner"].pop(name) for name in neutral} == neutral
    assert config.digest() == digest_of(content)[:12] == stored_digests(content)[0]
    assert whole in stored_digests(plain(config))
    weaker = dataclasses.replace(config, task=config.task | {"arm_effort": 0.5})
    assert weaker.digest() != config.digest()
    assert config.digest() != run.parse(["--env", "DoraCube-v1", "--reward", "paper"]).run.digest()
