"""The robot as a ManiSkill agent: registered by `import dora`, importable, subclassed, anywhere in the world."""

import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch
from mani_skill.agents.base_agent import BaseAgent, Keyframe
from mani_skill.agents.registration import REGISTERED_AGENTS, register_agent

import dora  # noqa: F401
from dora.errors import InputError
from dora.robot import load_robot
from dora.robot.urdf import UrdfModel, read_urdf
from dora.sim import robots
from dora.sim.robot_agent import CONTROL_MODES, COUPLED, FINGERS, DescribedRobot
from dora.sim.robots import Diana7Hit, class_name, register_robot

MODES = [*(mode + end for end in ("", COUPLED) for mode in CONTROL_MODES), CONTROL_MODES[0] + FINGERS]
BACKENDS = {"physx_cpu": 1, "physx_cpu_batch": 3}
"""Number of environments on each back end."""


def make(backend: str, env_id: str = "Empty-v1", **options: Any) -> Any:
    """An environment with the robot, unwrapped."""
    settings = {"robot_uids": "diana7_hit", "render_backend": "none", "obs_mode": "state", **options}
    return gym.make(env_id, num_envs=BACKENDS[backend], sim_backend=backend, **settings).unwrapped


def run(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """What a new Python process says to this code."""
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=300, env=os.environ | environment
    )


@pytest.fixture(params=BACKENDS)
def env(request) -> Iterator[Any]:
    env = make(request.param)
    yield env
    env.close()


@pytest.fixture
def registered() -> Iterator[dict]:
    """ManiSkill's register, put back after the test."""
    before = dict(REGISTERED_AGENTS)
    yield REGISTERED_AGENTS
    REGISTERED_AGENTS.clear()
    REGISTERED_AGENTS.update(before)


def copied(name: str, place: Path) -> Path:
    """A copy of the robot's folder without its visuals, under another name."""
    folder = place / name
    source = load_robot("diana7_hit").folder
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("meshes"))
    return folder


# ---- registration --------------------------------------------------------------------------------

STEPS = """
import gymnasium as gym, torch
import dora
from mani_skill.agents.registration import REGISTERED_AGENTS
assert "diana7_hit" in REGISTERED_AGENTS

for backend, num_envs in (("physx_cpu", 1), ("physx_cpu_batch", 4)):
    for mode in {modes}:
        env = gym.make("Empty-v1", robot_uids="diana7_hit", control_mode=mode, num_envs=num_envs,
                       sim_backend=backend, render_backend="none", obs_mode="state")
        seen = [env.reset(seed=0)[0]] + [env.step(env.action_space.sample())[0] for _ in range(3)]
        assert all(o.isfinite().all() and o.shape[0] == num_envs for o in seen)
        assert (seen[3] - seen[0]).abs().max() > 1e-3, "nothing moved"
        env.close()
        print("stepped", backend, mode)
"""


def test_after_import_dora_alone_the_robot_steps_in_every_control_mode():
    result = run(STEPS.format(modes=MODES))
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("stepped") == 2 * len(MODES) == 14


def test_every_folder_has_one_registered_class():
    assert REGISTERED_AGENTS["diana7_hit"].agent_cls is Diana7Hit is register_robot("diana7_hit")
    assert issubclass(Diana7Hit, DescribedRobot)
    assert issubclass(Diana7Hit, BaseAgent)
    assert (Diana7Hit.__module__, Diana7Hit.__qualname__) == ("dora.sim.robots", "Diana7Hit")
    assert Diana7Hit.urdf_path == str(load_robot("diana7_hit").urdf)


def test_the_class_is_pickled_by_reference_into_a_new_process():
    assert pickle.loads(pickle.dumps(Diana7Hit)) is Diana7Hit
    result = run(f"import pickle; print(pickle.loads({pickle.dumps(Diana7Hit)!r}).uid)")
    assert result.stdout.strip() == "diana7_hit", result.stderr


def test_a_users_robot_is_registered_by_import_and_pickled_by_reference(tmp_path):
    copied("my-hand_2", tmp_path)
    code = (
        "import pickle, dora; from mani_skill.agents.registration import REGISTERED_AGENTS as r; "
        "c = r['my-hand_2'].agent_cls; assert pickle.loads(pickle.dumps(c)) is c; print(c.__qualname__)"
    )
    result = run(code, DORA_ROBOTS=str(tmp_path))
    assert result.stdout.strip() == "MyHand2", result.stderr


