"""Why candidates of a grasp search failed: counts by cause, and one sentence on what to do about it."""

from __future__ import annotations

from typing import Any

from jaxtyping import Bool
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.grasp_test_settings import STANDARD
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.sim.grasp_tests.shake_test import Reason, Validation

SIDES = ("down", "up", "along +x", "along -x", "along +y", "along -y")
"""Words for `dora.affordance.hand.grasp_test_settings.DIRECTIONS`, in the axes of the object."""
THROWN, UNTOUCHED, RELEASED = "lost while closing", "touched nothing after closing", "let go: no contact force left"
"""Causes of the simulation besides slips."""
SLIPPED = "slipped {}"
"""Cause of a slip under the weight in a direction."""
DEEP = "held, but overlaps with the object by more than {:.0f} mm"
"""Cause of a candidate that passes the simulation."""
NO_CONTACT = "touches nothing"
"""Cause without a simulation."""
FEW = 0.25
"""Share of valid candidates below which the causes are printed with a hint [1]."""
LIGHT = 0.1
"""Mass below which slips are not put down to the weight [kg]."""
WIDE = 0.08
"""Narrowest side above which few fingers reach around [m]: of cylinders 5, 6, 7 and 9 cm wide, .69, .54, .32 and .01 of
the candidates are valid."""
MILLIMETRES = 1000.0
"""Millimetres per metre [1]."""


def failures(candidates: GraspCandidates, verdict: Validation | None) -> dict[str, Any]:
    """Why candidates are not valid, as values for JSON.

    Args:
        candidates: c candidates with their validity.
        verdict: results of their simulation; None without one.

    Returns:
        "causes": number of candidates by cause, most frequent first, one cause each. "self_contact": number of all
        candidates at which the hand overlaps with itself by the strict limit or more. "failed": number that is not
        valid.
    """
    settings = STANDARD if verdict is None else verdict.test_settings
    masks = _without_simulation(candidates) if verdict is None else _simulated(verdict)
    failed, causes = ~candidates.valid, {}
    left = failed.clone()
    for name, mask in masks.items():
        causes[name] = int((left & mask).sum())
        left &= ~mask
    deep = DEEP.format(MILLIMETRES * settings.penetration)
    causes[deep if verdict is not None else deep.removeprefix("held, but ")] = int(left.sum())
    found = sorted(((n, c) for n, c in causes.items() if c), key=lambda item: -item[1])
    tangled = candidates.self_penetration >= settings.strict_self_penetration
    return {"failed": int(failed.sum()), "causes": dict(found), "self_contact": int(tangled.sum())}


def _without_simulation(candidates: GraspCandidates) -> dict[str, Bool[Tensor, " c"]]:
    """Masks of the causes that are known without a simulation, but for the overlap."""
    return {NO_CONTACT: ~(candidates.contact_finger > 0).any(1)}


def _simulated(verdict: Validation) -> dict[str, Bool[Tensor, " c"]]:
    """Masks of the causes found in the simulation; the first that applies counts."""
    slipped = verdict.reason == Reason.SLIPPED
    masks = {
        THROWN: verdict.reason == Reason.THROWN,
        UNTOUCHED: ~verdict.passed & ~verdict.touched.any(1),
        RELEASED: verdict.reason == Reason.RELEASED,
    }
    if verdict.direction is None:
        return masks | {SLIPPED.format("in some direction"): slipped}
    return masks | {SLIPPED.format(side): slipped & (verdict.direction == k) for k, side in enumerate(SIDES)}


def hint(found: dict[str, Any], obj: AffordanceObject, assumed: bool) -> str:
    """One sentence on the most frequent kind of cause; "" if nothing failed.

    Args:
        found: result of `failures`.
        obj: the object.
        assumed: whether its mass is an estimate.
    """
    causes: dict[str, int] = found["causes"]
    if not causes:
        return ""
    slips = {name: count for name, count in causes.items() if name.startswith("slipped")}
    others = {name: count for name, count in causes.items() if name not in slips}
    if sum(slips.values()) >= max(others.values(), default=0):
        return _slip_hint(max(slips, key=lambda name: slips[name]), obj, assumed)
    cause = max(others, key=lambda name: others[name])
    size = " x ".join(f"{100 * side:.1f}" for side in obj.mesh.extents) + " cm"
    if cause in (THROWN, UNTOUCHED, NO_CONTACT):
        what = "are lost while the hand closes" if cause == THROWN else "touch nothing"
        return f"most {what}: the object measures {size}; check --units and --scale, or ask for another --region."
    if cause == RELEASED:
        return f"most let go: the hand presses from one side of the {size} large object; ask for another --region."
    return "most overlap with the object: there is too little room for the fingers; ask for another --region."


def _slip_hint(slip: str, obj: AffordanceObject, assumed: bool) -> str:
    """What to do about slips, of which those by the name `slip` are the most frequent."""
    side, narrowest = slip.removeprefix("slipped "), float(obj.mesh.extents.min())
    weight = f"the object weighs {obj.mass:.2g} kg"
    wide = f", or ask for a --region narrower than its {100 * narrowest:.1f} cm" if narrowest > WIDE else ""
    if assumed:
        return f"most slip {side}: {weight}, which is an estimate; give its mass with --mass{wide}."
    if obj.mass >= LIGHT:
        return f"most slip {side}: {weight}; if that is right, ask for another --region or for more candidates."
    return f"most slip {side}, although {weight} only: ask for another --region or for more candidates."
