"""Dora: affordance-guided dexterous manipulation on ManiSkill and TorchRL.

`import dora` registers the task ids (and ManiSkill's own) with gymnasium, and adds `sim_backend="physx_cpu_batch"`
to all of them:

    import gymnasium as gym, dora
    env = gym.make("DoraCube-v1", num_envs=32, sim_backend="physx_cpu_batch", guidance="affordance")
"""

import mani_skill.envs as _stock_tasks  # noqa: F401

from dora import tasks as tasks
