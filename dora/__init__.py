"""Dora: affordance-guided dexterous manipulation on ManiSkill and TorchRL.

`import dora` registers the task ids (and ManiSkill's own) with gymnasium and the robots of `robots/` and DORA_ROBOTS
with ManiSkill, and adds `sim_backend="physx_cpu_batch"` to all tasks:

    import gymnasium as gym, dora
    env = gym.make("DoraCube-v1", num_envs=32, sim_backend="physx_cpu_batch", guidance="affordance")
    env = gym.make("Empty-v1", robot_uids="diana7_hit")
"""

import mani_skill.envs as _stock_tasks  # noqa: F401

from dora import tasks as tasks
from dora.sim import robots as _robots  # noqa: F401
