"""Bundled grasps with invented verdicts, on which what is shown of grasps is tested."""

from dataclasses import replace

import torch

from dora.affordance.bundled_sets import bundled_path
from dora.affordance.candidates import GraspCandidates
from dora.robot import load_robot

COUNT = 12


def judged_grasps() -> GraspCandidates:
    """Grasps of the cube: every third is not valid, two classes take turns, energies are 0 .. 11, scores fall."""
    bundled = GraspCandidates.load(bundled_path("cube"), robot=load_robot("diana7_hit")).select(slice(COUNT))
    return replace(
        bundled,
        grasp_class=("BodyGrasp", "RimGrasp") * (COUNT // 2),
        valid=torch.arange(COUNT) % 3 != 2,
        energy={"closure": torch.arange(COUNT).float()},
        score=torch.linspace(1, 0, COUNT),
    )
