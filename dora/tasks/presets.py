"""How much an episode is randomised: named presets, the same for every task."""

from dataclasses import dataclass

from dora.errors import InputError


@dataclass(frozen=True)
class Preset:
    """Half widths and ranges of everything that is drawn anew.

    Attributes:
        name: the preset's name.
        size: half width of the object's relative size; drawn when the scene is built.
        mass: half width of the object's relative mass; drawn every episode.
        friction: lowest and highest friction coefficient of the object; drawn every episode.
        candidate_position: half width of the error of a candidate's wrist position along each axis [m].
        candidate_rotation: half width of the error of a candidate's orientation about each axis [rad].
        candidate_joint: half width of the error of a candidate's finger joints [rad].
    """

    name: str
    size: float
    mass: float
    friction: tuple[float, float]
    candidate_position: float
    candidate_rotation: float
    candidate_joint: float


PRESETS = {
    p.name: p
    for p in (
        Preset("none", 0.0, 0.0, (0.9, 0.9), 0.0, 0.0, 0.0),
        Preset("standard", 0.08, 0.3, (0.6, 1.0), 0.005, 0.05, 0.05),
        Preset("hard", 0.12, 0.5, (0.5, 1.0), 0.015, 0.15, 0.10),
    )
}


def find_preset(name: str) -> Preset:
    """The preset called `name`; raises InputError for an unknown one."""
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
    return PRESETS[name]
