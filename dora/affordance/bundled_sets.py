"""The candidates that come with Dora: validated, ranked, one file per object."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.errors import InputError
from dora.robot import RobotDescription, load_robot

ROBOT = "diana7_hit"
"""Robot for which candidates are shipped."""


def data_folder() -> Path:
    """Where the data that come with Dora are."""
    return Path(str(importlib.resources.files("dora.affordance") / "data"))


def bundled_path(name: str) -> Path:
    """Where the shipped candidates of an object are."""
    return data_folder() / f"{name}.safetensors"


def best_candidates(name: str, grasp_class: str, least: float, most: int) -> GraspCandidates:
    """The shipped candidates of one class that succeeded often enough, best first.

    Args:
        name: one of our objects.
        grasp_class: such as "HandleGrasp".
        least: smallest score (share of executions that succeeded); candidates without one are left out.
        most: largest number of candidates.
    """
    found = load_candidates(name)
    return found.select(found.of_class(grasp_class) & (found.score >= least)).select(slice(most))


def load_candidates(name: str, robot: RobotDescription | None = None) -> GraspCandidates:
    """The shipped, validated and ranked candidates of an object of ours, best first.

    Raises:
        InputError: unknown object, or candidates that do not fit the object or the robot (default diana7_hit).
    """
    if name not in available_objects():
        raise InputError(f"there is no object {name!r}; available: {', '.join(available_objects())}.")
    return GraspCandidates.load(bundled_path(name), load_object(name), robot or load_robot(ROBOT))
