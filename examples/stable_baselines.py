"""PPO of Stable-Baselines3 learns to lift a cube: `python examples/stable_baselines.py --steps 300000`.

Needs Stable-Baselines3: `pip install -e '.[sb3]'`.
"""

import argparse

from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from dora.integrations.sb3 import make

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="DoraCube-v1", help="id of Dora or ManiSkill")
parser.add_argument("--steps", type=int, default=300_000, help="environment steps")
parser.add_argument("--num-envs", type=int, default=64, help="environments in the batch")
parser.add_argument("--episodes", type=int, default=100, help="episodes of the evaluation")
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()

env = VecNormalize(make(args.env, num_envs=args.num_envs, ignore_terminations=True), gamma=0.98)
model = PPO(
    "MlpPolicy", env, n_steps=16, batch_size=256, n_epochs=4, gamma=0.98, learning_rate=3e-4, seed=args.seed,
    policy_kwargs={"net_arch": [256, 128], "log_std_init": -1.0}, device="cpu", verbose=1,
)  # fmt: skip
model.learn(args.steps)

successes: list[bool] = []


def count(locals_: dict, _: dict) -> None:
    """Called after each step of each environment."""
    if locals_["done"] and len(successes) < args.episodes:
        successes.append(locals_["info"]["is_success"])


env.training = env.norm_reward = False
env.seed(1_000_000)
evaluate_policy(model, env, n_eval_episodes=args.episodes, callback=count)
print(f"success in {sum(successes)} of {len(successes)} episodes")
env.close()
