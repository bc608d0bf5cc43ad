"""DoraJug-v1: grasp a jug by its handle and lift it upright."""

from functools import cache
from math import cos, radians
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Actor
from torch import Tensor

from dora.affordance.bundled_sets import best_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.maps.voting import vote
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import load_object
from dora.affordance.reach.feasibility_table import Grid
from dora.geometry.rotations import quaternion_apply
from dora.sim.actors import build_object
from dora.tasks.env.base import STANDING_DRAWS, DoraEnv
from dora.tasks.guidance.grasp_and_lift import GraspReference
from dora.tasks.guidance.reference import Reference
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.reward_terms import (
    at_candidate,
    grip,
    near_region,
    off_table,
    paper_affordance,
    paper_grasp,
    paper_lift,
    paper_penalty,
    penalties,
    rise,
    thumb_and_finger,
)
from dora.tasks.mdp.rewards import Term, Terms, closeness
from dora.tasks.mdp.snapshot import (
    TIP_RADIUS,
    Snapshot,
    derived,
    derived_from_contacts,
    in_wrist,
    lifted,
    opposed,
    tips_in_object,
)
from dora.tasks.mdp.stages import Stage

EMPTY, FULL = 0.30, 0.60
"""Mass of the empty and of the full jug [kg]."""
CENTRE = (0.55, 0.0)
"""Middle of the area where the jug starts [m]."""
SPREAD = 0.08
"""Half width of that area [m]."""
LIFT = 0.10
"""Rise that counts as lifted [m]."""
UPRIGHT = radians(30)
"""Largest tilt of a lifted jug [rad]."""
TIPPED = radians(60)
"""Tilt at which the jug has tipped over [rad]."""
DROPPED = 0.05
"""A jug that has risen this far and stands or lies on the table again was dropped [m]."""
NEAR = 0.04
"""Distance of thumb and one more fingertip from the handle that ends the reach [m]."""
HOLD = 10
"""Control steps the lifted jug must be held."""
PENETRATION_LIMIT = 0.005
"""Penetration above which an episode does not count as a success [m]."""
CLASS = "HandleGrasp"
"""The grasp class that the task asks for."""
MOST = 40
"""Stored candidates that the task works with."""
HOVER = 0.06
"""Height that the hand keeps above the approach for each radian it still has to turn [m/rad]: it is above at first and
would sweep over the jug."""
FEWEST_LIFTS = 0.5
"""Share of executed lifts that a ranked candidate must have survived to be one of them."""


@cache
def jug() -> AffordanceObject:
    """The jug: mesh, regions, collision pieces."""
    return load_object("jug")


@cache
def jug_map() -> AffordanceMap:
    """Its affordance map."""
    return AffordanceMap.from_object(jug())


def _scale(s: Snapshot) -> Float[Tensor, " n"]:
    """Size of the jug relative to its mesh."""
    return s.object_half[:, 0] / float(jug().mesh.extents[0] / 2)


@derived
def region_distances(s: Snapshot) -> Float[Tensor, "n 5 r"]:
    """Distance of each fingertip's surface to each region of the jug [m], negative where it presses in."""
    scale, regions = _scale(s)[:, None], jug_map()
    tips = tips_in_object(s) / scale[..., None]
    distances = [regions.region_distance(tips, name) * scale for name in regions.names]
    return torch.stack(distances, -1) - TIP_RADIUS


def handle_distance(s: Snapshot) -> Float[Tensor, "n 5"]:
    """The same to the handle alone [m]."""
    return region_distances(s)[..., jug().labels.index(jug().target)]


@derived_from_contacts
def grasp_label(s: Snapshot) -> Int[Tensor, " n"]:
    """The region that the hand's actual contacts vote for, an index into the jug's labels; -1 without contact."""
    return vote(jug_map(), s.contact_p / _scale(s)[:, None, None], s.contact_finger)


