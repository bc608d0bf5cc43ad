"""The robots as ManiSkill agents: one class per folder of `robots/` and DORA_ROBOTS, registered under its name.

Importing this module (`import dora` does) registers them all, and each class is an attribute of it, named after the
folder in CamelCase:

    from dora.sim.robots import Diana7Hit
    home = Diana7Hit.keyframes["home"].qpos

A folder with a fault is left out with a warning; whoever asks for it by name gets the `InputError`.
"""

import re
import warnings
from functools import wraps
from typing import Any

from mani_skill.agents.registration import REGISTERED_AGENTS, register_agent
from mani_skill.envs.sapien_env import BaseEnv

from dora.digests import check_folder
from dora.errors import InputError
from dora.robot import available_robots, load_robot
from dora.sim.robot_agent import DescribedRobot


def class_name(robot: str) -> str:
    """Name of the class of a robot: "diana7_hit" -> "Diana7Hit"; a leading digit gets "Robot" before it."""
    title = "".join(part.capitalize() for part in re.split(r"\W|_", robot))
    return title if title.isidentifier() else f"Robot{title}"


def register_robot(name: str) -> type[DescribedRobot]:
    """The agent class of the robot `name`, registered with ManiSkill under that name; made once per process.

    Raises:
        InputError: if the robot is unknown, its files do not fit together, or its name is taken.
    """
    if name in REGISTERED_AGENTS:
        cls = REGISTERED_AGENTS[name].agent_cls
        if not issubclass(cls, DescribedRobot):
            raise InputError(f"the robot {name!r} is ManiSkill's own and has no description in robots/; rename yours")
        return cls
    description = load_robot(name)
    description.collision_bits()  # refuses what could not be built
    title = class_name(name)
    if title in globals():
        raise InputError(f"{description.folder}: the class name {title} of the robot {name!r} is taken; rename it")
    members = {
        "__doc__": f"The robot of {description.folder}.",
        "uid": name,
        "description": description,
    }
    cls = type(title, (DescribedRobot,), members)
    globals()[title] = cls
    return register_agent()(cls)


def register_robots() -> None:
    """Registers every robot that has a folder; one with a fault is left out with a warning."""
    for name in available_robots():
        try:
            register_robot(name)
        except (InputError, OSError) as error:
            warnings.warn(f"the robot {name!r} is left out: {error}", stacklevel=2)


def _load_agent(original: Any) -> Any:
    @wraps(original)
    def load_agent(self: BaseEnv, *args: Any, **kwargs: Any) -> Any:
        """Stock's agents, after a look into the folders for robots that are not registered."""
        uids = self.robot_uids if isinstance(self.robot_uids, tuple) else (self.robot_uids,)
        for uid in uids:
            if isinstance(uid, str) and uid not in REGISTERED_AGENTS and uid in available_robots():
                register_robot(uid)
            agent = REGISTERED_AGENTS.get(uid) if isinstance(uid, str) else None
            if agent is not None and issubclass(agent.agent_cls, DescribedRobot):
                check_folder(agent.agent_cls.description.folder)  # the simulator reads the files again
        return original(self, *args, **kwargs)

    return load_agent


def __getattr__(name: str) -> type[DescribedRobot]:
    """The class of a robot whose folder came, or was mended, after this module was imported."""
    for robot in available_robots():
        if class_name(robot) == name:
            return register_robot(robot)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


register_robots()
BaseEnv._load_agent = _load_agent(BaseEnv._load_agent)
