"""From an object to judged grasps: search, validation in simulation, and the numbers that are reported."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.protocol import STANDARD, Protocol
from dora.affordance.maps.confusion import Agreement, clearly_held
from dora.affordance.maps.voting import vote
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.search.cache import map_of
from dora.affordance.search.energies import Weights
from dora.affordance.search.optimise import Settings, optimise
from dora.digests import digest_of
from dora.parallel import warm_up
from dora.progress import ProgressDisplay
from dora.robot import RobotDescription
from dora.sim.grasp_tests.shake_test import ShakeTest, Validation, validate

MILLIMETRES = 1000.0
"""Per metre."""
_NO_CLOSURE = Weights(closure=0.0)
BASELINES = {
    "no_closure": Settings(weights=_NO_CLOSURE),
    "unseated": Settings(seat=0.0),
    "unseated_no_closure": Settings(weights=_NO_CLOSURE, seat=0.0),
    "unseated_one_iteration": Settings(iterations=1, seat=0.0),
}
"""Searches that lack what they are compared for: the weight of E_DFC is 0; the hand is not closed around the object
after the search (`unseated`), which mends much of what a search lacks; both; or there is no search."""


CANDIDATE, CLOSED = "candidate", "closed_hand"
"""Which contacts vote: those at the candidate, or those of the simulated hand after closing."""
FREE = "any"
"""Name of a search without a region."""


@dataclass(frozen=True, eq=False)
class Generated:
    """Candidates with the verdict on each, and what it took.

    Attributes:
        candidates: all that the search gave; `valid` if they passed the simulation (when there was one) and stay
            below the protocol's penetration; without a simulation, if they touch and stay below it. Once simulated,
            their class is what the contacts of the closed hand vote for.
        requested: number asked for.
        region: label asked for, None for a free search.
        seed: of the search.
        optimise_seconds, validate_seconds: wall time [s].
        verdict: of the simulation; None without one.
        voting: votes of the contacts at the candidate and of those of the closed hand; empty without a simulation.
    """

    candidates: GraspCandidates
    requested: int
    region: str | None
    seed: int
    optimise_seconds: float
    validate_seconds: float
    verdict: Validation | None
    voting: dict[str, Tensor]


def generate(
    obj: AffordanceObject,
    robot: RobotDescription,
    num: int,
    seed: int,
    region: str | None,
    phases: ProgressDisplay,
    simulate: bool = True,
    settings: Settings | None = None,
    protocol: Protocol = STANDARD,
    name: str = "grasps",
) -> Generated:
    """Search for grasps and judge them.

    Args:
        obj: object.
        robot: whose hand it is.
        num: candidates wanted.
        seed: of all random draws.
        region: label to be held; None leaves it open.
        phases: where progress is shown.
        simulate: whether to validate in SAPIEN; otherwise penetration and touch decide.
        settings: of the search.
        protocol: of the validation.
        name: of this run, for the progress.

    Raises:
        InputError: `num` is less than 1, or the object has no such region or does not suit the hand.
    """
    settings = settings or Settings()
    start = time.perf_counter()
    if simulate:
        warm_up(ShakeTest)
    report = phases.phase(f"{name}: search", "candidates", scale=1 / settings.iterations)
    found = optimise(obj, robot, num, seed, region, settings, progress=report)
    between = time.perf_counter()
    verdict, voting = None, {}
    if simulate:
        verdict = validate(found, obj, robot, protocol, progress=phases.phase(f"{name}: simulation", "candidates"))
        valid, voting = verdict.valid, votes(found, verdict, obj)
        found = replace(found, grasp_class=_classes(found, voting[CLOSED], obj))
    else:
        valid = (found.penetration <= protocol.penetration) & (found.contact_finger > 0).any(1)
    end = time.perf_counter()
    judged = repr(protocol) if simulate else None
    origin = {"search": found.settings, "region": region, "seed": seed, "protocol": judged}
    candidates = replace(found, valid=valid, settings=json.dumps(origin))
    return Generated(candidates, num, region, seed, between - start, end - between, verdict, voting)


def summary(generated: Generated) -> dict[str, Any]:
    """What is reported of a run, as JSON can hold it. Shares are of all candidates; lengths in mm.

    `penetration_mm` and `energy` are over all candidates, `classes` counts the valid ones.
    """
    c = generated.candidates
    valid, verdict = int(c.valid.sum()), generated.verdict
    counts = c.select(c.valid).counts() if valid else {}
    seconds = generated.optimise_seconds + generated.validate_seconds
    return {
        "object": c.object,
        "robot": c.robot,
        "requested": generated.requested,
        "optimised": len(c),
        "valid": valid,
        "valid_per_second": valid / seconds,
        "optimise_seconds": generated.optimise_seconds,
        "validate_seconds": generated.validate_seconds,
        "sim_success_rate": _share(verdict and verdict.passed),
        "valid_share": _share(c.valid),
        "strict_share": _share(verdict and verdict.strict),
        "penetration_mm": _spread(c.penetration),
        "self_penetration_mm": _spread(c.self_penetration),
        "classes": counts,
        "class_shares": {name: count / valid for name, count in counts.items()},
        "energy": {name: float(value.median()) for name, value in c.energy.items()},
        "region": generated.region,
        "seed": generated.seed,
        "digest": origin_digest(c),
    }


def baselines(
    obj: AffordanceObject,
    robot: RobotDescription,
    num: int,
    seed: int,
    region: str | None,
    phases: ProgressDisplay,
    simulate: bool = True,
) -> dict[str, dict[str, Any]]:
    """Summaries of `BASELINES`; arguments as of `generate`."""
    return {
        name: summary(generate(obj, robot, num, seed, region, phases, simulate, settings, name=name))
        for name, settings in BASELINES.items()
    }


def by_region(
    obj: AffordanceObject, robot: RobotDescription, num: int, seed: int, region: str | None, phases: ProgressDisplay
) -> dict[str, Generated]:
    """Simulated grasps of a free search ("any") and of one for each region, but for the one that is `region`.

    Other arguments as of `generate`.
    """
    others = {FREE: None} | {label: label for label in obj.labels}
    return {
        name: generate(obj, robot, num, seed, label, phases, name=name)
        for name, label in others.items()
        if label != region
    }


def votes(candidates: GraspCandidates, verdict: Validation, obj: AffordanceObject) -> dict[str, Int[Tensor, " c"]]:
    """Regions that the contacts vote for, at the candidate and after closing; -1 without contact."""
    regions = map_of(obj, "cpu")
    return {
        CANDIDATE: vote(regions, candidates.contacts.cpu(), candidates.contact_finger.cpu()),
        CLOSED: vote(regions, verdict.contacts, verdict.contact_finger),
    }


def voting_summary(several: Iterable[Generated], obj: AffordanceObject) -> dict[str, Any]:
    """Agreement of the votes with the region that carries most contact force after closing, as JSON can hold it.

    Over the simulated grasps of all searches together whose hand presses on the object after closing: "all", "clear"
    where one region carries two thirds of the force or more, and the same of the "valid" ones, which tasks use.
    """
    simulated = [(g.verdict, g.voting) for g in several if g.verdict is not None]
    force = torch.cat([verdict.label_force for verdict, _ in simulated])
    pressed, clear = force.sum(1) > 0, clearly_held(force)
    valid = torch.cat([verdict.valid for verdict, _ in simulated])
    voted = {kind: torch.cat([votes[kind] for _, votes in simulated]) for kind in (CANDIDATE, CLOSED)}
    groups = {"all": pressed, "clear": clear, "valid": pressed & valid, "valid_clear": clear & valid}
    found: dict[str, Any] = {"labels": list(obj.labels)}
    for group, rows in groups.items():
        found[group] = {"grasps": int(rows.sum())}
        for kind, choice in voted.items():
            agreement = Agreement.of(obj.labels, choice[rows], force[rows].argmax(1))
            found[group][kind] = {
                "balanced_accuracy": agreement.balanced_accuracy,
                "recall": agreement.recall,
                "confusion": agreement.confusion.tolist(),
            }
    return found


def _classes(candidates: GraspCandidates, voted: Int[Tensor, " c"], obj: AffordanceObject) -> tuple[str, ...]:
    """The classes of what is voted for; where nothing is, the candidates' own."""
    own = candidates.grasp_class
    return tuple(obj.classes[label] if label >= 0 else own[row] for row, label in enumerate(voted.tolist()))


def origin_digest(candidates: GraspCandidates) -> str:
    """sha256 of what candidates depend on: object, robot and settings."""
    return digest_of([candidates.digest, candidates.robot_digest, candidates.settings])


def _share(mask: Tensor | None) -> float | None:
    return None if mask is None else float(mask.float().mean())


def _spread(lengths: Tensor) -> dict[str, float]:
    """Quantiles of lengths [m] in mm."""
    quantiles = torch.quantile(lengths.double(), torch.tensor([0.5, 0.9, 0.95, 1.0], dtype=torch.float64))
    names = ("median", "p90", "p95", "max")
    return {name: MILLIMETRES * float(value) for name, value in zip(names, quantiles, strict=True)}
