"""A collector of TorchRL runs Dora's policy of the cube: `python examples/torchrl_collector.py`."""

import argparse

import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

import dora
from dora.integrations.torchrl import make

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--env", default="DoraCube-v1", help="id with a policy that comes with Dora")
parser.add_argument("--num-envs", type=int, default=16, help="environments in the batch")
args = parser.parse_args()

policy = dora.load_policy(args.env)
env = make(args.env, num_envs=args.num_envs)
env.set_seed(0)
steps = env.env.get_wrapper_attr("max_steps")
actor = TensorDictModule(policy, in_keys=["observation"], out_keys=["action"])
frames = steps * args.num_envs
with torch.no_grad():
    batch = next(iter(Collector(env, actor, frames_per_batch=frames, total_frames=frames)))
done, success = batch["next", "done"], batch["next", "success"]
print(f"{int(done.sum())} episodes, {int((done & success).sum())} of them a success")
env.close()
