"""The robot as a ManiSkill agent: registered by `import dora`, importable, subclassed, anywhere in the world."""

import math
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
from mani_skill.envs.sapien_env import BaseEnv

import dora  # noqa: F401
from dora.errors import InputError
from dora.geometry.poses import compose, relative
from dora.geometry.rotations import (
    quaternion_from_rotation_vector,
    quaternion_inverse,
    quaternion_multiply,
    rotation_angle,
    rotation_vector_from_quaternion,
)
from dora.robot import load_robot
from dora.robot.urdf import UrdfModel, read_urdf
from dora.sim import robots
from dora.sim.robot_agent import CONTROL_MODES, COUPLED, DescribedRobot
from dora.sim.robots import Diana7Hit, class_name, register_robot

MODES = [mode + end for mode in CONTROL_MODES for end in ("", COUPLED)]
BACKENDS = {"physx_cpu": 1, "physx_cpu_batch": 3}
"""Number of environments on each back end."""
BASE_P, BASE_TURN = [0.3, -0.2, 0.1], math.radians(40)
"""A base away from the origin [m], turned about z [rad]."""
BASE = sapien.Pose(BASE_P, [math.cos(BASE_TURN / 2), 0.0, 0.0, math.sin(BASE_TURN / 2)])


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
    assert result.stdout.count("stepped") == 2 * len(MODES) == 12


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

assert "spoiled" not in REGISTERED_AGENTS and "diana7_hit" in REGISTERED_AGENTS
for ask in (
    lambda: robots.register_robot("spoiled"),
    lambda: robots.Spoiled,
    lambda: gym.make("Empty-v1", robot_uids="spoiled", render_backend="none"),
    lambda: gym.make("DoraCube-v1", robot_uids="spoiled"),
):
    try:
        ask()
    except InputError as error:
        print("refused:", error)
