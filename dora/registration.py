"""Registration of the tasks of Dora and of ManiSkill, the robots, and the batched physics: `import dora` does it."""

import functools
import importlib.util
import os
import warnings

import torch

from dora.errors import ManiSkillMissingError, naming_libraries

if importlib.util.find_spec("mani_skill") is None:
    raise ManiSkillMissingError()

with naming_libraries(), warnings.catch_warnings():
    # SAPIEN takes its own Vulkan loader then; whether there is a driver is said when asked
    warnings.filterwarnings("ignore", "Failed to find system libvulkan", UserWarning)
    import mani_skill.envs as _stock_tasks  # noqa: F401

from dora import tasks as tasks
from dora.sim import robots as _robots  # noqa: F401

# A forked process has none of the threads that torch would wait for: gymnasium's AsyncVectorEnv would stand still.
os.register_at_fork(after_in_child=functools.partial(torch.set_num_threads, 1))
