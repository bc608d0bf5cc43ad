"""Robots anywhere in the world: frames of wrist poses and commands, several robots, partial resets."""

import math
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import pytest
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv

import dora  # noqa: F401
from dora.geometry.poses import compose, relative
from dora.geometry.rotations import (
    quaternion_from_rotation_vector,
    quaternion_inverse,
    quaternion_multiply,
    rotation_angle,
    rotation_vector_from_quaternion,
)
from dora.sim.substeps import watch_contacts

BACKENDS = {"physx_cpu": 1, "physx_cpu_batch": 3}
"""Number of environments on each back end."""
BASE_P, BASE_TURN = [0.3, -0.2, 0.1], math.radians(40)
"""A base away from the origin [m], turned about z [rad]."""
BASE = sapien.Pose(BASE_P, [math.cos(BASE_TURN / 2), 0.0, 0.0, math.sin(BASE_TURN / 2)])


def make(backend: str, env_id: str = "Empty-v1", **options: Any) -> Any:
    """An environment with the robot, unwrapped."""
    settings = {"robot_uids": "diana7_hit", "render_backend": "none", "obs_mode": "state", **options}
    return gym.make(env_id, num_envs=BACKENDS[backend], sim_backend=backend, **settings).unwrapped


@pytest.fixture(params=BACKENDS)
def env(request) -> Iterator[Any]:
    env = make(request.param)
    yield env
    env.close()


# ---- several robots ------------------------------------------------------------------------------


def scene(task: type[BaseEnv], backend: str, robot_uids: Any) -> Any:
    """An environment of a task that is not registered."""
    make: Any = task
    return make(
        robot_uids=robot_uids, num_envs=BACKENDS[backend], sim_backend=backend,
        render_backend="none", obs_mode="state", reward_mode="none",
    )  # fmt: skip


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
    env = scene(TwoHands, backend, ("diana7_hit", "diana7_hit"))
    env.reset(seed=0)
    agents = env.agent.agents_dict
    assert list(agents) == ["diana7_hit-0", "diana7_hit-1"]
    for agent, place in zip(agents.values(), TwoHands.PLACES, strict=True):
        assert_pose(agent.base_pose(), (torch.tensor(place.p)[None], torch.tensor(place.q)[None]), 1e-6, 1e-5)
        assert_pose(agent.world_posture_wrist("home"), agent.wrist_controller.world_wrist(), 1e-5, 1e-4)
    obs = env.step(env.action_space.sample())[0]
    assert obs.isfinite().all()
    env.close()


class Twins(TwoHands):
    """A robot and its twin in the same place."""

    PLACES = (BASE, BASE)


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_link_of_a_robot_touches_the_same_link_of_another_one(backend):
    env = scene(Twins, backend, ("diana7_hit", "diana7_hit"))
    env.reset(seed=0)
    one, other = (agent.robot.links_map for agent in env.agent.agents_dict.values())
    shaped = {name for name in env.agent.agents[0].description.shapes if name != "base_link"}  # bases stand fast
    assert len(shaped) == 23
    twins = {body.entity: name for links in (one, other) for name in shaped for body in links[name]._bodies}
    met = set()

    def watch(environment: int, contacts: list) -> None:
        met.update(
            (environment, name)
            for first, second in (contact.bodies for contact in contacts)
            if first.entity is not second.entity and (name := twins.get(first.entity)) == twins.get(second.entity)
        )

    watch_contacts(env.scene, watch)
    env.step(None)
    assert met == {(environment, name) for environment in range(BACKENDS[backend]) for name in shaped}
    env.close()


class LeftAndRight(TwoHands):
    """A right and a left robot side by side, near enough to meet."""

    PLACES = (sapien.Pose([0.0, -0.2, 0.0]), sapien.Pose([0.0, 0.2, 0.0]))


def test_a_right_and_a_left_robot_move_in_a_batch_as_alone():
    """Bit for bit, contacts between the two robots included."""
    generator, states, forces = torch.Generator().manual_seed(0), {}, {}
    actions = torch.rand(20, BACKENDS["physx_cpu_batch"], 2, 26, generator=generator) * 2 - 1
    actions[..., 0, 1], actions[..., 1, 1] = 1.0, -1.0  # towards each other
    for backend, rows in (("physx_cpu_batch", [slice(None)]), ("physx_cpu", [slice(k, k + 1) for k in range(3)])):
        env = scene(LeftAndRight, backend, ("diana7_hit", "diana7_hit_left"))
        arms, found, pressed = list(env.agent.agents_dict), [], torch.zeros(())
        hand = [name for name in env.agent.agents[0].robot_link_names if name.startswith("Right")]
        for row in rows:
            env.reset(seed=0, options={"reconfigure": True})  # a scene that remembers no contacts
            hands = env.agent.agents[0].robot
            for action in actions[:, row]:
                env.step({arm: action[:, k] for k, arm in enumerate(arms)})
                pressed = pressed.maximum(hands.get_net_contact_forces(hand).norm(dim=-1).max())
            found.append(torch.cat([agent.robot.get_state() for agent in env.agent.agents], -1))
        states[backend], forces[backend] = torch.cat(found), float(pressed)
        env.close()
    assert states["physx_cpu"].isfinite().all()
    assert forces["physx_cpu"] == forces["physx_cpu_batch"] > 1
    assert torch.equal(states["physx_cpu_batch"], states["physx_cpu"])
    assert not torch.equal(states["physx_cpu"][0], states["physx_cpu"][1])


def test_a_robot_built_separately_in_every_environment_is_the_same():
    class Separate(TwoHands):
        def _load_agent(self, options: dict) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
            BaseEnv._load_agent(self, options, BASE, build_separate=True)

        def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
            self.agent.reset(torch.as_tensor(self.agent.keyframes["home"].qpos))

    env = scene(Separate, "physx_cpu_batch", "diana7_hit")
    env.reset(seed=0)
    agent = env.agent
    assert agent.robot.merged
    assert_pose(agent.world_posture_wrist("home"), (agent.wrist.pose.p, agent.wrist.pose.q), 1e-5, 1e-4)
    obs = env.step(env.action_space.sample())[0]
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
