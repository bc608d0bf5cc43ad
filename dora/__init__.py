"""Dora: affordance-guided dexterous manipulation on ManiSkill and TorchRL.

`import dora` registers the task ids (and ManiSkill's own) with gymnasium and the robots of `robots/` and DORA_ROBOTS
with ManiSkill, and adds `sim_backend="physx_cpu_batch"` to all tasks:

    import gymnasium as gym, dora
    env = gym.make("DoraCube-v1", num_envs=32, sim_backend="physx_cpu_batch", guidance="affordance")
    env = gym.make("Empty-v1", robot_uids="diana7_hit", render_backend="none")

A trained policy comes with each task: `action = dora.load_policy("DoraCube-v1")(obs)`.
"""

import sys as _sys
from pathlib import Path as _Path
from typing import TYPE_CHECKING

from dora.version import VERSION as __version__

if TYPE_CHECKING:
    from dora.policies.policy import TaskPolicy

__all__ = ["__version__", "load_policy"]


def load_policy(which: "str | _Path") -> "TaskPolicy":
    """A trained, greedy policy: `action = policy(obs)` for observations (o,) or (n, o), arrays or tensors.

    Args:
        which: a task id such as "DoraHammer-v1", for the policy that comes with Dora; or the path of a run folder, for
            its best policy, or of a .safetensors file.

    Raises:
        InputError: for an unknown id, a task without a policy, or a file that is no checkpoint.
    """
    from dora.policies.policy import load_policy as load  # learners are imported only when one is wanted

    return load(which)


def _is_command() -> bool:
    """Whether Python starts `dora`, `python -m dora` or a script of a checkout that does the same: they register later.

    Those scripts say that they are `dora` (`sys.argv[0]`). A process that such a command starts has its `argv`, but not
    its command line, and registers everything.
    """
    program, arguments = _sys.argv[0], _sys.argv[1:]
    asked = _sys.orig_argv[: max(len(_sys.orig_argv) - len(arguments), 0)]
    last = asked[-1] if asked else ""
    if program == "-m":
        return last in ("dora", "-mdora")
    started = program in _sys.orig_argv or last.endswith(".py")
    return started and _Path(program).name in ("dora", "dora.exe")


if not _is_command():
    from dora import registration as registration
    from dora import tasks as tasks
