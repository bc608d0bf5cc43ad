"""Arms as agents: columns of observation and action, PettingZoo, and MAPPO and HAPPO on the toy task of two arms."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from dora.errors import InputError
from dora.tasks.mdp.observations import columns_by_arm

ROOT = Path(__file__).parents[1]
PRELUDE = """
import json, sys
import numpy as np, torch
import dora.tasks
dora.tasks.__path__.append({toys!r})
import importlib
importlib.import_module("dora.tasks.pair")
torch.set_num_threads(1)
"""
"""Puts the toy task of two arms beside the others, in a process of its own."""


def in_process(program: str) -> Any:
    """What a program with the toy task prints last, as JSON."""
    code = PRELUDE.format(toys=str(ROOT / "tests" / "toys")) + program
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


def test_an_arm_sees_its_own_entries_and_the_shared_ones():
    sizes = {"left/q": 2, "left/goal": 1, "right/q": 2, "right/goal": 1, "stage": 1, "time": 1}
    columns = columns_by_arm(["left", "right"], sizes)
    assert columns == {"left": [0, 1, 2, 6, 7], "right": [3, 4, 5, 6, 7]}
    assert columns_by_arm(["arm"], {"q": 2, "stage": 1}) == {"arm": [0, 1, 2]}


@pytest.mark.slow
def test_columns_of_two_arms_are_those_of_their_entries():
    found = in_process("""
from dora.agents.collecting.task_env import TaskEnv
from dora.tasks import make_task
task = make_task("DoraPair-v1", 2)
obs, _ = task.reset(seed=0)
columns = task.agent_columns
names, start = {}, 0
for name, entry in task.observation_entries.items():
    value = entry.value(task.observed)
    names |= dict.fromkeys(range(start, start + value.shape[-1]), name)
    assert torch.equal(obs[:, start : start + value.shape[-1]], value)
    start += value.shape[-1]
seen = {arm: sorted({names[k] for k in observed}) for arm, (observed, _) in columns.items()}
def targets(values):
    task.reset(seed=0)
    task.step(values)
    return {arm: own.agent.wrist_controller.target.clone() for arm, own in task.arms.items()}
action = torch.zeros(2, task.action_size)
still = targets(action)
action[:, columns["right"][1]] = 1.0
moved = {arm: (target - still[arm]).abs().max().item() for arm, target in targets(action).items()}
agents = TaskEnv(task).agents
print(json.dumps({"seen": seen, "action": {a: c[1] for a, c in columns.items()}, 
    "sizes": [obs.shape[1], task.action_size],
    "moved": moved, "agents": [[a, len(c.observation), len(c.action)] for a, c in agents.items()],
    "counts": {a: len(c[0]) for a, c in columns.items()}}))
""")
    shared = {"max_penetration", "stage", "time"}
    for arm, other in (("left", "right"), ("right", "left")):
        assert shared < set(found["seen"][arm])
        assert all(name in shared or name.startswith(f"{arm}/") for name in found["seen"][arm])
        assert f"{other}/hand_q" not in found["seen"][arm]
    assert sum(found["counts"].values()) == found["sizes"][0] + len(shared)
    assert found["action"] == {"left": list(range(26)), "right": list(range(26, 52))}
    assert found["moved"]["left"] == 0 < found["moved"]["right"]
    assert found["agents"] == [[arm, found["counts"][arm], 26] for arm in ("left", "right")]


# ---- PettingZoo ----------------------------------------------------------------------------------

needs_pettingzoo = pytest.mark.skipif(
    importlib.util.find_spec("pettingzoo") is None, reason="PettingZoo is not installed"
)


@needs_pettingzoo
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pettingzoo_says_that_it_is_a_parallel_environment():
    """Its own tests of interface and of seeds, and what the batch gives for the same actions."""
    found = in_process("""
import warnings
from pettingzoo.test import parallel_api_test, parallel_seed_test
from dora.integrations.batches import make_batch
from dora.integrations.pettingzoo import make

warnings.simplefilter("error", UserWarning)
warnings.filterwarnings("ignore", module="gymnasium")
env = make("DoraPair-v1", max_episode_steps=5)
parallel_api_test(env, num_cycles=20)
parallel_seed_test(lambda: make("DoraPair-v1", max_episode_steps=5), num_cycles=6)
first, infos = env.reset(seed=3)
generator = np.random.default_rng(0)
actions = {name: generator.uniform(-1, 1, env.action_space(name).shape).astype(np.float32) for name in env.agents}
obs, reward, terminated, truncated, info = env.step(actions)
joint = env.state()
shapes = {name: [env.observation_space(name).shape[0], env.action_space(name).shape[0]] for name in env.agents}
inside = all(env.observation_space(name).contains(obs[name]) for name in env.agents)
ends = [list(env.agents)]
while env.agents:
    truncated = env.step(actions)[3]
    ends.append(list(env.agents))
