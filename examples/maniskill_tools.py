"""ManiSkill's wrappers and its replay take Dora's tasks: `python examples/maniskill_tools.py --out runs/recorded`."""

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
from mani_skill.trajectory.replay_trajectory import main, parse_args
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

import dora

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="DoraCube-v1", help="id with a policy that comes with Dora")
parser.add_argument("--out", type=Path, default=Path("runs/recorded"), help="folder of the recording")
args = parser.parse_args()
policy = dora.load_policy(args.env)

# one environment with arrays, as gymnasium has them
single: Any = CPUGymWrapper(gym.make(args.env))
observation, _ = single.reset(seed=0)
observation, reward, *_ = single.step(policy(observation))
print(f"CPUGymWrapper: {type(observation).__name__} {observation.shape}, reward {reward:.2f}")
single.close()

# a batch that begins a new episode in the step that ends one
vector: Any = ManiSkillVectorEnv(gym.make(args.env, num_envs=4), ignore_terminations=True, record_metrics=True)
observations, _ = vector.reset(seed=0)
ended = 0
while ended == 0:
    observations, _, _, truncated, infos = vector.step(policy(observations))
    ended = int(truncated.sum())
print(f"ManiSkillVectorEnv: {ended} episodes, returns {infos['final_info']['episode']['return'].tolist()}")
vector.close()

# a recording with all states, which ManiSkill's replay opens by itself and `dora play --recording` shows
env: Any = gym.make(args.env, sim_backend="physx_cpu")
recorder: Any = RecordEpisode(env, str(args.out), trajectory_name="recorded", save_video=False)
observation, _ = recorder.reset(seed=0)
for _ in range(env.unwrapped.max_steps):
    observation, *_, info = recorder.step(policy(observation))
recorder.close()
path = args.out / "recorded.h5"
print(f"RecordEpisode: success {bool(info['success'])}, {path}")
main(parse_args(["--traj-path", str(path), "--save-traj", "--use-first-env-state"]))
(replayed,) = args.out.glob("recorded.*.h5")
print(f"replay: {replayed}")
