"""The numbers of a task as a frozen dataclass: weights, thresholds, randomisation, rates; overridden by name."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import tyro

from dora.tasks.mdp.randomisation import PRESETS, Randomisation


@dataclass(frozen=True, kw_only=True)
class ResidualBounds:
    """Largest residual actions."""

    position: float = 0.03
    """Of the wrist along each axis [m]."""
    rotation: float = 0.2
    """Of the wrist about each axis [rad]."""
    joint: float = 0.3
    """Of a hand joint [rad]."""


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Numbers that every task has; a task adds its own fields."""

    PRESETS: ClassVar[Mapping[str, Randomisation]] = PRESETS
    """The named presets of the randomisation."""
    BY_PRESET: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    """Other numbers of the task that go with a preset, by the name of the preset."""

    definition: Annotated[int, tyro.conf.Suppress] = 1
    """Version of the task's rules, raised when results of before do not count any more; changes nothing by itself."""
    control_frequency: int = 20
    """Control steps per second [Hz]."""
    physics_frequency: int = 100
    """Physics steps per second [Hz]; a multiple of the control frequency."""
    solver_iterations: int = 6
    """PhysX position iterations [1]."""
    persistent_contacts: bool = True
    """PhysX keeps contact points from step to step (PCM); it misses fingers that slide over an edge, see findings."""
    contact_offset: float = 0.005
    """PhysX's contact offset of the objects, and of every body without its own [m]."""
    penetration_limit: float = 0.005
    """Largest overlap in an episode that counts as a success [m]."""
    overlap_range: float = 1.0
    """Overlap above which its penalty does not grow, in units of `penetration_limit` [1]."""
    overlap_grace: float = 0.0
    """Overlap above `penetration_limit` over which the reward for what is done without too much of it falls, in units
    of that limit; 0: at once. What counts as a success does not depend on it [1]."""
    arm_effort: float = 1.0
    """Share of their torque limits with which the drives of an arm work; control modes of joints ignore it [1]."""
    hand_effort: float = 1.0
    """Share of their torque limits with which the drives of a hand work; control modes of joints ignore it [1]."""
    wrist_speed: float = 1.0
    """Share of its usual speed at which a full action moves a wrist; control modes of joints ignore it [1]."""
    hand_speed: float = 1.0
    """Share of their velocity limits at which commands of finger joints move; control modes of joints ignore it [1]."""
    pose_filter: float = 1.0
    """Share of the newest measurement in the estimated pose of an object, for policy and reference; 1: no filter."""
    misplaced: Literal["candidates", "object"] = "candidates"
    """What is off by a candidate's error of position and orientation: the candidates, or the pose of their object as it
    is measured, from which observation, candidates and reference follow. That error can only be felt."""
    hand_action: Literal["joints", "fingers"] = "joints"
    """What commands a hand: a number for each joint, or one for the bend of each finger and one for the thumb aside."""
    observe_candidate: bool = False
    """Whether the policy also observes where on the object the chosen candidate is; with guidance alone."""
    observe_correction: bool = False
    """Whether the policy also observes the exact correction of the candidate's error, which only the simulator knows:
    for a diagnosis, not for use; with guidance alone."""
    history: int = 0
    """Earlier control steps whose observations and actions the policy sees besides the present ones."""
    residual: ResidualBounds = field(default_factory=ResidualBounds)
    """Bounds of the residual action."""
    randomisation: Randomisation = field(default_factory=Randomisation)
    """How much episodes are randomised and perturbed; the preset's numbers, unless they are overridden."""

    @property
    def dt(self) -> float:
        """Duration of a control step [s]."""
        return 1 / self.control_frequency


@dataclass(frozen=True, kw_only=True)
class PenaltyWeights:
    """Weights of the penalty terms of every task; negative."""

    effort: float = -0.05
    """Mean square of the action [1]."""
    change: float = -0.4
    """A quarter of the mean square of the action's change [1]."""
    penetration: float = -1.0
    """Overlap beyond what is free [1]."""
