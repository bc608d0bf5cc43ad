"""Registration of the tasks of Dora and of ManiSkill, the robots, and the batched physics: `import dora` does it."""

import mani_skill.envs as _stock_tasks  # noqa: F401

from dora import tasks as tasks
from dora.sim import robots as _robots  # noqa: F401
