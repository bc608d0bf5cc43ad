"""Stages, reward and observations of the microwave task."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import radians
from typing import Annotated, Any, ClassVar

import torch
import tyro
from jaxtyping import Bool
from torch import Tensor

from dora.tasks.mdp.config import PenaltyWeights, TaskConfig
from dora.tasks.mdp.mdp import KNOCKED_AWAY, gone
from dora.tasks.mdp.memory import EpisodeMemory
from dora.tasks.mdp.observations import Entry
from dora.tasks.mdp.quantities import lifted, off_table, opposed, rise
from dora.tasks.mdp.randomisation import PRESETS, Randomisation
from dora.tasks.mdp.rewards import Term, Terms, tolerance
from dora.tasks.mdp.snapshot import Snapshot, derived
from dora.tasks.mdp.stages import Stage
from dora.tasks.mdp.terms import (
    at_candidate,
    beyond_the_limit,
    finger_contacts,
    near_region,
    paper_affordance,
    paper_grasp,
    paper_penalty,
    penalties,
    while_active,
    without_overlap,
)
from dora.tasks.microwave.reference import OpenSettings, PlaceSettings
from dora.tasks.microwave.snapshot import (
    CAVITY,
    LEFT,
    RIGHT,
    MicrowaveSnapshot,
    cube_in_oven,
    hands_out,
    inside,
    into_oven_in_hand,
    object_in_oven,
    other_wrist_in_hand,
    oven_in_hand,
    region_distance,
    to_region,
)

REACH, GRASP, MOVE, PUT, LEAVE = range(5)
"""Indices of the stages: the left arm has the first three, opening the door being the third."""


@dataclass(frozen=True, kw_only=True)
class MicrowaveRandomisation(Randomisation):
    """What the other tasks randomise, and the microwave."""

    oven_position: float = 0.0
    """Half width of the microwave's place along x and y [m]; drawn every episode."""
    oven_rotation: float = 0.0
    """Half width of its yaw [rad]; the same."""
    hinge: float = 0.0
    """Half width of the relative damping, friction and latch of the door, each drawn by itself; the same."""


@dataclass(frozen=True, kw_only=True)
class MicrowaveWeights(PenaltyWeights):
    """Weights of the reward terms; those of reaching and grasping count for each arm."""

    penetration: float = -2.0
    """Overlap beyond what is free [1]."""
    affordance: float = 0.15
    """Fingertips near the handle, and near the cube [1]."""
    candidate: float = 0.15
    """Wrist at the candidate [1]."""
    reach: float = 0.15
    """Thumb and one finger near what is to be held [1]."""
    grasp: float = 0.2
    """Contacts of thumb and fingers [1]."""
    open: float = 1.0
    """Angle of the door [1]."""
    carry: float = 0.6
    """The cube comes before the cavity [1]."""
    put: float = 1.0
    """Depth of the cube in the cavity [1]."""
    placed: float = 1.5
    """The cube lies inside, the hand has left, and the door is open; less after an overlap above the limit [1]."""


@dataclass(frozen=True, kw_only=True)
class MicrowaveConfig(TaskConfig):
    """Numbers of the task."""

    definition: Annotated[int, tyro.conf.Suppress] = 2
    """2: the door is opened by a finger on the handle, and the cube is left with both wrists and the right fingertips
    outside (November 2026)."""
    PRESETS: ClassVar[Any] = {
        "none": MicrowaveRandomisation(),
        "standard": MicrowaveRandomisation(
            **vars(PRESETS["standard"]), oven_position=0.04, oven_rotation=radians(10), hinge=0.5
        ),
        "hard": MicrowaveRandomisation(
            **vars(PRESETS["hard"]), oven_position=0.06, oven_rotation=radians(15), hinge=0.8
        ),
    }  # fmt: skip

    solver_iterations: int = 16
    """PhysX position iterations; with 6 a hand that is pushed into the door goes 15 mm deep [1]."""
    arm_effort: float = 0.3
    """Share of their torque limits with which the drives of an arm work; control modes of joints ignore it [1]."""
    randomisation: MicrowaveRandomisation = field(default_factory=MicrowaveRandomisation)
    """How much episodes are randomised and perturbed; the preset's numbers, unless they are overridden."""
    centre: tuple[float, float] = (0.45, -0.43)
    """Middle of the area where the cube starts [m]."""
    spread: float = 0.06
    """Half width of that area [m]."""
    oven: tuple[float, float, float] = (0.70, 0.0, 0.10)
    """Middle of the places where the origin of the microwave's frame may be [m]."""
    open: float = radians(60)
    """Angle of the door that counts as open [rad]."""
    reach: float = 0.03
    """Distance of thumb and one more fingertip from handle or cube that ends the reach [m]."""
    lost: float = 0.12
    """The same distance at which they have been lost again [m]."""
    touch_time: float = 0.15
    """Time for which thumb and finger must touch handle or cube [s]."""
    lift: float = 0.08
    """Rise at which the cube counts as lifted on its way to the microwave [m]."""
    front: float = 0.30
    """Distance of the cube from the front plane, and half as much beside the middle, from which it is before the cavity
    [m]."""
    rest_time: float = 0.25
    """Time for which the cube must lie inside with the hand out [s]."""
    rest_speed: float = 0.03
    """Largest speed of a cube that lies [m/s]."""
    free_overlap: float = 0.001
    """Overlap that costs no reward [m]."""
    after_overlap: float = 0.3
    """Share of what carrying and putting in earns that is left once an overlap was above the limit [1]."""
    placed_after_overlap: float = 0.0
    """Share of what the cube that lies inside earns that is left then [1]; with this and `after_overlap` 1 and
    `weights.penetration` 0 the reward does not depend on overlap."""
    fewest: float = 0.5
    """Smallest share of its executions that a ranked candidate must have survived to be used, as a share of the best
    candidate's [1]."""
    most_candidates: int = 12
    """Stored candidates that each arm works with [1]."""
    opening: OpenSettings = field(default_factory=OpenSettings)
    """Numbers of the left arm's reference."""
    placing: PlaceSettings = field(default_factory=PlaceSettings)
    """Numbers of the right arm's reference."""
    weights: MicrowaveWeights = field(default_factory=MicrowaveWeights)
    """Weights of the reward terms."""


