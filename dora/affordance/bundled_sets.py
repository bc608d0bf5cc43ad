"""The candidates that lie in an object's folder: validated, ranked, one file per object."""

from __future__ import annotations

import os
from pathlib import Path

from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.robot import RobotDescription, load_robot

ROBOT = "diana7_hit"
"""Robot for which candidates are bundled."""
GRASPS_FILE, ANY_REGION_FILE = "grasps.safetensors", "grasps-any-region.safetensors"
"""Names of the files of candidates in an object's folder: of a search for the target region, and of one that knows no
region."""
ENDING = ".safetensors"
"""Ending of these files."""


def bundled_path(name: str | Path, region: bool = True, task: str | None = None) -> Path:
    """Where the bundled candidates of an object are, or would be.

    Args:
        name: of an object or its folder, as for `load_object`.
        region: those of the search for the target region, or of the one that knows no region.
        task: those that were ranked by executing them in this task, where that is not the first that uses the object.

    Raises:
        InputError: there is no such object, or it is a mesh without a folder.
    """
    obj = load_object(name)
    if obj.folder is None:
        raise InputError(
            f"the object {obj.name!r} has no folder for its grasps: "
            f"write one with python -m dora.affordance.objects.build {obj.name} --mesh {name}."
        )
    file = GRASPS_FILE if region else ANY_REGION_FILE
    return obj.folder / (file if task is None else f"{file.removesuffix(ENDING)}-{task}{ENDING}")


def best_candidates(
    name: str | Path, grasp_class: str, least: float, most: int, region: bool = True, task: str | None = None
) -> GraspCandidates:
    """The bundled candidates that succeeded often enough, best first; of one class, if the search knew the region.

    Args:
        name: of an object or its folder, as for `load_object`.
        grasp_class: such as "HandleGrasp".
        least: smallest score (share of executions that succeeded), as a share of the best one's; candidates without a
            score are left out.
        most: largest number of candidates.
        region: as for `bundled_path`; without it candidates of all classes are taken.
        task: as for `bundled_path`.
    """
    found = load_candidates(name, region=region, task=task)
    found = found.select(found.of_class(grasp_class)) if region else found
    return found.select(found.score >= least * found.score.nan_to_num(nan=0.0).max()).select(slice(most))


def load_candidates(
    name: str | Path, robot: RobotDescription | None = None, region: bool = True, task: str | None = None
) -> GraspCandidates:
    """The validated and ranked candidates in an object's folder, best first.

    Args:
        name: of an object or its folder, as for `load_object`.
        robot: that has to fit (default diana7_hit).
        region: as for `bundled_path`.
        task: as for `bundled_path`.

    Raises:
        InputError: unknown object, no candidates, or candidates that do not fit the object or the robot.
    """
    path = bundled_path(name, region, task)
    if not os.path.isfile(path):
        option = "" if region else " --any-region"
        if task is None:
            how = f"make them with `dora grasps --object {name} --make-bundle{option}`"
        else:
            ranking = f"dora grasps --object ... --rank-in-task{option}"
            how = f"they are made with those of the other object of {task}, by `{ranking}`"
        raise InputError(f"the object {str(name)!r} has no grasps ({path}): {how}.")
    return GraspCandidates.load(path, load_object(name), robot or load_robot(ROBOT))
