"""Simulation on ManiSkill: batched CPU physics, contact reading, robots and objects as bodies, grasp tests.

Importing this package makes ``sim_backend="physx_cpu_batch"`` known to ManiSkill, for every task:

    import dora.sim
    env = gymnasium.make("PickCube-v1", num_envs=32, sim_backend="physx_cpu_batch")
"""

from dora.sim.batch.hooks import BACKEND, install, runs_batched
from dora.sim.batch.rendering import can_render
from dora.sim.batch.stepping import StepProfile
from dora.sim.keywords import install_keywords
from dora.sim.wrappers import install_wrappers

install()
install_wrappers()
install_keywords()

__all__ = ["BACKEND", "StepProfile", "can_render", "install", "runs_batched"]