Value = Callable[[Any], Tensor]


@derived
def before_cavity(s: MicrowaveSnapshot, c: MicrowaveConfig) -> Bool[Tensor, " n"]:
    """The lifted cube is in front of the cavity."""
    p = cube_in_oven(s)
    ahead = (p[:, 0] > -c.front) & (p[:, 0] < 0) & (p[:, 2] < CAVITY[2][1])
    return ahead & (p[:, 1].abs() < c.front / 2) & (lifted(s) > c.lift)


@derived
def at_rest(s: MicrowaveSnapshot, c: MicrowaveConfig) -> Bool[Tensor, " n"]:
    """The cube lies inside, the hand does not touch it, the hands are out, and the door is open."""
    still = s.object.v.norm(dim=-1) < c.rest_speed
    return inside(s) & still & ~s.hand.touch.any(-1) & hands_out(s) & (s.door >= c.open)


def _depth(s: MicrowaveSnapshot, c: MicrowaveConfig) -> Tensor:
    """Share of the way from before the cavity to the depth at which the cube is put down."""
    x = cube_in_oven(s)[:, 0]
    return ((x + c.placing.front) / (c.placing.depth + c.placing.front)).clamp(0, 1)


def _before(s: MicrowaveSnapshot, c: MicrowaveConfig) -> Tensor:
    """Closeness of the cube to the place before the cavity where it waits."""
    goal = torch.tensor([-c.placing.front, 0.0, 0.085], device=s.oven_p.device)
    return tolerance((cube_in_oven(s) - goal).norm(dim=-1), (0.0, 0.03), 0.4)


def stages(c: MicrowaveConfig) -> dict[str, list[Stage[MicrowaveSnapshot]]]:
    """The sub-tasks of each arm, which are done side by side."""

    def reached(s: MicrowaveSnapshot) -> Tensor:
        return to_region(s) < c.reach

    def lost(s: MicrowaveSnapshot) -> Tensor:
        return to_region(s) > c.lost

    def dropped(s: MicrowaveSnapshot) -> Tensor:
        return lost(s) & ~inside(s)

    def opened(s: MicrowaveSnapshot) -> Tensor:
        return s.door >= c.open

    def slipped(s: MicrowaveSnapshot) -> Tensor:
        return lost(s) | (opened(s) & ~s.hand.touch[:, :-1].any(-1))

    hold = c.touch_time
    return {
        LEFT: [
            Stage("reach_handle", reached),
            Stage("grasp_handle", opposed, hold=hold, lost=lost, back_to="reach_handle"),
            Stage("open", opened, lost=slipped, back_to="reach_handle"),
        ],
        RIGHT: [
            Stage("reach_cube", reached),
            Stage("grasp_cube", opposed, hold=hold, lost=lost, back_to="reach_cube"),
            Stage("carry", lambda s: before_cavity(s, c), lost=lost, back_to="reach_cube"),
            Stage("put_in", inside, lost=dropped, back_to="reach_cube"),
            Stage("leave", lambda s: at_rest(s, c), hold=c.rest_time),
        ],
    }


def seen_by(arm: str, value: Value) -> Value:
    """A function of what one arm sees, as a function of the whole snapshot."""
    return lambda s: value(s.of(arm))


