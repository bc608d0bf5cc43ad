"""The candidates that lie in an object's folder: validated, ranked, one file per object."""

from __future__ import annotations

from pathlib import Path

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.robot import RobotDescription, load_robot

ROBOT = "diana7_hit"
"""Robot for which candidates are bundled."""
GRASPS_FILE = "grasps.safetensors"
"""Name of the file of candidates in an object's folder."""


def bundled_path(name: str | Path) -> Path:
    """Where the bundled candidates of an object are, or would be.

    Raises:
        InputError: there is no such object, or it is a mesh without a folder.
    """
    obj = load_object(name)
    if obj.folder is None:
        raise InputError(
            f"the object {obj.name!r} has no folder for its grasps: "
            f"write one with python -m dora.affordance.objects.build {obj.name} --mesh {name}."
        )
    return obj.folder / GRASPS_FILE


def best_candidates(name: str | Path, grasp_class: str, least: float, most: int) -> GraspCandidates:
    """The bundled candidates of one class that succeeded often enough, best first.

    Args:
        name: of an object or its folder, as for `load_object`.
        grasp_class: such as "HandleGrasp".
        least: smallest score (share of executions that succeeded); candidates without one are left out.
        most: largest number of candidates.
    """
    found = load_candidates(name)
    return found.select(found.of_class(grasp_class) & (found.score >= least)).select(slice(most))


def load_candidates(name: str | Path, robot: RobotDescription | None = None) -> GraspCandidates:
    """The validated and ranked candidates in an object's folder, best first.

    Args:
        name: of an object or its folder, as for `load_object`.
        robot: that has to fit (default diana7_hit).

    Raises:
        InputError: unknown object, no candidates, or candidates that do not fit the object or the robot.
    """
    path = bundled_path(name)
    if not path.is_file():
        raise InputError(
            f"the object {str(name)!r} has no grasps ({path}): "
            f"make them with python experiments/grasps.py --object {name} --make-bundle."
        )
    return GraspCandidates.load(path, load_object(name), robot or load_robot(ROBOT))
