"""Whether this machine can render, and what to do for tasks that insist on materials when it cannot."""

from functools import cache
from typing import Any

import sapien
from mani_skill.utils.building import _mjcf_loader
from sapien import pysapien
from sapien.wrapper import urdf_loader


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

    If it finds none, `sapien.render.RenderMaterial` becomes `NoMaterial` from then on.
    """
    try:
        # The render system must come before any material: SAPIEN binds to the device of the first it meets.
        sapien.render.RenderSystem(sapien.Device("cpu"))
    except RuntimeError:
        for module in (sapien.render, pysapien.render, urdf_loader, _mjcf_loader):
            vars(module)["RenderMaterial"] = NoMaterial
        return False
    return True