def by_the_handle(s: Snapshot) -> Bool[Tensor, " n"]:
    """The grasp's class by voting is HandleGrasp."""
    return grasp_label(s) == jug().classes.index(CLASS)


@derived
def uprightness(s: Snapshot) -> Float[Tensor, " n"]:
    """Cosine of the jug's tilt."""
    up = torch.zeros_like(s.object_p)
    up[:, 2] = 1.0
    return quaternion_apply(s.object_q, up)[:, 2]


def _reach(s: Snapshot) -> Tensor:
    return thumb_and_finger(handle_distance(s))


def _rise(s: Snapshot) -> Tensor:
    return rise(s, LIFT)


@derived
def held(s: Snapshot) -> Bool[Tensor, " n"]:
    """Lifted, upright, by thumb and finger, off the table."""
    return (lifted(s) > LIFT) & (uprightness(s) > cos(UPRIGHT)) & opposed(s) & ~s.supported


def _away(s: Snapshot) -> Tensor:
    return thumb_and_finger(region_distances(s).amin(-1))


STAGES: list[Stage[Snapshot]] = [
    Stage("reach", lambda s: closeness(_reach(s), NEAR, 0.25), lambda s: _reach(s) < NEAR),
    Stage(
        "grasp",
        lambda s: (s.touch[:, 0].float() + s.touch[:, 1:5].any(-1) + by_the_handle(s).float()) / 3,
        lambda s: opposed(s) & by_the_handle(s),
        hold=3,
        lost=lambda s: _reach(s) > 3 * NEAR,
        back_to="reach",
    ),
    Stage(
        "lift",
        _rise,
        lambda s: held(s) & by_the_handle(s),
        hold=HOLD,
        lost=lambda s: _away(s) > 2 * NEAR,
        back_to="reach",
    ),
]


def _lift(s: Snapshot) -> Tensor:
    """Rise, less of it the more the jug tilts: half of it at the largest tilt that counts."""
    level = 1 - 0.5 * (1 - uprightness(s)) / (1 - cos(UPRIGHT))
    return _rise(s) * (0.3 + 0.7 * opposed(s).float()) * level.clamp(0, 1)


def _clean(s: Snapshot) -> Tensor:
    return (held(s) & (s.max_penetration <= PENETRATION_LIMIT)).float()


def _tilt(s: Snapshot) -> Tensor:
    return (uprightness(s).clamp(-1, 1).acos() / UPRIGHT).clamp(0, 1)


TERMS: Terms[Snapshot] = Terms(
    {
        "affordance": Term(
            lambda s: near_region(handle_distance(s)),
            0.3,
            "affordance",
            True,
            "exp(-alpha * sum of fingertip distances to handle)",
        ),
        "candidate": Term(
            lambda s: at_candidate(s, off_table(s)), 0.3, "task", True, "closeness of the wrist to the candidate"
        ),
        "class": Term(lambda s: by_the_handle(s).float(), 0.4, "task", True, "the contacts vote for HandleGrasp"),
        "reach": Term(lambda s: closeness(_away(s), 0.0, 0.25), 0.3, doc="thumb and one finger near the jug"),
        "grasp": Term(grip, 0.4, doc="contacts: thumb against a finger, and how many fingers"),
        "lift": Term(_lift, 3.0, doc="rise, saturating at the target height, less if tilted"),
        "held": Term(_clean, 1.5, doc="lifted, upright, opposed, off the table, no overlap above 5 mm so far"),
        "tilt": Term(_tilt, -1.0, "penalty", doc="tilt, as a share of the largest that counts as lifted"),
        **penalties(0.001, PENETRATION_LIMIT),
    }
)


@cache
def _handle_centre() -> Tensor:
    return torch.as_tensor(jug().centroid(jug().target), dtype=torch.float32)


def handle_p(s: Snapshot) -> Float[Tensor, "n 3"]:
    """Centre of the handle, world frame [m]: the paper's p_afford."""
    return s.object_p + quaternion_apply(s.object_q, _scale(s)[:, None] * _handle_centre())


