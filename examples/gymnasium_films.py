"""gymnasium makes the tasks by itself, alone, in a batch and filmed: `python examples/gymnasium_films.py`.

The film needs moviepy (`pip install 'gymnasium[other]'`) and a Vulkan driver (docs/rendering.md).
"""

import argparse
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--id", default="dora:DoraCube-v1", help="the prefix lets gymnasium import Dora")
parser.add_argument("--steps", type=int, default=20, help="control steps of each part")
parser.add_argument("--films", default="runs/films", help="folder of the film")
args = parser.parse_args()

single: Any = CPUGymWrapper(gym.make(args.id))  # arrays without the axis of a batch
observation, _ = single.reset(seed=0)
print(f"alone: an observation of {observation.shape[0]} numbers, an action of {single.action_space.shape[0]}")
single.close()

vector: Any = gym.make_vec(args.id, num_envs=8)
vector.reset(seed=0)
for _ in range(args.steps):
    observations, rewards, terminated, truncated, infos = vector.step(vector.action_space.sample())
print(f"in a batch: observations {tuple(observations.shape)}, mean reward {float(rewards.mean()):.2f}")
vector.close()

from dora.sim import can_render  # noqa: E402  gymnasium has imported Dora

if find_spec("moviepy") is None:
    print("no film: moviepy is not installed (pip install 'gymnasium[other]')")
elif not can_render():
    print("no film: SAPIEN finds no Vulkan driver (docs/rendering.md)")
else:
    env = CPUGymWrapper(gym.make(args.id, render_mode="rgb_array"))
    film = gym.wrappers.RecordVideo(env, args.films, video_length=args.steps)
    film.reset(seed=0)
    for _ in range(args.steps + 1):
        film.step(film.action_space.sample())
    film.close()
    print(f"a film is in {args.films}")
