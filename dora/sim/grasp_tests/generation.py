"""From an object to validated grasps: search, grasp test in simulation, and the reported numbers."""

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
from dora.affordance.contact_maps import mapped
from dora.affordance.hand.grasp_test_settings import STANDARD, GraspTestSettings
from dora.affordance.maps.confusion import Confusion, clearly_dominant
from dora.affordance.maps.voting import vote, vote_over_map
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.search.cache import hand_of, map_of
from dora.affordance.search.energies import Weights
from dora.affordance.search.optimise import Settings, optimise
from dora.digests import digest_of
from dora.parallel import warm_up
from dora.progress import ProgressDisplay
from dora.robot import RobotDescription
from dora.sim.grasp_tests.failures import failures
from dora.sim.grasp_tests.shake_test import ShakeTest, Validation, validate

MILLIMETRES = 1000.0
"""Millimetres per metre [1]."""
_NO_CLOSURE = Weights(closure=0.0)
"""Weights of the energy without E_DFC."""
BASELINES: dict[str, dict[str, Any]] = {
    "no_closure": {"weights": _NO_CLOSURE},
    "unseated": {"seat": 0.0},
    "unseated_no_closure": {"weights": _NO_CLOSURE, "seat": 0.0},
    "unseated_one_iteration": {"iterations": 1, "seat": 0.0},
}
"""Changed settings of searches for comparison, each without one part: without E_DFC; without closing the hand around
the object after the search (`unseated`); without both; with a single iteration."""


CANDIDATE, MAP, CLOSED = "candidate", "contact_map", "closed_hand"
"""What votes: the contacts stored with the candidate, its contact semantic map (the vote as the paper prints it), and
the contacts of the simulated hand after closing."""
KINDS = (CANDIDATE, MAP, CLOSED)
"""All that vote, in the order of reports."""
FREE = "any"
"""Name of a search without a region."""


@dataclass(frozen=True, eq=False)
class Generated:
    """Candidates of a search with the results of their validation.

    Attributes:
        candidates: all candidates of the search. After a simulation they are `valid` if they passed and are within the
            grasp test's penetration limit, and their class is the vote of the closed hand's contacts. Without one they
            are `valid` if they touch and are within that limit.
        requested: number of candidates asked for.
        region: label asked for; None for a search without a region.
        seed: seed of the search.
        optimise_seconds, validate_seconds: wall time of search and validation [s].
        verdict: results of the simulation; None without one.
        voting: votes (c,) by what votes, `CANDIDATE`, `MAP` and `CLOSED`; empty without a simulation.
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
    test_settings: GraspTestSettings = STANDARD,
    name: str = "grasps",
    kinematics: str = "compiled",
) -> Generated:
    """Search for grasps and validate them.

    Args:
        obj: the object.
        robot: the robot whose hand grasps.
        num: number of candidates.
        seed: seed of all random draws.
        region: label of the region to be held; None for any.
        phases: display of the progress.
        simulate: whether to validate in SAPIEN; otherwise penetration depth and contact at the candidate decide.
        settings: settings of the search; the defaults if None.
        test_settings: settings of the grasp test.
        name: name of this run in the progress display.
        kinematics: kinematics and gradients of the search, as for `optimise`.

    Raises:
        InputError: `num` is less than 1, or the object has no such region or does not suit the hand, or kinematics are
            unknown.
    """
    settings = settings or Settings()
    start = time.perf_counter()
    if simulate:
        warm_up(ShakeTest)
    report = phases.phase(f"{name}: search", "candidates", scale=1 / settings.iterations)
    found = optimise(obj, robot, num, seed, region, settings, progress=report, kinematics=kinematics)
    between = time.perf_counter()
    verdict, voting = None, {}
    if simulate:
        verdict = validate(found, obj, robot, test_settings, progress=phases.phase(f"{name}: simulation", "candidates"))
        valid, voting = verdict.valid, votes(found, verdict, obj, robot)
        found = replace(found, grasp_class=_classes(found, voting[CLOSED], obj))
    else:
        valid = (found.penetration <= test_settings.penetration) & (found.contact_finger > 0).any(1)
    end = time.perf_counter()
    tested = repr(test_settings) if simulate else None
    origin = {"search": found.settings, "region": region, "seed": seed, "grasp_test": tested, "mass_kg": obj.mass}
    candidates = replace(found, valid=valid, settings=json.dumps(origin))
    return Generated(candidates, num, region, seed, between - start, end - between, verdict, voting)


def summary(generated: Generated) -> dict[str, Any]:
    """The report of a run as values for JSON; docs/affordance.md explains the keys.

    Shares, `penetration_mm` and `energy` are over all candidates, `classes` over the valid ones.
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
        "failures": failures(c, verdict),
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
    kinematics: str = "compiled",
    settings: Settings | None = None,
) -> dict[str, dict[str, Any]]:
    """Summaries of searches that differ from `settings` by `BASELINES`, by name; arguments as for `generate`."""
    found = {}
    for name, changes in BASELINES.items():
        changed = replace(settings or Settings(), **changes)
        found[name] = summary(
            generate(obj, robot, num, seed, region, phases, simulate, changed, name=name, kinematics=kinematics)
        )
    return found


