"""DoraPair-v1: two arms that face each other, one lifts a jug by its handle, the other a cube."""

from collections.abc import Mapping
from functools import partial
from typing import Any, ClassVar

import torch
from mani_skill.utils.structs import Pose
from torch import Tensor

from dora.affordance.bundled_sets import best_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.feasibility_table import Grid
from dora.tasks.cube import hand_made_candidates
from dora.tasks.env.arm import ArmSpec
from dora.tasks.env.registration import register_task
from dora.tasks.env.scene import TaskScene
from dora.tasks.env.starts import STANDING_DRAWS, standing
from dora.tasks.env.task import Task
from dora.tasks.guidance.grasp_and_lift import GraspReference, GraspSettings
from dora.tasks.guidance.reference import Reference
from dora.tasks.mdp.config import PenaltyWeights, TaskConfig
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.quantities import lifted, off_table, opposed, rise
from dora.tasks.mdp.rewards import Term, Terms
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage
from dora.tasks.mdp.terms import at_candidate, paper_penalty, penalties

LIFT = 0.10
"""Rise that counts as lifted [m]."""
CENTRES = {"left": (0.55, 0.28), "right": (0.45, -0.28)}
"""Middle of the area in which the object of each arm stands [m]."""


@register_task("DoraPair-v1")
class PairTask(Task):
    """Lift a jug with one arm and a cube with the other; the second arm stands opposite and looks back."""

    CONFIG = TaskConfig
    ARMS: ClassVar[Mapping[str, ArmSpec]] = {
        "left": ArmSpec("jug", position=(0.0, 0.28, 0.0)),
        "right": ArmSpec("cube", position=(1.0, -0.28, 0.0), quaternion=(0.0, 0.0, 0.0, 1.0)),
    }
    DRAWS = 2 * STANDING_DRAWS
    MAX_STEPS = 120
    LEARNERS: ClassVar[Mapping[str, Mapping[str, Any]]] = {"ppo": {}}

    def make_mdp(self, scene: TaskScene) -> Mdp[Snapshot]:
        arms = tuple(self.ARMS)

        def held(s: Snapshot, arm: str) -> Tensor:
            one = s.of(arm)
            return (lifted(one) > LIFT) & opposed(one)

        def progress(s: Snapshot) -> Tensor:
            return torch.stack([rise(s.of(arm), LIFT) for arm in arms]).mean(0)

        stages: list[Stage[Snapshot]] = [
            Stage("grasp", lambda s: opposed(s.of("left")) & opposed(s.of("right")), hold=0.15),
            Stage("lift", lambda s: held(s, "left") & held(s, "right"), hold=0.5),
        ]
        raised: Term[Snapshot] = Term(progress, 3.0)
        near: dict[str, Term[Snapshot]] = {
            f"candidate_{arm}": Term(lambda s, a=arm: at_candidate(s.of(a), off_table(s.of(a))), 0.3, guided=True)
            for arm in arms
        }
        terms = {**near, "lift": raised, **penalties(PenaltyWeights(), 0.0005, 0.005)}
        return Mdp(stages, Terms(terms), Terms({"lift": raised, **paper_penalty()}), self.config.penetration_limit)

    def candidates(self, arm: str, region: bool = True) -> GraspCandidates:
        return best_candidates("jug", "HandleGrasp", 0.5, 40) if arm == "left" else hand_made_candidates()

    def make_reference(self, scene: TaskScene, arm: str) -> Reference:
        settings = GraspSettings(hover=0.06 if arm == "left" else 0.0)
        return GraspReference(scene.num_envs, self.config.dt, scene.device, settings)

    def start_grid(self, arm: str) -> Grid:
        return Grid(CENTRES[arm], (0.04, 0.04))

    def place(self, scene: TaskScene, rows: Tensor, u: Tensor) -> None:
        for (name, arm), numbers in zip(scene.arms.items(), u.split(STANDING_DRAWS, -1), strict=True):
            obj = arm.spec.object
            column = list(scene.objects).index(obj)
            height = load_object(obj).support * scene.scale[rows, column]
            pose = standing(numbers, height, self.start_grid(name), partial(self.graspable, arm))
            scene.objects[obj].set_pose(Pose.create_from_pq(*pose))
