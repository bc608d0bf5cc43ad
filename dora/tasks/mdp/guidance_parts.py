"""The ladder of guidance, and its parts: what candidates and affordances add to a task, one by one.

none        the raw action: no candidates, no reference, no region
grasps      candidates of a search that knows no region, as prior, filter, observation and reward
affordance  candidates that hold the target region, and that region in observation and reward
"""

from collections.abc import Collection
from typing import Any

from dora.errors import InputError, shown

GUIDANCE = ("affordance", "grasps", "none")
"""Values of the switch `guidance`."""
OBSERVATION, REWARD, FILTER, PRIOR = PARTS = ("observation", "reward", "filter", "prior")
"""The parts of guidance: features in the observation, terms of the reward, choice among reachable candidates only,
and the reference to which the action is a residual."""
REGION = "region"
"""In force with `guidance="affordance"`: candidates, observation and reward know the object's regions."""


def guidance_in_force(guidance: str, parts: Any) -> frozenset[str]:
    """The parts of guidance that a task has: all of them, or those that are named, and `REGION` where affordances are
    used; none with `guidance="none"`.

    Raises:
        InputError: for an unknown guidance or part, or parts of no guidance.
    """
    if guidance not in GUIDANCE:
        raise InputError(f"unknown guidance {guidance!r}; choose one of {', '.join(GUIDANCE)}")
    if guidance == "none":
        if parts:
            raise InputError('guidance="none" has no parts; leave guidance_parts out, or choose guidance="affordance"')
        return frozenset()
    if not (parts is None or isinstance(parts, str | Collection)):
        raise InputError(f"guidance_parts must be a list of {', '.join(PARTS)}, not {parts!r}")
    named = PARTS if parts is None else (parts,) if isinstance(parts, str) else tuple(parts)
    if unknown := [part for part in named if part not in PARTS]:
        raise InputError(f"unknown guidance part {shown(unknown[0])}; choose among {', '.join(PARTS)}")
    return frozenset(named) | ({REGION} if guidance == "affordance" else frozenset())


def exists(part: str | None, region: bool, parts: frozenset[str]) -> bool:
    """Whether something that belongs to a part of guidance (None: to the task itself) and, if `region`, to what
    affordances add to it, exists with these parts."""
    return (part is None or part in parts) and (not region or REGION in parts)