def by_region(
    obj: AffordanceObject,
    robot: RobotDescription,
    num: int,
    seed: int,
    region: str | None,
    phases: ProgressDisplay,
    kinematics: str = "compiled",
    settings: Settings | None = None,
) -> dict[str, Generated]:
    """Validated grasps of a search without a region ("any") and of one for each region other than `region`, by name.

    Other arguments as for `generate`.
    """
    others = {FREE: None} | {label: label for label in obj.labels}
    return {
        name: generate(obj, robot, num, seed, label, phases, settings=settings, name=name, kinematics=kinematics)
        for name, label in others.items()
        if label != region
    }


def votes(
    candidates: GraspCandidates, verdict: Validation, obj: AffordanceObject, robot: RobotDescription
) -> dict[str, Int[Tensor, " c"]]:
    """Votes of the contacts stored with the candidates, of their maps, and of the contacts after closing; -1: none."""
    regions = map_of(obj, "cpu")
    maps = mapped(candidates.to("cpu"), regions, hand_of(robot, "cpu")).contact_map
    return {
        CANDIDATE: vote(regions, candidates.contacts.cpu(), candidates.contact_finger.cpu()),
        MAP: vote_over_map(regions, maps),
        CLOSED: vote(regions, verdict.contacts, verdict.contact_finger),
    }


def voting_summary(several: Iterable[Generated], obj: AffordanceObject) -> dict[str, Any]:
    """Agreement of the votes with the region of largest contact force after closing, as values for JSON.

    The groups are the simulated grasps of all searches together with contact force after closing ("all"), those with
    a dominant region ("clear", see `clearly_dominant`), and the valid ones among both ("valid", "valid_clear").
    "map_by_closed_hand" counts the grasps of "all" by the vote of the closed hand (row) and of the map (column).
    """
    simulated = [(g.verdict, g.voting) for g in several if g.verdict is not None]
    force = torch.cat([verdict.label_force for verdict, _ in simulated])
    pressed, clear = force.sum(1) > 0, clearly_dominant(force)
    valid = torch.cat([verdict.valid for verdict, _ in simulated])
    voted = {kind: torch.cat([votes[kind] for _, votes in simulated]) for kind in KINDS}
    groups = {"all": pressed, "clear": clear, "valid": pressed & valid, "valid_clear": clear & valid}
    found: dict[str, Any] = {"labels": list(obj.labels)}
    for group, rows in groups.items():
        found[group] = {"grasps": int(rows.sum())}
        for kind, choice in voted.items():
            confusion = Confusion.of(obj.labels, choice[rows], force[rows].argmax(1))
            found[group][kind] = {
                "balanced_accuracy": confusion.balanced_accuracy,
                "recall": confusion.recall,
                "confusion": confusion.counts.tolist(),
            }
    both = Confusion.of(obj.labels, voted[MAP][pressed], voted[CLOSED][pressed])
    return found | {"map_by_closed_hand": both.counts.tolist()}


def _classes(candidates: GraspCandidates, voted: Int[Tensor, " c"], obj: AffordanceObject) -> tuple[str, ...]:
    """Grasp classes of the voted regions; the candidates' own where there is no vote."""
    own = candidates.grasp_class
    return tuple(obj.classes[label] if label >= 0 else own[row] for row, label in enumerate(voted.tolist()))


def origin_digest(candidates: GraspCandidates) -> str:
    """sha256 of what candidates depend on: object, robot and settings."""
    return digest_of([candidates.digest, candidates.robot_digest, candidates.settings])


def _share(mask: Tensor | None) -> float | None:
    return None if mask is None else float(mask.float().mean())


def _spread(lengths: Tensor) -> dict[str, float]:
    """Median, 90th and 95th percentile and maximum [mm] of lengths [m]."""
    quantiles = torch.quantile(lengths.double(), torch.tensor([0.5, 0.9, 0.95, 1.0], dtype=torch.float64))
    names = ("median", "p90", "p95", "max")
    return {name: MILLIMETRES * float(value) for name, value in zip(names, quantiles, strict=True)}