def terms(c: MicrowaveConfig) -> Terms[MicrowaveSnapshot]:
    """The reward."""
    w = c.weights

    def door(s: MicrowaveSnapshot) -> Tensor:
        return (s.door / c.open).clamp(0, 1) * (s.stage >= MOVE)

    def carry(s: MicrowaveSnapshot) -> Tensor:
        return (0.3 * rise(s, c.lift) + 0.7 * _before(s, c)) * (0.3 + 0.7 * opposed(s).float())

    def carried(s: MicrowaveSnapshot) -> Tensor:
        return while_active(MOVE, carry)(s) * without_overlap(s, c, c.after_overlap)

    def put(s: MicrowaveSnapshot) -> Tensor:
        depth = torch.where(inside(s), 1.0, 0.8 * _depth(s, c)) * (s.stage >= PUT)
        return depth * without_overlap(s, c, c.after_overlap)

    def placed(s: MicrowaveSnapshot) -> Tensor:
        return at_rest(s.of(RIGHT), c) * without_overlap(s, c, c.placed_after_overlap)

    return Terms(
        {
            **_grasp_terms(c),
            "open": Term(seen_by(LEFT, door), w.open, doc="angle of the door, once the handle was grasped"),
            "carry": Term(
                seen_by(RIGHT, carried), w.carry,
                doc="rise of the cube and closeness to the place before the cavity, held by thumb and finger; less "
                f"after an overlap above the limit{beyond_the_limit(c)}",
            ),
            "put": Term(
                seen_by(RIGHT, put), w.put, doc="depth of the cube in the cavity; 1 inside, less after an overlap"
            ),
            "placed": Term(
                placed, w.placed,
                doc="the cube lies inside, hand out, door open; "
                f"{c.placed_after_overlap:g} of it after an overlap above the limit{beyond_the_limit(c)}",
            ),
            **penalties(w, c.free_overlap, c.penetration_limit, c.overlap_range),
        }
    )  # fmt: skip


def _grasp_terms(c: MicrowaveConfig) -> dict[str, Term[Any]]:
    """The terms of reaching and grasping, of each arm."""
    w = c.weights

    def reach(s: MicrowaveSnapshot) -> Tensor:
        return tolerance(to_region(s), margin=0.25)

    def moved(s: MicrowaveSnapshot) -> Tensor:
        return (s.door > c.open / 4) if LEFT in s.hands else off_table(s) | inside(s)

    each: dict[str, Term[Any]] = {}
    for arm, what in ((LEFT, "handle"), (RIGHT, "cube")):
        each |= {
            f"affordance_{arm}": Term(
                seen_by(arm, lambda s: near_region(region_distance(s))), w.affordance, "affordance", True,
                f"exp(-alpha * sum of fingertip distances from the {what})", region=True,
            ),
            f"candidate_{arm}": Term(
                seen_by(arm, lambda s: at_candidate(s, moved(s))), w.candidate, "task", True,
                "closeness of the wrist to the candidate",
            ),
            f"reach_{arm}": Term(
                seen_by(arm, while_active(REACH, reach)), w.reach,
                doc=f"thumb and one finger near the {what}; 1 afterwards",
            ),
            f"grasp_{arm}": Term(
                seen_by(arm, while_active(GRASP, finger_contacts)), w.grasp,
                doc="contacts: thumb against a finger, and how many fingers; 1 afterwards",
            ),
        }  # fmt: skip
    return each


def paper_terms(c: MicrowaveConfig) -> Terms[MicrowaveSnapshot]:
    """The printed reward: affordance and grasp of each arm, and a place reward exp(-distance) for the cube."""
    printed = paper_affordance(lambda s: s.object.p) | paper_grasp(MOVE)
    each = {
        f"{name}_{arm}": replace(term, value=seen_by(arm, term.value))
        for arm in (LEFT, RIGHT)
        for name, term in printed.items()
    }
    return Terms(
        {
            **each,
            "open": Term(seen_by(LEFT, lambda s: (s.door / c.open).clamp(0, 1)), 1.0, doc="angle of the door"),
            "place": Term(
                seen_by(RIGHT, lambda s: torch.exp(-(1 - _depth(s, c))) * (s.stage >= PUT)), 1.0,
                doc="exp(-(share of the way into the cavity that is missing))",
            ),
            **paper_penalty(),
        }
    )  # fmt: skip


def failed(s: Snapshot, memory: EpisodeMemory) -> Bool[Tensor, " n"]:
    """The cube has left the table or the reach of the arm, which carries it far on purpose."""
    return gone(s.objects["cube"], 2 * KNOCKED_AWAY)


OBSERVATIONS: dict[str, Entry] = {
    "half": Entry(lambda s: s.object.half[:, :1], "m", "half edge of the cube", arm=RIGHT),
    "oven": Entry(oven_in_hand, "m", "origin of the microwave's frame in the hand frame"),
    "into": Entry(into_oven_in_hand, "1", "direction into the cavity in the hand frame"),
    "in_oven": Entry(object_in_oven, "m", "handle or cube in the microwave's frame"),
    "door": Entry(lambda s: torch.stack([s.door, s.door_speed], -1), "rad, rad/s", "angle and speed of the door"),
    "other": Entry(other_wrist_in_hand, "m", "the other arm's wrist in the hand frame"),
    "surface": Entry(
        region_distance, "m", "distance of each fingertip's surface from the handle's or cube's", True, region=True
    ),
}
"""What each arm observes beyond the common entries."""
