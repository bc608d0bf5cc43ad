"""Whether this machine can render and who needs it, and stand-ins for materials where nothing can be rendered."""

import multiprocessing
from functools import cache
from typing import Any, NoReturn

import sapien
from mani_skill import logger
from mani_skill.utils.building import _mjcf_loader
from sapien import pysapien
from sapien.wrapper import urdf_loader

from dora.errors import InputError

QUIET, USUAL = "off", "warn"
"""Levels of SAPIEN's log of rendering: nothing, and what it is when SAPIEN is imported."""
NOTE = (
    "There is no Vulkan driver: everything works but pictures and films (docs/rendering.md in the project says how to "
    "get one)."
)
"""What is said once instead of the three lines that SAPIEN logs where it finds no driver."""
STATE_MODES = ("state", "state_dict", "none")
"""Observation modes that need no renderer; others may join them with "+"."""


class NoMaterial:
    """Stands in for `sapien.render.RenderMaterial` on a machine without a Vulkan driver.

    There the real class raises as soon as it is made, and ManiSkill's tasks make materials for visuals that
    are never built. This one takes any arguments and attributes.
    """

    def __init__(self, *_: Any, **attributes: Any):
        self.__dict__.update(attributes)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("set_"):
            return lambda *_: None
        raise AttributeError(name)


@cache
def can_render() -> bool:
    """Whether SAPIEN finds a Vulkan driver; asked once per process, in about half a second.

    Where there is none, `NOTE` is logged, but not in worker processes. Changes nothing but the level of SAPIEN's log of
    rendering, which is afterwards what it is when SAPIEN is imported.
    """
    sapien.render.set_log_level(QUIET)
    try:
        # The render system must come before any material: SAPIEN binds to the device of the first it meets.
        sapien.render.RenderSystem(sapien.Device("cpu"))
    except RuntimeError:
        if multiprocessing.parent_process() is None:
            logger.warning(NOTE)
        return False
    finally:
        sapien.render.set_log_level(USUAL)
    return True


def wants_pictures(obs_mode: str | None) -> bool:
    """Whether an observation mode has pictures, or what is made of them; None is the mode of a task, without any."""
    return obs_mode is not None and not set(obs_mode.split("+")) <= set(STATE_MODES)


def refuse_pictures(obs_mode: str | None, render_mode: str | None) -> NoReturn:
    """Says that pictures are needed that nothing here can draw.

    Raises:
        InputError: always.
    """
    wish = f"obs_mode {obs_mode!r}" if wants_pictures(obs_mode) else f"render_mode {render_mode!r}"
    if can_render():
        why, mend = "render_backend is 'none'", "leave render_backend out"
    else:
        why, mend = "SAPIEN finds no Vulkan driver", "install one, such as Mesa's (docs/rendering.md in the project)"
    raise InputError(
        f'{wish} needs pictures, but {why}: {mend}, or use obs_mode "state" and no render_mode, which need none.'
    )


def replace_materials() -> None:
    """Makes `sapien.render.RenderMaterial` a `NoMaterial`, from now on and in the whole process.

    Asked for in one place only: where a scene on `physx_cpu_batch` is made without a renderer
    (`dora.sim.batch.hooks`), because ManiSkill's tasks make materials there for visuals that are never built.
    """
    for module in (sapien.render, pysapien.render, urdf_loader, _mjcf_loader):
        vars(module)["RenderMaterial"] = NoMaterial
