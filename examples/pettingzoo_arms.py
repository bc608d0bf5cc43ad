"""PettingZoo plays the arms of a task as agents: `python examples/pettingzoo_arms.py`.

Needs PettingZoo: `pip install -e '.[pettingzoo]'`.
"""

import argparse

import numpy as np

from dora.integrations.pettingzoo import make

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="DoraMicrowave-v1", help="id of Dora, in which each arm is an agent")
parser.add_argument("--episodes", type=int, default=3)
args = parser.parse_args()

env = make(args.env, ignore_terminations=True)
print(f"agents: {', '.join(env.possible_agents)}; state of {env.state_space.shape[0]} numbers")
for episode in range(args.episodes):
    observations, infos = env.reset(seed=episode)
    total = 0.0
    while env.agents:
        # a policy of each agent stands here; the zero action executes the reference of its arm
        actions = {name: np.zeros(env.action_space(name).shape, np.float32) for name in observations}
        observations, rewards, _, _, infos = env.step(actions)
        total += next(iter(rewards.values()))
    success = next(iter(infos.values()))["success"]
    print(f"episode {episode}: return {total:.1f}, success {success}")
env.close()
