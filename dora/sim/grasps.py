"""From an object to judged grasps: search, validation in simulation, and the numbers that are reported."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.energies import Weights
from dora.affordance.optimise import Settings, optimise
from dora.affordance.protocol import STANDARD, Protocol
from dora.affordance.structure import AffordanceObject
from dora.progress import PhaseProgress
from dora.robot import RobotDescription
from dora.sim.validation import validate

MILLIMETRES = 1000.0
"""Per metre."""
BASELINES = {
    "no_closure": Settings(weights=Weights(closure=0.0), seat=0.0),
    "one_iteration": Settings(iterations=1, seat=0.0),
}
"""Searches that lack what they are compared for: the weight of E_DFC is 0, or there is no search. The hand is not
closed around the object after them, which would mend much of it."""


@dataclass(frozen=True, eq=False)
class Generated:
    """Candidates with the verdict on each, and what it took.

    Attributes:
        candidates: all that the search gave; `valid` if they passed the simulation (when there was one) and stay
            below the protocol's penetration; without a simulation, if they touch and stay below it.
        requested: number asked for.
        region: label asked for, None for a free search.
        seed: of the search.
        optimise_seconds, validate_seconds: wall time [s].
        passed: (c,) whether the simulation was passed; None without one.
        strict: (c,) valid, and within the strict limits of self-penetration and of motion while closing; None
            without a simulation.
    """

    candidates: GraspCandidates
    requested: int
    region: str | None
    seed: int
    optimise_seconds: float
    validate_seconds: float
    passed: Bool[Tensor, " c"] | None
    strict: Bool[Tensor, " c"] | None


def generate(
    obj: AffordanceObject,
    robot: RobotDescription,
    num: int,
    seed: int,
    region: str | None,
    phases: PhaseProgress,
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
    report = phases.phase(f"{name}: search", "candidates", scale=1 / settings.iterations)
    found = optimise(obj, robot, num, seed, region, settings, progress=report)
    between = time.perf_counter()
    passed = strict = None
    if simulate:
        verdict = validate(found, obj, robot, protocol, progress=phases.phase(f"{name}: simulation", "candidates"))
        passed, valid, strict = verdict.passed, verdict.valid, verdict.strict
    else:
        valid = (found.penetration <= protocol.penetration) & (found.contact_finger > 0).any(1)
    end = time.perf_counter()
    judged = repr(protocol) if simulate else None
    origin = {"search": found.settings, "region": region, "seed": seed, "protocol": judged}
    candidates = replace(found, valid=valid, settings=json.dumps(origin))
    return Generated(candidates, num, region, seed, between - start, end - between, passed, strict)


def summary(generated: Generated) -> dict[str, Any]:
    """What is reported of a run, as JSON can hold it. Shares are of all candidates; lengths in mm.

    `penetration_mm` and `energy` are over all candidates, `classes` counts the valid ones.
    """
    c = generated.candidates
    valid = int(c.valid.sum())
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
        "sim_success_rate": _share(generated.passed),
        "valid_share": _share(c.valid),
        "strict_share": _share(generated.strict),
        "penetration_mm": _spread(c.penetration),
        "self_penetration_mm": _spread(c.self_penetration),
        "classes": c.select(c.valid).counts() if valid else {},
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
    phases: PhaseProgress,
    simulate: bool = True,
) -> dict[str, dict[str, Any]]:
    """Summaries of `BASELINES`; arguments as of `generate`."""
    return {
        name: summary(generate(obj, robot, num, seed, region, phases, simulate, settings, name=name))
        for name, settings in BASELINES.items()
    }


def origin_digest(candidates: GraspCandidates) -> str:
    """sha256 of what candidates depend on: object, robot and settings."""
    origin = [candidates.digest, candidates.robot_digest, candidates.settings]
    return hashlib.sha256(json.dumps(origin).encode()).hexdigest()


def _share(mask: Tensor | None) -> float | None:
    return None if mask is None else float(mask.float().mean())


def _spread(lengths: Tensor) -> dict[str, float]:
    """Quantiles of lengths [m] in mm."""
    quantiles = torch.quantile(lengths.double(), torch.tensor([0.5, 0.9, 0.95, 1.0], dtype=torch.float64))
    names = ("median", "p90", "p95", "max")
    return {name: MILLIMETRES * float(value) for name, value in zip(names, quantiles, strict=True)}
