"""A task of your own around Dora's robot: an ordinary ManiSkill environment that names it in `robot_uids`.

The palm is to hover within 25 cm of a cube. Run it with `python examples/third_party_task.py`.
"""

from typing import Any

import gymnasium as gym
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.building import actors
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

import dora  # noqa: F401  registers the robot and sim_backend="physx_cpu_batch"
from dora.sim.robot_agent import DescribedRobot

HOVER = 0.22
"""Height of the wrist over the cube that `approach` aims at [m]; the fingers just clear the cube there."""


@register_env("ApproachCube-v1", max_episode_steps=60)
class ApproachCube(BaseEnv):
    """Bring the palm to a cube that lies at a random place."""

    agent: DescribedRobot  # so that type checkers know what it has beyond ManiSkill's agents

    def __init__(self, *args, robot_uids="diana7_hit", **kwargs):
        super().__init__(*args, robot_uids=robot_uids, **kwargs)

    def _load_agent(self, options, *args, **kwargs):
        super()._load_agent(options, sapien.Pose([-0.5, 0.2, 0.0], [0.966, 0.0, 0.0, -0.259]))  # -30 degrees about z

    def _load_scene(self, options):
        build_ground(self.scene)
        self.cube = actors.build_cube(self.scene, 0.03, [0.8, 0.2, 0.1, 1.0], "cube", initial_pose=sapien.Pose())

    def _initialize_episode(self, env_idx, options):
        self.agent.reset(torch.as_tensor(self.agent.keyframes["home"].qpos, device=self.device))
        position = torch.rand(len(env_idx), 3, device=self.device) * 0.2 - 0.1
        position[:, 2] = 0.03
        self.cube.set_pose(Pose.create_from_pq(position))

    def evaluate(self):
        distance = (self.cube.pose.p - self.agent.palm.pose.p).norm(dim=-1)
        return {"distance": distance, "success": distance < 0.25}

    def _get_obs_extra(self, info):
        return {"cube": self.cube.pose.raw_pose, "palm": self.agent.palm.pose.raw_pose}

    def compute_dense_reward(self, obs, action, info):
        return 1 - torch.tanh(5 * info["distance"])


def approach(env: ApproachCube) -> torch.Tensor:
    """Actions (n, 26) that move the wrist towards a point above the cube and leave the hand as it is."""
    controller = env.agent.wrist_controller
    shift = env.cube.pose.p + torch.tensor([0.0, 0.0, HOVER]) - controller.world_wrist()[0]
    step = torch.cat([shift, torch.zeros_like(shift)], -1)  # [m], [rad], in the world frame
    wrist = controller.to_base_frame(step) / controller.wrist_scale
    return torch.cat([wrist, controller.hand_action(controller.target[:, 7:])], -1).clamp(-1, 1)


def main() -> None:
    """Runs four environments at once on the CPU and prints how many come to their cubes."""
    env = gym.make("ApproachCube-v1", num_envs=4, sim_backend="physx_cpu_batch", obs_mode="state", reward_mode="dense")
    task: Any = env.unwrapped
    env.reset(seed=0)
    reached = torch.zeros(4, dtype=torch.bool)
    for _ in range(60):
        *_, info = env.step(approach(task))
        reached |= info["success"]
    print(f"{int(reached.sum())} of 4 palms came to their cubes; now {info['distance'].mean():.3f} m away")
    env.close()


if __name__ == "__main__":
    main()
