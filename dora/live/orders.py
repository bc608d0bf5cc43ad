"""What a session can be asked to do; each order is carried out by its thread, between two control steps."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Reset:
    """Begin an episode with a seed; the seed of the last one if None."""

    seed: int | None = None


@dataclass(frozen=True)
class Run:
    """Let time go on, or stop it."""

    running: bool


@dataclass(frozen=True)
class Step:
    """Stop time, and do so many control steps."""

    count: int = 1


@dataclass(frozen=True)
class Speed:
    """Seconds of the task in a second."""

    speed: float


@dataclass(frozen=True)
class Repeat:
    """Whether the next episode begins when one is over."""

    repeat: bool


@dataclass(frozen=True)
class Play:
    """Who acts, by name; begins an episode."""

    player: str


@dataclass(frozen=True)
class Randomise:
    """The preset of the randomisation; begins an episode."""

    preset: str


@dataclass(frozen=True)
class Start:
    """Begin an episode with this start: the share of each number's range, 0 to 1, in the order of `Setup.numbers`."""

    shares: tuple[float, ...]


@dataclass(frozen=True)
class Choose:
    """Begin an episode with this candidate, whose index it is; None for the nearest ones."""

    candidate: int | None


@dataclass(frozen=True)
class Push:
    """Give the first object an impulse [N s] in a horizontal direction [rad]; 0 is +x."""

    impulse: float
    direction: float


Order = Reset | Run | Step | Speed | Repeat | Play | Randomise | Start | Choose | Push
"""Any order."""
