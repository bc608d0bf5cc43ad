"""The objects of the tasks, by name."""

from __future__ import annotations

import functools

from dora.affordance.objects.affordance_object import AffordanceObject, Piece
from dora.affordance.objects.models import cube, hammer, jug, microwave
from dora.errors import InputError

__all__ = ["AffordanceObject", "Piece", "available_objects", "load_object"]

BUILDERS = {"cube": cube.build, "jug": jug.build, "hammer": hammer.build, "microwave": microwave.build}
"""What makes each object."""


def available_objects() -> tuple[str, ...]:
    """Names that `load_object` knows."""
    return tuple(BUILDERS)


@functools.cache
def load_object(name: str) -> AffordanceObject:
    """An object of ours; built once per process, in well under a second.

    Args:
        name: one of `available_objects`; "microwave" is the handle of a microwave's door.

    Raises:
        InputError: there is no such object.
    """
    if name not in BUILDERS:
        raise InputError(f"There is no object {name!r}; choose one of: {', '.join(BUILDERS)}.")
    return BUILDERS[name]()