ASKED = """
import gymnasium as gym
import dora
from dora.errors import InputError
from dora.sim import robots
from mani_skill.agents.registration import REGISTERED_AGENTS

for name in {names}:
    assert name not in REGISTERED_AGENTS and "diana7_hit" in REGISTERED_AGENTS
    for ask in (
        lambda: robots.register_robot(name),
        lambda: getattr(robots, name.capitalize()),
        lambda: gym.make("Empty-v1", robot_uids=name, render_backend="none"),
        lambda: gym.make("DoraCube-v1", robot_uids=name),
    ):
        try:
            ask()
        except InputError as error:
            print("refused", name, error)
"""
FAULTS = {
    "unknown": lambda text: text.replace("[arm]", "[arm]\nstiffnes = 1.0", 1),
    "listed": lambda text: "fingers = [1]\n" + "\n".join(
        line for line in text.split("[fingers.thumb]")[0].splitlines()
    ),
    "unread": lambda text: text.replace("[arm]", "[arm", 1),
}  # fmt: skip
"""Changes of a description, by the names of their robots: an unknown key, a list for a table, no TOML."""


def test_a_broken_folder_is_left_out_with_one_warning_and_refused_by_name(tmp_path):
    for name, fault in FAULTS.items():
        file = copied(name, tmp_path) / "robot.toml"
        file.write_text(fault(file.read_text()))
    result = run(ASKED.format(names=list(FAULTS)), DORA_ROBOTS=str(tmp_path))
    assert result.returncode == 0, result.stderr
    for name in FAULTS:
        assert result.stderr.count(f"UserWarning: the robot '{name}' is left out") == 1
        (warning,) = [line for line in result.stderr.splitlines() if f"'{name}' is left out" in line]
        assert str(tmp_path / name / "robot.toml") in warning
        said = [line for line in result.stdout.splitlines() if line.startswith(f"refused {name} ")]
        assert len(said) == 4
        assert all(line.removeprefix(f"refused {name} ") in warning for line in said)


def test_a_folder_that_comes_later_is_found_by_name(tmp_path, monkeypatch, registered):
    copied("late_hand", tmp_path)
    monkeypatch.setenv("DORA_ROBOTS", str(tmp_path))
    env = make("physx_cpu", robot_uids="late_hand")
    assert type(env.agent) is robots.LateHand
    env.close()
    monkeypatch.delattr(robots, "LateHand")


def test_names_that_are_taken_are_refused(tmp_path, monkeypatch, registered):
    for name in ("panda", "input_error", "diana7__hit"):
        copied(name, tmp_path)
    monkeypatch.setenv("DORA_ROBOTS", str(tmp_path))
    monkeypatch.setattr(robots, "InputError", InputError)
    with pytest.raises(InputError, match="'panda' is ManiSkill's own"):
        register_robot("panda")
    for name, title in (("diana7__hit", "Diana7Hit"), ("input_error", "InputError")):
        with pytest.raises(InputError, match=f"class name {title} of the robot '{name}' is taken"):
            register_robot(name)


@pytest.mark.parametrize(("robot", "title"), [("diana7_hit", "Diana7Hit"), ("7dof", "Robot7dof"), ("a-b.c", "ABC")])
def test_class_names_are_identifiers(robot, title):
    assert class_name(robot) == title
    assert title.isidentifier()


def test_an_unknown_attribute_of_the_module_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'Nobody'"):
        _ = robots.Nobody


COST = """
import time
import mani_skill.envs
start = time.perf_counter()
import dora
print(time.perf_counter() - start)
"""


@pytest.mark.slow
def test_import_dora_costs_little_more_than_maniskill(tmp_path, record_property):
    """At most 0.5 s on top, with its bytecode cached as ManiSkill's is; the best of four, as other processes run too.

    Where PYTHONDONTWRITEBYTECODE is set and Dora is installed editable, a third of the time would be compiling.
    """
    cached = {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": str(tmp_path)}
    cost = min(float(run(COST, **cached).stdout) for _ in range(4))
    record_property("import", f"{cost:.2f} s")
    assert cost < 0.5


# ---- the class -----------------------------------------------------------------------------------


def test_keyframes_of_the_class_are_the_postures_in_the_simulators_order(env):
    joints = [joint.name for joint in env.agent.robot.active_joints]
    assert tuple(joints) == Diana7Hit.joint_names
    assert env.agent.keyframes is Diana7Hit.keyframes
    description = load_robot("diana7_hit")
    assert set(Diana7Hit.keyframes) == set(description.postures)
    for name, posture in description.postures.items():
        angle = dict(zip(description.arm.names + description.hand.names, np.r_[posture.arm, posture.hand], strict=True))
        qpos = np.asarray(Diana7Hit.keyframes[name].qpos, dtype=np.float64)
        np.testing.assert_allclose(qpos, [angle[joint] for joint in joints], atol=1e-6)


TREE = {
    # name: (parent, child, kind), in the order of the file
    "late": ("arm", "c", "revolute"), "a1": ("root", "a", "revolute"), "mount": ("root", "b", "fixed"),
    "b1": ("b", "arm", "revolute"), "a2": ("a", "a_tip", "prismatic"), "a3": ("a_tip", "a_end", "revolute"),
    "side": ("root", "d", "revolute"), "b2": ("arm", "e", "revolute"), "b3": ("c", "f", "revolute"),
}  # fmt: skip


def irregular(path: Path) -> UrdfModel:
    """A tree with branches of unequal depth, a fixed joint between, and a file that is in no order."""
    inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = ["root", *(child for _, child, _ in TREE.values())]
    limit = '<axis xyz="0 0 1"/><limit lower="-1" upper="1" velocity="1" effort="1"/>'
    text = "".join(f'<link name="{link}">{inertia}</link>' for link in links)
    text += "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{a}"/><child link="{b}"/>{limit}</joint>'
        for name, (a, b, kind) in TREE.items()
    )
    path.write_text(f'<robot name="tree">{text}</robot>')
    return read_urdf(path)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_joint_order_is_the_simulators_for_any_tree(tmp_path, backend, registered):
    model = irregular(tmp_path / "tree.urdf")

    @register_agent()
    class Tree(BaseAgent):
        uid = "tree"
        urdf_path = str(tmp_path / "tree.urdf")

    env = make(backend, robot_uids="tree")
    assert [joint.name for joint in env.agent.robot.active_joints] == list(model.moving_joints)
    assert len(model.moving_joints) == 8
    env.close()


