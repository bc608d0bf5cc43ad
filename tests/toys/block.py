"""DoraBlock-v1: grasp a block and lift it; what a task needs at least, and nothing else."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

from mani_skill.utils.structs import Pose
from torch import Tensor

from dora.affordance.reach.feasibility_table import Grid
from dora.tasks.env.arm import ArmSpec
from dora.tasks.env.registration import register_task
from dora.tasks.env.scene import TaskScene
from dora.tasks.env.starts import STANDING_DRAWS, standing
from dora.tasks.env.task import Task
from dora.tasks.mdp.config import PenaltyWeights, TaskConfig
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.quantities import lifted, off_table, opposed, rise, tips_in_object
from dora.tasks.mdp.rewards import Term, Terms
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage
from dora.tasks.mdp.terms import at_candidate, near_region, paper_grasp, paper_penalty, penalties


@dataclass(frozen=True, kw_only=True)
class BlockConfig(TaskConfig):
    """Numbers of the task."""

    lift: float = 0.10
    """Rise that counts as lifted [m]."""


@register_task("DoraBlock-v1")
class BlockTask(Task):
    """Grasp a block on a table and lift it."""

    CONFIG = BlockConfig
    ARMS: ClassVar[Mapping[str, ArmSpec]] = {"arm": ArmSpec("block")}
    DRAWS = STANDING_DRAWS
    MAX_STEPS = 100

    def make_mdp(self, scene: TaskScene) -> Mdp[Snapshot]:
        lift, weights = self.config.lift, PenaltyWeights()

        def held(s: Snapshot) -> Tensor:
            return (lifted(s) > lift) & opposed(s)

        stages = [
            Stage("grasp", opposed, hold=0.15),
            Stage("lift", held, hold=0.5, lost=lambda s: ~opposed(s), back_to="grasp"),
        ]
        tips = Entry(lambda s: tips_in_object(s).flatten(1), "m", "fingertips in the block's frame", True)
        near: Term[Snapshot] = Term(lambda s: near_region(tips_in_object(s).norm(dim=-1)), 0.3, "affordance", True)
        candidate: Term[Snapshot] = Term(lambda s: at_candidate(s, off_table(s)), 0.3, guided=True)
        raised: Term[Snapshot] = Term(lambda s: rise(s, lift), 3.0)
        terms = {"affordance": near, "candidate": candidate, "lift": raised, **penalties(weights, 0.0005, 0.005)}
        paper = {**paper_grasp(1), "lift": raised, **paper_penalty()}
        return Mdp(stages, Terms(terms), Terms(paper), self.config.penetration_limit, {"tips_in_block": tips})

    def start_grid(self, arm: str) -> Grid:
        return Grid((0.55, 0.0), (0.08, 0.08))

    def place(self, scene: TaskScene, rows: Tensor, u: Tensor) -> None:
        reachable = partial(self.startable, scene.arms["arm"])
        scene.object.set_pose(Pose.create_from_pq(*standing(u, scene.half[rows, 2], self.start_grid("arm"), reachable)))
