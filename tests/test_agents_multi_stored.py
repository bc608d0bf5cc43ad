"""Checkpoints of MAPPO and HAPPO, what is refused about agents, and what tasks recommend for several of them."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
from fake_task import PointMass, TwoPoints
from safetensors.torch import load_file
from test_agents_multi import AGENTS, BOTH, SIZES, learner_of
from test_agents_train import BASE

from dora.agents.agent_columns import MOST_AGENTS, AgentColumns, checked_agents
from dora.agents.checkpoint import Checkpoint, check_belongs, read_checkpoint
from dora.agents.collecting.task_env import TaskEnv
from dora.agents.config import HAPPOConfig, MAPPOConfig
from dora.agents.evaluation.play import load_policy
from dora.agents.learners.multi_agent import MultiAgentPPO
from dora.agents.runs.recommended import recommended
from dora.errors import InputError
from dora.files import write_safetensors


@pytest.fixture
def stored(tmp_path: Path) -> tuple[Path, MultiAgentPPO]:
    """A checkpoint of two agents, and the learner that it holds."""
    learner, config = learner_of(), dataclasses.replace(BASE, agent="happo", learner=BOTH["happo"])
    tensors = {f"{k}/{n}": v for k, m in learner.policy.modules_by_name.items() for n, v in m.state_dict().items()}
    Checkpoint(config, SIZES, tensors, agents=AGENTS).write(tmp_path / "a.safetensors")
    return tmp_path / "a.safetensors", learner


def test_a_checkpoint_acts_without_its_task(stored: tuple[Path, MultiAgentPPO]):
    path, learner = stored
    checkpoint = read_checkpoint(path)
    assert checkpoint.agents == AGENTS
    observation = torch.randn(6, SIZES[0])
    assert torch.equal(load_policy(checkpoint, path).greedy(observation), learner.policy.greedy(observation))


def test_checkpoints_of_other_agents_are_refused(stored: tuple[Path, MultiAgentPPO]):
    path, _ = stored
    checkpoint = read_checkpoint(path)
    check_belongs(checkpoint, path, checkpoint.config, SIZES, AGENTS, exactly=True)
    swapped = {"right": AGENTS["right"], "left": AGENTS["left"]}
    fewer = AGENTS | {"left": AgentColumns((0, 1), (0, 1))}
    for agents, words in ((swapped, "agents left, right, not right, left"), (None, "not none"), (fewer, "of left")):
        with pytest.raises(InputError, match=words):
            check_belongs(checkpoint, path, checkpoint.config, SIZES, agents, exactly=False)


LEFT, RIGHT = TwoPoints(2).agent_columns.values()
WRONG: dict[str, Any] = {
    "a mapping": [1, 2],
    "an agent called": {"": LEFT, "right": RIGHT},
    "an agent called '": {"a.b": LEFT, "right": RIGHT},
    "an agent called 'pop'": {"pop": LEFT, "right": RIGHT},
    "two lists of columns for left": {"left": [[0]], "right": RIGHT},
    "of the observation of left": {"left": [[0, 9], [0, 1]], "right": RIGHT},
    "as columns of the observation": {"left": [[], [0, 1]], "right": RIGHT},
    "different whole numbers": {"left": [[0, 0], [0, 1]], "right": RIGHT},
    "from 0 to 3 as columns of the action": {"left": [[0], [0, -1]], "right": RIGHT},
    "columns of the action of left": {"left": [[0], [0, True]], "right": RIGHT},
    "of the action of left": {"left": [[0], "01"], "right": RIGHT},
    "column 1 of the action to 0 agents": {"left": [[0], [0]], "right": RIGHT},
    "column 2 of the action to 2 agents": {"left": [[0], [0, 1, 2]], "right": RIGHT},
}
"""Agents that do not fit, by what is said of them."""


@pytest.mark.parametrize("words", WRONG)
def test_wrong_agents_are_refused_in_one_sentence(stored: tuple[Path, MultiAgentPPO], words: str):
    """In a checkpoint whose digest is right, and of a task."""
    from safetensors import safe_open

    path, _ = stored
    with safe_open(path, framework="pt") as stream:
        header = stream.metadata()
    write_safetensors(path, load_file(path), header | {"agents": json.dumps(WRONG[words])})
    with pytest.raises(InputError, match=words) as error:
        read_checkpoint(path)
    assert "\n" not in str(error.value)
    task = TwoPoints(2)
    task.agent_columns = WRONG[words]
    with pytest.raises(InputError, match=f"agent_columns of the task.*{words}"):
        _ = TaskEnv(task).agents


@pytest.mark.parametrize("count", [64, 65])
def test_a_task_has_at_most_sixty_four_agents(count: int):
    agents = {f"arm{k}": ([0], [k]) for k in range(count)}
    if count <= MOST_AGENTS:
        assert list(checked_agents(agents, (1, count), "the test")) == list(agents)
    else:
        with pytest.raises(InputError, match="at most 64 names"):
            checked_agents(agents, (1, count), "the test")


def test_tasks_that_name_no_agents_have_none():
    assert TaskEnv(PointMass(2)).agents == {}
    assert TaskEnv(TwoPoints(2)).agents == AGENTS


# ---- settings ------------------------------------------------------------------------------------


def test_what_a_task_recommends_for_ppo_holds_for_them():
    table = {"sac": {}, "ppo": {"num_envs": 7, "learner": {"log_std": -1.5}}, "happo": {"num_envs": 9}}
    mappo, happo = (recommended("Fake-v1", name, table) for name in BOTH)
    assert (mappo.num_envs, mappo.learner) == (7, MAPPOConfig(log_std=-1.5))
    assert (happo.num_envs, happo.learner) == (9, HAPPOConfig())
    assert recommended("Fake-v1", None, table).agent == "sac"
    with pytest.raises(InputError, match="one of sac"):
        recommended("Fake-v1", "mappo", {"sac": {}})