def test_a_subclass_inherits_keyframes_urdf_and_controllers(registered):
    tucked = Keyframe(pose=sapien.Pose(), qpos=Diana7Hit.keyframes["fist"].qpos)

    @register_agent()
    class Mine(Diana7Hit):
        uid = "mine"
        keyframes = {**Diana7Hit.keyframes, "tucked": tucked}  # noqa: RUF012

    assert Mine.urdf_path == Diana7Hit.urdf_path
    assert Mine.description is Diana7Hit.description
    assert set(Mine.keyframes) == {*Diana7Hit.keyframes, "tucked"}
    assert type("Heir", (Mine,), {"uid": "heir"}).keyframes is Mine.keyframes
    assert type("Bare", (DescribedRobot,), {"description": Mine.description, "keyframes": {}}).keyframes == {}
    env = make("physx_cpu_batch", robot_uids="mine")
    assert env.agent.supported_control_modes == MODES
    env.agent.reset(torch.as_tensor(env.agent.keyframes["tucked"].qpos))
    obs, *_ = env.step(env.action_space.sample())
    assert obs.isfinite().all()
    env.close()
    task: Any = gym.make("DoraCube-v1", robot_uids="mine").unwrapped
    assert type(task.agent) is Mine
    task.close()


def test_a_urdf_with_other_joints_than_the_description_is_refused(tmp_path, registered):
    irregular(tmp_path / "tree.urdf")

    @register_agent()
    class Other(Diana7Hit):
        uid = "other"
        urdf_path = str(tmp_path / "tree.urdf")

    with pytest.raises(InputError, match=r"moving joints a1, .* but the description has joint1"):
        make("physx_cpu", robot_uids="other")


def test_what_only_the_simulator_reads_is_refused_in_one_sentence(tmp_path, monkeypatch, registered):
    file = copied("odd_hand", tmp_path) / "robot.urdf"
    file.write_text(file.read_text().replace("<limit", "<safety_controller/><limit", 1))
    monkeypatch.setenv("DORA_ROBOTS", str(tmp_path))
    with pytest.raises(InputError, match=f"the simulator cannot read {file} .ValueError: Missing .*: correct it"):
        make("physx_cpu", robot_uids="odd_hand")


def test_a_robot_without_the_posture_of_a_task_is_refused_by_the_task(tmp_path, monkeypatch, registered):
    file = copied("homeless", tmp_path) / "robot.toml"
    file.write_text(file.read_text().replace("[postures.home]", "[postures.rest]"))
    monkeypatch.setenv("DORA_ROBOTS", str(tmp_path))
    with pytest.raises(InputError, match=f"has no posture 'home'; add it to {file}, which has zero, rest"):
        gym.make("DoraCube-v1", robot_uids="homeless")
    make("physx_cpu", robot_uids="homeless").close()


@pytest.mark.parametrize("mode", ["pd_joint_pos", "pd_joint_pos_coupled"])
def test_the_action_of_a_keyframe_leads_to_the_keyframe(mode):
    env = make("physx_cpu_batch", control_mode=mode)
    env.reset(seed=0)
    home = torch.as_tensor(Diana7Hit.keyframes["home"].qpos).expand(env.num_envs, -1)
    for _ in range(60):
        env.step(env.agent.joint_action(home))
    assert (env.agent.robot.qpos - home).abs().max() < 0.01
    env.agent.set_control_mode("pd_joint_delta_pos")
    with pytest.raises(InputError, match="takes no joint targets"):
        env.agent.joint_action(home)
    env.close()