batch = make_batch("DoraPair-v1", 1, {"max_episode_steps": 5})
start, _ = batch.reset(seed=3)
columns = batch.get_wrapper_attr("agent_columns")
after, earned, *_ = batch.step(np.concatenate([actions["left"], actions["right"]]))
same = [bool((after[0].numpy() == joint).all())]
same += [bool((start[0].numpy()[c[0]] == first[name]).all()) for name, c in columns.items()]
same += [bool((after[0].numpy()[c[0]] == obs[name]).all()) for name, c in columns.items()]
print(json.dumps({
    "shapes": shapes, "inside": inside, "same": same, "reward": reward, "earned": float(earned), "info": info,
    "terminated": terminated, "truncated": truncated, "ends": ends, "agents": env.possible_agents,
    "name": env.metadata["name"],
}))
""")
    assert found["agents"] == ["left", "right"]
    assert [shape[1] for shape in found["shapes"].values()] == [26, 26]
    assert found["inside"]
    assert all(found["same"])
    assert found["reward"] == dict.fromkeys(found["agents"], found["earned"])
    assert found["info"] == {name: {"success": False} for name in found["agents"]}
    assert found["terminated"] == dict.fromkeys(found["agents"], False)
    assert found["truncated"] == dict.fromkeys(found["agents"], True)
    assert [len(agents) for agents in found["ends"]] == [2, 2, 2, 2, 0]
    assert found["name"] == "DoraPair-v1"


@needs_pettingzoo
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_microwave_passes_the_interface_test_of_pettingzoo():
    """Two whole episodes and the beginning of a third."""
    found = in_process("""
from pettingzoo.test import parallel_api_test
from dora.integrations.pettingzoo import make

env = make("DoraMicrowave-v1", max_episode_steps=8)
parallel_api_test(env, num_cycles=20)
print(json.dumps({name: [env.observation_space(name).shape[0], env.action_space(name).shape[0]] 
    for name in env.possible_agents}))
""")
    assert found == {"left": [226, 26], "right": [232, 26]}


@needs_pettingzoo
def test_what_does_not_fit_is_refused_in_one_sentence():
    from dora.integrations.pettingzoo import make

    with pytest.raises(InputError, match="PickCube-v1 does not say which arm"):
        make("PickCube-v1")
    env: Any = make("DoraCube-v1", max_episode_steps=3)
    assert env.possible_agents == ["arm"]
    env.reset(seed=0)
    for actions, words in (
        ({}, "agents are"),
        (None, "must be a dictionary"),
        ({"arm": [], 3: []}, "agents are"),
        ({"arm": [[0.0], [0.0, 1.0]]}, "rows of different lengths"),
        ({"arm": "left"}, "must be numbers"),
        ({"arm": [0.0]}, "needs \\(26,\\)"),
        ({"arm": [float("nan")] * 26}, "NaN"),
    ):
        with pytest.raises(InputError, match=words):
            env.step(actions)
    env.step({"arm": torch.zeros(26, requires_grad=True)})
    env.close()


# ---- learning ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["mappo", "happo"])
def test_the_command_trains_goes_on_and_evaluates(tmp_path: Path, agent: str):
    """And the policy is loaded and plays without being told of the arms."""
    found = in_process(f"""
import dora
from pathlib import Path
from dora.agents.checkpoint import read_checkpoint
from dora.commands import run
folder = {str(tmp_path / "run")!r}
small = "--num-envs 2 --workers 0 --learner.rollout 4 --learner.hidden 16 --preset none"
small += " --eval-envs 2 --eval-episodes 2 --episodes 2"
def call(text):
    sys.argv = ["run.py", *text.split()]
    status = run.main()
    assert status == 0, status
call(f"--env DoraPair-v1 --agent {agent} --total-steps 24 --out {{folder}} {{small}}")
call(f"--resume {{folder}} --total-steps 40")
call(f"--eval-only --checkpoint {{folder}} --out {{folder}}-eval --episodes 2")
policy = dora.load_policy(folder)
env = policy.make()
policy.check(env)
obs, _ = env.reset(seed=0)
action = policy(obs)
changed = obs.clone()
columns = env.unwrapped.agent_columns
own = [k for k in columns["right"][0] if k not in columns["left"][0]]
changed[:, own] += 1.0
other = policy(changed)
result = json.loads((Path(folder) / "result.json").read_text())
evaluated = json.loads((Path(folder + "-eval") / "result.json").read_text())
best = read_checkpoint(Path(folder) / "checkpoints" / "best.safetensors")
print(json.dumps({{
    "steps": result["env_steps"], "agent": result["agent"], "agents": list(best.agents),
    "left": bool(torch.equal(action[:, :26], other[:, :26])),
    "right": bool(torch.equal(action[:, 26:], other[:, 26:])),
    "again": evaluated["success_rate"] == result["success_rate"],
    "return": evaluated["return_mean"] == result["return_mean"],
}}))
""")
    assert found == {
        "steps": 40, "agent": agent, "agents": ["left", "right"], "left": True, "right": False, "again": True,
        "return": True,
    }  # fmt: skip


def test_parts_of_an_action_have_to_fit_their_arms():
    """They are refused in one sentence, and recorded in the order of the arms otherwise, whatever that of the names."""
    found = in_process("""
from dora.errors import InputError
from dora.tasks import make_task
task = make_task("DoraPair-v1", 3)
task.reset(seed=0)
sizes = {name: arm.action_size for name, arm in task.arms.items()}
good = {name: np.full((3, size), 0.1 * k) for k, (name, size) in enumerate(sizes.items())}
one, two = good
wrong = [good | {two: good[two][:2]}, good | {two: good[two][:, 1:]}, {1: good[one], "a": good[two]}]
words = []
for action in wrong:
    try:
        task.step(action)
    except InputError as error:
        words.append(str(error))
task.step(dict(reversed(good.items())))
parts = task.scene.px.guard._history[-1].action
joined = np.concatenate(list(good.values()), 1)
print(json.dumps([words, len(task.scene.px.guard._history), bool(np.allclose(parts, joined))]))
""")
    (rows, width, names), steps, alike = found
    assert "has shape (2, " in rows
    assert "is needed" in rows
    assert "is needed" in width
    assert "has keys [1, 'a']" in names
    assert (steps, alike) == (1, True)