"""
FAULTS = {
    "unknown key": lambda text: text.replace("[arm]", "[arm]\nstiffnes = 1.0", 1),
    "a list for a table": lambda text: "fingers = [1]\n" + "\n".join(
        line for line in text.split("[fingers.thumb]")[0].splitlines()
    ),
    "no TOML": lambda text: text.replace("[arm]", "[arm", 1),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_broken_folder_is_left_out_with_one_warning_and_refused_by_name(tmp_path, fault):
    file = copied("spoiled", tmp_path) / "robot.toml"
    file.write_text(FAULTS[fault](file.read_text()))
    result = run(ASKED, DORA_ROBOTS=str(tmp_path))
    assert result.returncode == 0, result.stderr
    assert result.stderr.count("UserWarning: the robot 'spoiled' is left out") == 1
    (warning,) = [line for line in result.stderr.splitlines() if "is left out" in line]
    assert str(file) in warning
    said = result.stdout.strip().splitlines()
    assert len(said) == 4
    assert all(line.startswith("refused: ") and line.removeprefix("refused: ") in warning for line in said)


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


def test_import_dora_costs_little_more_than_maniskill(record_property):
    """At most 0.5 s on top; the best of three, because other processes run as well."""
    cost = min(float(run(COST).stdout) for _ in range(3))
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
        np.testing.assert_allclose(Diana7Hit.keyframes[name].qpos, [angle[joint] for joint in joints], atol=1e-6)


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
    env = make("physx_cpu_batch", robot_uids="mine")
    assert env.agent.supported_control_modes == MODES
    env.agent.reset(torch.as_tensor(env.agent.keyframes["tucked"].qpos))
    obs, *_ = env.step(env.action_space.sample())
    assert obs.isfinite().all()
    env.close()
    task = gym.make("DoraCube-v1", robot_uids="mine").unwrapped
    assert type(task.agent) is Mine
    task.close()


def test_a_urdf_with_other_joints_than_the_description_is_refused(tmp_path, registered):
    irregular(tmp_path / "tree.urdf")

    @register_agent()
    class Other(Diana7Hit):
        uid = "other"
        urdf_path = str(tmp_path / "tree.urdf")

    with pytest.raises((InputError, KeyError), match=r"moving joints|joint1"):
        make("physx_cpu", robot_uids="other")


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


# ---- several robots ------------------------------------------------------------------------------


class TwoHands(BaseEnv):
    """Two of the same robot, face to face."""

    SUPPORTED_REWARD_MODES = ("none",)
    PLACES = (BASE, sapien.Pose([0.0, 1.2, 0.0]))

    def _load_agent(self, options: dict) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super()._load_agent(options, list(self.PLACES))  # pyright: ignore[reportArgumentType]

    def _load_scene(self, options: dict) -> None:
        pass

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        for agent in self.agent.agents:  # pyright: ignore[reportAttributeAccessIssue]
            agent.reset(torch.as_tensor(agent.keyframes["home"].qpos))

    def evaluate(self) -> dict:
        return {}


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_equal_robots_share_a_scene(backend):
    env = TwoHands(
        robot_uids=("diana7_hit", "diana7_hit"), num_envs=BACKENDS[backend], sim_backend=backend,
        render_backend="none", obs_mode="state", reward_mode="none",
    )  # fmt: skip
    env.reset(seed=0)
    agents: Any = env.agent.agents_dict  # pyright: ignore[reportAttributeAccessIssue]
    assert list(agents) == ["diana7_hit-0", "diana7_hit-1"]
    for agent, place in zip(agents.values(), TwoHands.PLACES, strict=True):
        assert_pose(agent.base_pose(), (torch.tensor(place.p)[None], torch.tensor(place.q)[None]), 1e-6, 1e-5)
        assert_pose(agent.world_posture_wrist("home"), agent.wrist_controller.world_wrist(), 1e-5, 1e-4)
    obs, *_ = env.step(env.action_space.sample())
    assert obs.isfinite().all()
    env.close()


def test_a_robot_built_separately_in_every_environment_is_the_same():
    class Separate(TwoHands):
        def _load_agent(self, options: dict) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            BaseEnv._load_agent(self, options, BASE, build_separate=True)

        def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
            self.agent.reset(torch.as_tensor(self.agent.keyframes["home"].qpos))

    env = Separate(
        robot_uids="diana7_hit", num_envs=3, sim_backend="physx_cpu_batch",
        render_backend="none", obs_mode="state", reward_mode="none",
    )  # fmt: skip
    env.reset(seed=0)
    agent: Any = env.agent
    assert_pose(agent.world_posture_wrist("home"), (agent.wrist.pose.p, agent.wrist.pose.q), 1e-5, 1e-4)
    obs, *_ = env.step(env.action_space.sample())
    assert obs.isfinite().all()
    env.close()


# ---- frames --------------------------------------------------------------------------------------


def assert_pose(a: tuple, b: tuple, metres: float, radians: float) -> None:
    """Two batches of poses agree within an error of position [m] and of angle [rad]."""
    assert (a[0] - b[0]).norm(dim=-1).max() < metres
    assert rotation_angle(a[1], b[1]).max() < radians


def place_at_base(env: Any) -> Any:
    """Resets, puts the robot at home on the base away from the origin, and returns its agent."""
    env.reset(seed=0)
    env.agent.robot.set_pose(BASE)
    env.agent.reset(torch.as_tensor(env.agent.keyframes["home"].qpos))
    env.agent.controller.reset()
    return env.agent


def test_wrist_poses_are_those_of_the_world(env):
    agent = place_at_base(env)
    measured = agent.wrist.pose.p, agent.wrist.pose.q
    base = torch.tensor(BASE.p)[None], torch.tensor(BASE.q)[None]
    assert_pose(agent.world_posture_wrist("home"), measured, 1e-5, 1e-4)
    assert_pose(agent.wrist_controller.world_wrist(), measured, 1e-5, 1e-4)
    assert_pose(agent.wrist_controller.wrist(), relative(base, measured), 1e-5, 1e-4)
    assert agent.world_posture_wrist("home")[0].shape == (env.num_envs, 3)
    assert agent.world_posture_wrist("home")[1].shape == (env.num_envs, 4)


def test_a_base_that_is_moved_counts_at_once(env):
    env.reset(seed=0)
    controller = env.agent.wrist_controller
    at_origin = controller.world_wrist()
    env.agent.robot.set_pose(BASE)
    base = torch.tensor(BASE.p)[None], torch.tensor(BASE.q)[None]
    assert_pose(controller.world_wrist(), compose(base, at_origin), 1e-5, 1e-4)
    x = torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.0, 1.0]]).expand(env.num_envs, 6)
    expected = torch.tensor([math.cos(BASE_TURN), -math.sin(BASE_TURN), 0.0, 0.0, 0.0, 1.0])
    torch.testing.assert_close(controller.to_base_frame(x), expected.expand(env.num_envs, 6), atol=1e-6, rtol=0)


def test_commands_in_the_world_frame_arrive_where_they_should(env):
    """From a base turned by 40 degrees: the command within 0.1 mm and 1e-3 rad, the hand within 2 mm."""
    agent = place_at_base(env)
    controller = agent.wrist_controller
    start = controller.world_wrist()
    turn = torch.tensor([[0.1, -0.2, 0.3]]).expand(env.num_envs, 3)
    goal = (
        start[0] + torch.tensor([0.05, -0.08, 0.06]),
        quaternion_multiply(quaternion_from_rotation_vector(turn), start[1]),
    )
    hand = controller.hand_action(controller.target[:, 7:])
    for _ in range(40):
        here = controller.world_wrist()
        spin = rotation_vector_from_quaternion(quaternion_multiply(goal[1], quaternion_inverse(here[1])))
        step = controller.to_base_frame(torch.cat([goal[0] - here[0], spin], -1))
        env.step(torch.cat([(step / controller.wrist_scale).clamp(-1, 1), hand], -1))
    assert_pose(controller.world_wrist(), goal, 1e-4, 1e-3)
    assert_pose((agent.wrist.pose.p, agent.wrist.pose.q), goal, 2e-3, 0.01)


def test_a_partial_reset_leaves_the_commands_of_the_others():
    env = make("physx_cpu_batch")
    env.reset(seed=0)
    for _ in range(3):
        env.step(torch.ones(env.num_envs, 26))
    before = env.agent.wrist_controller.target.clone()
    assert (before - env.agent.wrist_controller.qpos).abs().max() > 0.01, "the commands do not lead"
    env.reset(options={"env_idx": torch.tensor([1])})
    after = env.agent.wrist_controller.target
    assert torch.equal(after[[0, 2]], before[[0, 2]])
    torch.testing.assert_close(after[1], env.agent.wrist_controller.qpos[1])
    env.reset()
    torch.testing.assert_close(env.agent.wrist_controller.target, env.agent.wrist_controller.qpos)
    env.close()
