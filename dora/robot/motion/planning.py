"""Collision-free arm motions: RRT-Connect of OMPL on the collision model, then shortcuts, smoothing and timing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from dora.errors import InputError
from dora.robot.motion.collision import CollisionModel, need

RESOLUTION = 0.02
"""Distance in joint space of the postures that are tested while planning [rad]."""
FINE_RESOLUTION = 0.005
"""Distance in joint space of the postures that are tested on the finished path [rad]."""
RANGE = 0.8
"""Largest length of an edge that the planner adds to its trees [rad]."""
EDGE_LIMIT = 0.05
"""Largest distance between two way points of the returned path [rad]."""
SMOOTHING_STEPS = 3
"""Number of subdivisions of the B-spline that rounds off corners."""


@dataclass(frozen=True)
class PlanSettings:
    """Effort of the planner.

    Attributes:
        checks: number of calls of the termination condition after which a search ends; about the number of nodes.
        attempts: number of searches, each with its own seed and half the resolution of the one before.
        seed: seed of the first search; the same seed gives the same path.
    """

    checks: int = 400
    attempts: int = 2
    seed: int = 0


def plan(
    model: CollisionModel,
    start: Float[np.ndarray, " dof"],
    goal: Float[np.ndarray, " dof"],
    hand: Float[np.ndarray, " h"],
    settings: PlanSettings | None = None,
) -> Float[np.ndarray, "k dof"] | None:
    """A collision-free path of arm postures from `start` to `goal`.

    The straight line in joint space is taken where it is free, so most paths need no search.

    Args:
        model: collision model, with the object at the pose of its last `place_object`.
        start: arm joints [rad].
        goal: arm joints [rad].
        hand: hand joints, constant during the motion [rad].
        settings: effort and seed.

    Returns:
        k way points [rad], at most `EDGE_LIMIT` apart, within the joint limits and free at `FINE_RESOLUTION`; None if
        no path was found or `start` or `goal` is in collision.

    Raises:
        InputError: OMPL is not installed, or `start` or `goal` is outside the joint limits.
    """
    settings = settings or PlanSettings()
    arm = model.robot.arm
    for name, q in (("start", start), ("goal", goal)):
        if not ((q >= arm.lower) & (q <= arm.upper)).all():
            raise InputError(
                f"the {name} of the motion is outside the joint limits of {model.robot.name!r}; move it inside"
            )
    if not model.free(np.stack([start, goal]), hand):
        return None
    straight = densified(np.stack([start, goal]), EDGE_LIMIT)
    if model.free(densified(straight, FINE_RESOLUTION), hand):
        return straight
    for attempt in range(settings.attempts):
        path = _search(model, start, goal, hand, settings.seed + attempt, RESOLUTION / 2**attempt, settings.checks)
        if path is not None and model.free(densified(path, FINE_RESOLUTION), hand):
            return densified(path, EDGE_LIMIT)
    return None


def densified(path: Float[np.ndarray, "k dof"], spacing: float) -> Float[np.ndarray, "m dof"]:
    """The same polyline with points at most `spacing` apart (Euclidean distance, in the path's unit)."""
    counts = np.maximum(1, np.ceil(np.linalg.norm(np.diff(path, axis=0), axis=1) / spacing)).astype(int)
    pieces = [a + (b - a) * np.arange(n)[:, None] / n for a, b, n in zip(path[:-1], path[1:], counts, strict=True)]
    return np.concatenate([*pieces, path[-1:]])


def _search(
    model: CollisionModel,
    start: np.ndarray,
    goal: np.ndarray,
    hand: np.ndarray,
    seed: int,
    resolution: float,
    checks: int,
) -> np.ndarray | None:
    """One run of RRT-Connect with shortening and smoothing; None if it finds nothing."""
    base, geometric, util = need("ompl.base", "ompl"), need("ompl.geometric", "ompl"), need("ompl.util", "ompl")
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed + 1)  # OMPL draws a random seed for 0
    arm, dof = model.robot.arm, len(start)
    space = base.RealVectorStateSpace(dof)
    bounds = base.RealVectorBounds(dof)
    for i in range(dof):
        bounds.setLow(i, float(arm.lower[i]))
        bounds.setHigh(i, float(arm.upper[i]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: model.free(_array(state, dof)[None], hand))
    information = setup.getSpaceInformation()
    space.setLongestValidSegmentFraction(resolution / space.getMaximumExtent())
    planner = geometric.RRTConnect(information)
    planner.setRange(RANGE)
    setup.setPlanner(planner)
    setup.setStartAndGoalStates(_state(space, start), _state(space, goal))
    asked = iter(range(checks))
    setup.solve(base.PlannerTerminationCondition(lambda: next(asked, None) is None))
    if not setup.haveExactSolutionPath():
        return None
    path = setup.getSolutionPath()
    simplifier = geometric.PathSimplifier(information)
    simplifier.reduceVertices(path)
    simplifier.partialShortcutPath(path)
    simplifier.smoothBSpline(path, SMOOTHING_STEPS)
    return np.stack([_array(state, dof) for state in path.getStates()])


def _array(state: Any, dof: int) -> np.ndarray:
    return np.array([state[i] for i in range(dof)])


def _state(space: Any, q: np.ndarray) -> Any:
    state = space.allocState()
    for i, value in enumerate(q):
        state[i] = float(value)
    return state