PAPER_TERMS: Terms[Snapshot] = Terms(
    {**paper_affordance(handle_p), **paper_grasp(2), **paper_lift(2, LIFT), **paper_penalty()}
)


def _label_one_hot(s: Snapshot) -> Tensor:
    labels = torch.arange(len(jug().labels), device=s.object_p.device)
    return (grasp_label(s)[:, None] == labels).float()


@register_env("DoraJug-v1", max_episode_steps=120)
class JugEnv(DoraEnv):
    """Grasp a jug by its handle with the five-fingered hand and lift it upright.

    **Randomisations:** position within +-8 cm and yaw, wherever the arm can carry out at least one stored candidate;
    mass from empty to full; size, friction, candidate error, observation noise, delay and pushes by preset.

    **Stages:** reach (thumb and one fingertip within 4 cm of the handle), grasp (thumb and one more finger touch the
    jug, and all contacts together vote for HandleGrasp, for 3 steps), lift (>= 10 cm above its start, tilted by at
    most 30 degrees, held like that, off the table, for 10 steps).

    **Success:** all stages done, and no overlap above 5 mm in the whole episode.

    **Failure:** the jug tips over (60 degrees), is dropped back onto the table after a rise of 5 cm, falls off the
    table or is knocked more than 60 cm away.
    """

    STAGES = STAGES
    TERMS = TERMS
    PAPER_TERMS = PAPER_TERMS
    EXTRA_OBSERVATIONS: ClassVar[dict[str, Entry]] = {
        "scale": Entry(lambda s: _scale(s)[:, None], "1", "size of the jug relative to the nominal one"),
        "surface": Entry(lambda s: region_distances(s).amin(-1), "m", "distance of each fingertip from the jug"),
        "handle": Entry(handle_distance, "m", "distance of each fingertip from the handle", True),
        "handle_p": Entry(lambda s: in_wrist(s, handle_p(s)), "m", "centre of the handle in the hand frame", True),
        "class": Entry(_label_one_hot, "1", "region that the contacts vote for: body, handle, rim", True),
    }
    DRAWS = STANDING_DRAWS
    MAX_STEPS = 120
    PENETRATION_LIMIT = PENETRATION_LIMIT
    CONTACT_POINTS = 32
    HOME = "above"
    OBJECT = "jug"
    START = Grid(CENTRE, (SPREAD, SPREAD))

    def candidates(self) -> GraspCandidates:
        return best_candidates(self.OBJECT, CLASS, FEWEST_LIFTS, MOST)

    def make_reference(self) -> Reference:
        return GraspReference(self.num_envs, self.device, HOVER)

    def load_object(self, scale: np.ndarray) -> Actor:
        half = torch.as_tensor(jug().mesh.extents / 2, dtype=torch.float32, device=self.device)
        self.object_half = half * torch.as_tensor(scale, dtype=torch.float32, device=self.device)[:, None]
        return build_object(self.scene, jug(), scale=scale, mass=(EMPTY + FULL) / 2)

    def masses(self, nominal: Float[Tensor, " b"], u: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """Anything from empty to full, or half full with a preset that does not vary masses."""
        return EMPTY + (FULL - EMPTY) * u if self.preset.mass > 0 else nominal

    def place(self, env_idx: Tensor, u: Tensor) -> None:
        """The jug stands upright, somewhere in the area, at any yaw."""
        self.target_object.set_pose(self.standing(u, jug().support * self.scale[env_idx]))

    def failed(self, s: Snapshot) -> Bool[Tensor, " n"]:
        """Also when the jug has tipped over, or stands on the table again after it was lifted."""
        tipped = uprightness(s) < cos(TIPPED)
        dropped = s.supported & (self.episode.highest > DROPPED)
        return super().failed(s) | tipped | dropped
