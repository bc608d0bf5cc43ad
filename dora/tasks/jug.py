"""DoraJug-v1: grasp a jug by its handle and lift it upright."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from math import cos, radians
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from mani_skill.utils.structs import Actor, Pose
from torch import Tensor

from dora.affordance.bundled_sets import best_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.maps.voting import vote
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.feasibility_table import Grid
from dora.geometry.rotations import quaternion_apply
from dora.tasks.env.arm import ArmSpec
from dora.tasks.env.registration import register_task
from dora.tasks.env.scene import TaskScene
from dora.tasks.env.starts import STANDING_DRAWS, standing
from dora.tasks.env.task import Task
from dora.tasks.guidance.grasp_and_lift import GraspSettings
from dora.tasks.mdp.config import PenaltyWeights, TaskConfig
from dora.tasks.mdp.mdp import Mdp, left_table
from dora.tasks.mdp.memory import EpisodeMemory
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.quantities import in_wrist, lifted, off_table, opposed, rise, thumb_and_finger, tips_in_object
from dora.tasks.mdp.rewards import Term, Terms, tolerance
from dora.tasks.mdp.snapshot import Snapshot, derived, derived_from_contacts
from dora.tasks.mdp.stages import Stage
from dora.tasks.mdp.terms import (
    at_candidate,
    beyond_the_limit,
    finger_contacts,
    near_region,
    paper_affordance,
    paper_grasp,
    paper_lift,
    paper_penalty,
    penalties,
    while_active,
    without_overlap,
)

REACH, GRASP, LIFT = range(3)
"""Indices of the stages."""
CLASS = "HandleGrasp"
"""The grasp class that the task asks for."""


@dataclass(frozen=True, kw_only=True)
class JugWeights(PenaltyWeights):
    """Weights of the reward terms."""

    affordance: float = 0.3
    """Fingertips near the handle [1]."""
    candidate: float = 0.3
    """Wrist at the candidate [1]."""
    grasp_class: float = 0.4
    """The contacts vote for HandleGrasp [1]."""
    reach: float = 0.3
    """Thumb and one finger near the jug [1]."""
    grasp: float = 0.4
    """Contacts of thumb and fingers [1]."""
    lift: float = 3.0
    """Rise [1]."""
    held: float = 1.5
    """Lifted by the handle and held upright without overlap [1]."""
    tilt: float = -1.0
    """Tilt [1]."""


@dataclass(frozen=True, kw_only=True)
class JugConfig(TaskConfig):
    """Numbers of the task."""

    BY_PRESET: ClassVar[Mapping[str, Mapping[str, Any]]] = {"hard": {"pose_filter": 0.15}}

    mass: tuple[float, float] = (0.30, 0.60)
    """Mass of the empty and of the full jug [kg]."""
    centre: tuple[float, float] = (0.55, 0.0)
    """Middle of the area where the jug starts [m]."""
    spread: float = 0.08
    """Half width of that area [m]."""
    lift: float = 0.10
    """Rise that counts as lifted [m]."""
    upright: float = radians(30)
    """Largest tilt of a lifted jug [rad]."""
    tipped: float = radians(60)
    """Tilt at which the jug has tipped over [rad]."""
    dropped: float = 0.05
    """A jug that has risen this far and stands or lies on the table again was dropped [m]."""
    reach: float = 0.04
    """Distance of thumb and one more fingertip from the handle that ends the reach [m]."""
    lost: float = 0.12
    """The same distance at which the handle has been lost while it is grasped [m]."""
    let_go: float = 0.08
    """Distance of thumb and one more fingertip from the jug at which it has been lost while it is lifted [m]."""
    touch_time: float = 0.15
    """Time for which thumb and finger must touch the jug, and the contacts vote for the handle [s]."""
    hold_time: float = 0.5
    """Time for which the lifted jug must be held [s]."""
    free_overlap: float = 0.001
    """Overlap that costs no reward [m]."""
    fewest_lifts: float = 0.5
    """Smallest share of its executions that a ranked candidate must have survived to be used, as a share of the best
    candidate's [1]."""
    most_candidates: int = 12
    """Stored candidates that the task works with [1]."""
    observe_candidate: bool = True
    """Whether the policy also observes where on the object the chosen candidate is; with guidance alone."""
    reference: GraspSettings = field(default_factory=lambda: replace(GraspSettings(), hover=0.06))
    """Numbers of the reference; the hand is above the jug at first and would sweep over it, so it hovers."""
    weights: JugWeights = field(default_factory=JugWeights)
    """Weights of the reward terms."""


