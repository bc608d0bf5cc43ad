"""How much an episode is randomised and perturbed: named presets, the same for every task."""

from collections.abc import Mapping
from dataclasses import dataclass

from dora.errors import InputError, suggestion


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """Half widths of uniform errors, ranges of what is drawn anew, and perturbations; all zero by default."""

    size: float = 0.0
    """Half width of the object's relative size; drawn when the scene is built."""
    mass: float = 0.0
    """Half width of the object's relative mass; drawn every episode."""
    friction: tuple[float, float] = (0.9, 0.9)
    """Lowest and highest friction coefficient of the object; drawn every episode."""
    candidate_position: float = 0.0
    """Half width of the error of a candidate's wrist position along each axis [m]."""
    candidate_rotation: float = 0.0
    """Half width of the error of a candidate's orientation about each axis [rad]."""
    candidate_joint: float = 0.0
    """Half width of the error of a candidate's finger joints [rad]."""
    observed_position: float = 0.0
    """Half width of the error of the observed object position along each axis [m]; drawn every control step."""
    observed_rotation: float = 0.0
    """Half width of the error of the observed object orientation about each axis [rad]; the same."""
    observed_joint: float = 0.0
    """Half width of the error of the observed hand joints [rad]; the same."""
    delay: int = 0
    """Control steps after which an action takes effect."""
    push: float = 0.0
    """Impulse of a push on the object in a random horizontal direction [N s]."""
    push_rate: float = 0.0
    """Mean number of pushes in a second [1/s]."""

    @property
    def noisy(self) -> bool:
        """Whether anything that is observed differs from the truth."""
        return max(self.observed_position, self.observed_rotation, self.observed_joint) > 0


PRESETS: dict[str, Randomisation] = {
    "none": Randomisation(),
    "standard": Randomisation(
        size=0.08,
        mass=0.3,
        friction=(0.6, 1.0),
        candidate_position=0.008,
        candidate_rotation=0.08,
        candidate_joint=0.08,
        observed_position=0.002,
        observed_rotation=0.02,
        observed_joint=0.01,
    ),
    "hard": Randomisation(
        size=0.12,
        mass=0.5,
        friction=(0.5, 1.0),
        candidate_position=0.015,
        candidate_rotation=0.15,
        candidate_joint=0.10,
        observed_position=0.005,
        observed_rotation=0.05,
        observed_joint=0.02,
        delay=1,
        push=0.05,
        push_rate=0.5,
    ),
}
"""The named presets; a task with more to draw has its own, with the same numbers of these."""


def find_preset(name: str, presets: Mapping[str, Randomisation] = PRESETS) -> Randomisation:
    """The preset called `name` among a task's; raises InputError for an unknown one."""
    if name not in presets:
        raise InputError(f"unknown preset {name!r}: {suggestion(name, presets)}")
    return presets[name]
