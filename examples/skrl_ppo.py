"""PPO of skrl learns to lift a cube: `python examples/skrl_ppo.py --steps 100000`.

Needs skrl: `pip install -e '.[skrl]'`.
"""

import argparse
from typing import Any

import gymnasium as gym
import torch
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed
from torch import Tensor, nn

import dora  # noqa: F401  registers the tasks

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="DoraCube-v1", help="id of Dora or ManiSkill")
parser.add_argument("--steps", type=int, default=300_000, help="environment steps")
parser.add_argument("--num-envs", type=int, default=64, help="environments in the batch")
parser.add_argument("--episodes", type=int, default=64, help="episodes of each evaluation")
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()


def layers(inputs: int, outputs: int) -> nn.Sequential:
    """A small network."""
    return nn.Sequential(nn.Linear(inputs, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), nn.Linear(128, outputs))


class Actor(GaussianMixin, Model):
    """Mean and deviation of the action."""

    def __init__(self, **spaces: Any):
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net = layers(self.num_observations, self.num_actions)
        last: Any = self.net[-1]
        nn.init.zeros_(last.weight)  # begins near the zero action, which executes the reference
        self.log_std = nn.Parameter(torch.full((self.num_actions,), -1.0))

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """Value of the observation."""

    def __init__(self, **spaces: Any):
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.net = layers(self.num_observations, 1)

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[Tensor, dict[str, Any]]:
        return self.net(inputs["observations"]), {}


def evaluate(agent: PPO, batch: Any) -> str:
    """Mean return and share of successes of whole episodes, one in each environment, with the mean action."""
    observations, _ = batch.reset(seed=1_000_000)
    returns, success, over = torch.zeros(len(observations)), torch.zeros(len(observations)), False
    while not over:
        with torch.no_grad():
            outputs = agent.act(observations, None, timestep=0, timesteps=0)[1]
        observations, reward, _, truncated, info = batch.step(outputs["mean_actions"].clamp(-1, 1))
        returns, success, over = returns + reward, info["success"].float(), bool(truncated.any())
    return f"return {returns.mean():.1f}, success {success.mean():.2f}"


torch.set_num_threads(1)
set_seed(args.seed)
vector = ManiSkillVectorEnv(gym.make(args.env, num_envs=args.num_envs), ignore_terminations=True)  # whole episodes
env = wrap_env(vector, wrapper="gymnasium", verbose=False)
spaces: dict[str, Any] = {
    name: getattr(env, name) for name in ("observation_space", "state_space", "action_space", "device")
}
scaled = {"size": env.observation_space, "device": env.device}
settings = PPO_CFG(
    rollouts=16, learning_epochs=4, mini_batches=4, discount_factor=0.98, learning_rate=3e-4, value_loss_scale=1.0,
    observation_preprocessor=RunningStandardScaler, observation_preprocessor_kwargs=scaled,
    value_preprocessor=RunningStandardScaler, value_preprocessor_kwargs={"size": 1, "device": env.device},
)  # fmt: skip
settings.experiment.write_interval = settings.experiment.checkpoint_interval = 0  # no files
agent = PPO(
    models={"policy": Actor(**spaces), "value": Critic(**spaces)},
    memory=RandomMemory(memory_size=settings.rollouts, num_envs=env.num_envs, device=env.device),
    cfg=settings,
    **spaces,
)
agent.init()
batch = gym.make(args.env, num_envs=args.episodes)
print("before training:", evaluate(agent, batch))
timesteps = args.steps // args.num_envs
trainer = {"timesteps": timesteps, "headless": True, "disable_progressbar": True, "close_environment_at_exit": False}
SequentialTrainer(cfg=trainer, env=env, agents=agent).train()
print(f"after {timesteps * args.num_envs:,} steps:", evaluate(agent, batch))
env.close()
batch.close()