@register_task("DoraJug-v1")
class JugTask(Task):
    """Grasp a jug by its handle with the five-fingered hand and lift it upright.

    **Randomisations:** position within +-8 cm and yaw, wherever the arm can carry out at least one stored candidate;
    mass from empty to full; size, friction, candidate error, observation noise, delay and pushes by preset.

    **Stages:** reach (thumb and one fingertip within 4 cm of the handle), grasp (thumb and one more finger touch the
    jug, and all contacts together vote for HandleGrasp, for 0.15 s), lift (>= 10 cm above its start, tilted by at
    most 30 degrees, held like that, off the table, for 0.5 s).

    **Success:** all stages done, and no overlap above 5 mm in the whole episode.

    **Failure:** the jug tips over (60 degrees), is dropped back onto the table after a rise of 5 cm, falls off the
    table or is knocked more than 60 cm away.
    """

    CONFIG = JugConfig
    ARMS: ClassVar[Mapping[str, ArmSpec]] = {"arm": ArmSpec("jug")}
    DRAWS = STANDING_DRAWS
    MAX_STEPS = 120
    CONTACT_POINTS = 32
    LEARNERS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "sac": {
            "total_steps": 300_000, "stop_success": 0.99, "num_envs": 32, "eval_every": 50_000, "eval_episodes": 100,
            "eval_envs": 50, "presets": {"hard": {"learner": {"prior": 0.01, "noise_correlation": 0.9}}},
        },
        "ppo": {
            "total_steps": 600_000, "stop_success": 0.99, "num_envs": 64, "eval_every": 60_000, "eval_episodes": 100,
            "eval_envs": 50, "learner": {"rollout": 64, "log_std": -1.8},
        },
    }  # fmt: skip

    def make_mdp(self, scene: TaskScene) -> Mdp[Snapshot]:
        c: JugConfig = self.config
        judged = stages(c), terms(c), paper_terms(c), c.penetration_limit, OBSERVATIONS, partial(failed, c=c)
        return Mdp(*judged, "the jug has tipped over, has left the table, or stands on it again after it was lifted")

    def candidates(self, arm: str, region: bool = True) -> GraspCandidates:
        return best_candidates("jug", CLASS, self.config.fewest_lifts, self.config.most_candidates, region)

    def start_grid(self, arm: str) -> Grid:
        return Grid(self.config.centre, (self.config.spread,) * 2)

    def build(self, scene: TaskScene, name: str, scale: Float[np.ndarray, " n"]) -> Actor:
        return scene.build(name, scale, mass=sum(self.config.mass) / 2)

    def masses(self, name: str, nominal: Float[Tensor, " b"], u: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """Anything from empty to full, or half full where masses are not randomised."""
        empty, full = self.config.mass
        return empty + (full - empty) * u if self.config.randomisation.mass > 0 else nominal

    def place(self, scene: TaskScene, rows: Tensor, u: Tensor) -> None:
        """The jug stands upright, somewhere in the area, at any yaw."""
        height = jug().support * scene.scale[rows, 0]
        reachable = partial(self.startable, scene.arms["arm"])
        scene.object.set_pose(Pose.create_from_pq(*standing(u, height, self.start_grid("arm"), reachable)))


OBSERVATIONS: dict[str, Entry] = {
    "scale": Entry(lambda s: size(s)[:, None], "1", "size of the jug relative to the nominal one"),
    "surface": Entry(lambda s: region_distances(s).amin(-1), "m", "distance of each fingertip from the jug"),
    "handle": Entry(lambda s: handle_distance(s), "m", "distance of each fingertip from the handle", True, region=True),
    "handle_p": Entry(
        lambda s: in_wrist(s, handle_p(s)), "m", "centre of the handle in the hand frame", True, region=True
    ),
    "class": Entry(
        lambda s: _label_one_hot(s), "1", "region that the contacts vote for: body, handle, rim", True, region=True
    ),
}
"""What the task observes beyond the common entries."""


def stages(c: JugConfig) -> list[Stage[Snapshot]]:
    """The sub-tasks, in order."""
    return [
        Stage("reach", lambda s: _to_handle(s) < c.reach),
        Stage(
            "grasp",
            lambda s: opposed(s) & by_the_handle(s),
            hold=c.touch_time,
            lost=lambda s: _to_handle(s) > c.lost,
            back_to="reach",
        ),
        Stage(
            "lift",
            lambda s: held(s, c) & by_the_handle(s),
            hold=c.hold_time,
            lost=lambda s: _to_jug(s) > c.let_go,
            back_to="reach",
        ),
    ]


def terms(c: JugConfig) -> Terms[Snapshot]:
    """The reward."""
    w = c.weights

    def near(s: Snapshot) -> Tensor:
        return tolerance(_to_jug(s), margin=0.25)

    def lift(s: Snapshot) -> Tensor:
        """Rise by the handle, less of it the more the jug tilts: half of it at the largest tilt that counts."""
        level = 1 - 0.5 * (1 - uprightness(s)) / (1 - cos(c.upright))
        grasped = opposed(s) & by_the_handle(s)
        return rise(s, c.lift) * (0.3 + 0.7 * grasped.float()) * level.clamp(0, 1) * (s.stage >= LIFT)

    def clean(s: Snapshot) -> Tensor:
        return (held(s, c) & by_the_handle(s)) * without_overlap(s, c)

    def tilt(s: Snapshot) -> Tensor:
        return (uprightness(s).clamp(-1, 1).acos() / c.upright).clamp(0, 1)

    return Terms(
        {
            "affordance": Term(
                lambda s: near_region(handle_distance(s)), w.affordance, "affordance", True,
                "exp(-alpha * sum of fingertip distances to handle)", region=True,
            ),
            "candidate": Term(
                lambda s: at_candidate(s, off_table(s)), w.candidate, "task", True,
                "closeness of the wrist to the candidate",
            ),
            "class": Term(lambda s: by_the_handle(s).float(), w.grasp_class, doc="the contacts vote for HandleGrasp"),
            "reach": Term(while_active(REACH, near), w.reach, doc="thumb and one finger near the jug; 1 afterwards"),
            "grasp": Term(
                while_active(GRASP, finger_contacts), w.grasp,
                doc="contacts: thumb against a finger, and how many fingers; 1 afterwards",
            ),
            "lift": Term(
                lift, w.lift, doc="rise once it is grasped, saturating, less if tilted or not held by the handle"
            ),
            "held": Term(
                clean, w.held,
                doc="lifted, upright, opposed, by the handle, off the table, never too much overlap"
                + beyond_the_limit(c),
            ),
            "tilt": Term(tilt, w.tilt, "penalty", doc="tilt, as a share of the largest that counts as lifted"),
            **penalties(w, c.free_overlap, c.penetration_limit, c.overlap_range),
        }
    )  # fmt: skip


def paper_terms(c: JugConfig) -> Terms[Snapshot]:
    """The printed reward."""
    return Terms({**paper_affordance(handle_p), **paper_grasp(2), **paper_lift(2, c.lift), **paper_penalty()})


def failed(s: Snapshot, memory: EpisodeMemory, c: JugConfig) -> Bool[Tensor, " n"]:
    """The jug has left the table, has tipped over, or stands on the table again after it was lifted."""
    tipped = uprightness(s) < cos(c.tipped)
    dropped = s.object.supported & (memory.object.highest > c.dropped)
    return left_table(s, memory) | tipped | dropped


# ------------------------------------------------------------------- quantities


@cache
def jug() -> AffordanceObject:
    """The jug: mesh, regions, collision pieces."""
    return load_object("jug")


@cache
def jug_map() -> AffordanceMap:
    """Its affordance map."""
    return AffordanceMap.from_object(jug())


@cache
def _handle_centre() -> Tensor:
    return torch.as_tensor(jug().centroid(jug().target), dtype=torch.float32)


def size(s: Snapshot) -> Float[Tensor, " n"]:
    """Size of the jug relative to its mesh."""
    return s.object.half[:, 0] / float(jug().mesh.extents[0] / 2)


@derived
def region_distances(s: Snapshot) -> Float[Tensor, "n fingers r"]:
    """Distance of each fingertip's surface to each region of the jug [m], negative where it presses in."""
    scale, regions = size(s)[:, None], jug_map()
    tips = tips_in_object(s) / scale[..., None]
    distances = [regions.region_distance(tips, name) * scale for name in regions.names]
    return torch.stack(distances, -1) - s.hand.tip_radius


def handle_distance(s: Snapshot) -> Float[Tensor, "n fingers"]:
    """The same to the handle alone [m]."""
    return region_distances(s)[..., jug().labels.index(jug().target)]


def handle_p(s: Snapshot) -> Float[Tensor, "n 3"]:
    """Centre of the handle, world frame [m]: the paper's p_afford."""
    return s.object.p + quaternion_apply(s.object.q, size(s)[:, None] * _handle_centre())


@derived
def _to_handle(s: Snapshot) -> Float[Tensor, " n"]:
    return thumb_and_finger(handle_distance(s))


@derived
def _to_jug(s: Snapshot) -> Float[Tensor, " n"]:
    return thumb_and_finger(region_distances(s).amin(-1))


@derived_from_contacts
def grasp_label(s: Snapshot) -> Int[Tensor, " n"]:
    """The region that the hand's actual contacts vote for, an index into the jug's labels; -1 without contact."""
    return vote(jug_map(), s.hand.contact_p / size(s)[:, None, None], s.hand.contact_finger)


def by_the_handle(s: Snapshot) -> Bool[Tensor, " n"]:
    """The grasp's class by voting is HandleGrasp."""
    return grasp_label(s) == jug().classes.index(CLASS)


def _label_one_hot(s: Snapshot) -> Tensor:
    labels = torch.arange(len(jug().labels), device=s.object.p.device)
    return (grasp_label(s)[:, None] == labels).float()


@derived
def uprightness(s: Snapshot) -> Float[Tensor, " n"]:
    """Cosine of the jug's tilt."""
    up = torch.zeros_like(s.object.p)
    up[:, 2] = 1.0
    return quaternion_apply(s.object.q, up)[:, 2]


@derived
def held(s: Snapshot, c: JugConfig) -> Bool[Tensor, " n"]:
    """Lifted, upright, by thumb and finger, off the table."""
    return (lifted(s) > c.lift) & (uprightness(s) > cos(c.upright)) & opposed(s) & ~s.object.supported
