"""Registration of the tasks of Dora and of ManiSkill, the robots, and the batched physics: `import dora` does it."""

import importlib.util
import warnings

from dora.errors import ManiSkillMissingError

if importlib.util.find_spec("mani_skill") is None:
    raise ManiSkillMissingError()

with warnings.catch_warnings():  # SAPIEN takes its own Vulkan loader then; whether there is a driver is said when asked
    warnings.filterwarnings("ignore", "Failed to find system libvulkan", UserWarning)
    import mani_skill.envs as _stock_tasks  # noqa: F401

from dora import tasks as tasks
from dora.sim import robots as _robots  # noqa: F401
