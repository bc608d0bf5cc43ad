"""The parts of guidance: what affordances and candidates add to a task, one by one."""

from collections.abc import Sequence

from dora.errors import InputError

GUIDANCE = ("affordance", "none")
"""Values of the switch `guidance`."""
OBSERVATION, REWARD, FILTER, PRIOR = PARTS = ("observation", "reward", "filter", "prior")
"""The parts of guidance: features in the observation, terms of the reward, choice among reachable candidates only,
and the reference to which the action is a residual."""


def guidance_in_force(guidance: str, parts: Sequence[str] | None) -> frozenset[str]:
    """The parts of guidance that a task has: all of them, or those that are named; none with `guidance="none"`.

    Raises:
        InputError: for an unknown guidance or part, or parts of no guidance.
    """
    if guidance not in GUIDANCE:
        raise InputError(f"unknown guidance {guidance!r}; choose one of {', '.join(GUIDANCE)}")
    if guidance == "none":
        if parts:
            raise InputError('guidance="none" has no parts; leave guidance_parts out, or choose guidance="affordance"')
        return frozenset()
    if parts is None:
        return frozenset(PARTS)
    named = (parts,) if isinstance(parts, str) else tuple(parts)
    if unknown := set(named) - set(PARTS):
        raise InputError(f"unknown guidance part {sorted(unknown)[0]!r}; choose among {', '.join(PARTS)}")
    return frozenset(named)
