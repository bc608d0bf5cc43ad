"""How the fingers turn what a closed hand holds: a motion of the commanded hand joints, and its file."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.objects.catalogue import load_object
from dora.configs import built
from dora.digests import check_file
from dora.errors import InputError, shown
from dora.reading import read_toml
from dora.robot import RobotDescription

TURNING_FILE = "turning.toml"
"""Name of the file of an object's folder with the motions of the fingers that turn it."""
FORMAT = "dora-turning 1"
"""Format and version of that file."""
LARGEST = 100.0
"""Largest duration [s], offset [rad] and number of moments of the file."""


@dataclass(frozen=True)
class FingerMotion:
    """Offsets of the commanded hand joints that turn the held object in the hand, either way.

    Attributes:
        seconds: duration; the last offsets stay [s].
        positive: (k, hand) offsets at k equally spaced moments after the first, at which they are 0, that turn the
            object about its own +z relative to the palm [rad].
        negative: the same for -z.
    """

    seconds: float
    positive: Float[Tensor, "k hand"]
    negative: Float[Tensor, "k hand"]

    def offsets(self, spent: Float[Tensor, " n"], direction: Float[Tensor, " n"]) -> Float[Tensor, "n hand"]:
        """Offsets after some time [s], piecewise linear, for turns about +z (direction > 0) or -z [rad]."""
        ways = torch.stack([self.negative, self.positive]).to(spent.device)
        return at_moment(ways[(direction > 0).long()], spent / self.seconds)


def at_moment(moments: Float[Tensor, "n k hand"], share: Float[Tensor, " n"]) -> Float[Tensor, "n hand"]:
    """Piecewise linear offsets, 0 at first and then through `moments` at equal distances, after a share of the time;
    before and after it those of its ends."""
    ways = torch.cat([torch.zeros_like(moments[:, :1]), moments], 1)
    last = moments.shape[1]
    moment = share.clamp(0, 1) * last
    before, rows = moment.long().clamp(max=last - 1), torch.arange(len(ways), device=ways.device)
    return torch.lerp(ways[rows, before], ways[rows, before + 1], (moment - before)[:, None])


@dataclass(frozen=True)
class StoredMotion:
    """Content of a file of motions.

    Attributes:
        format: FORMAT.
        robot: name of the robot whose hand was used.
        seconds: duration [s].
        joints: names of the hand's joints.
        positive, negative: offsets of the joints at each moment, as of `FingerMotion` [rad].
    """

    format: str
    robot: str
    seconds: float
    joints: tuple[str, ...]
    positive: tuple[tuple[float, ...], ...]
    negative: tuple[tuple[float, ...], ...]


def load_motion(name: str | Path, robot: RobotDescription) -> FingerMotion:
    """The motion with which the fingers of a robot turn an object, from the object's folder.

    Args:
        name: of an object or its folder, as for `load_object`.
        robot: whose hand turns it.

    Raises:
        InputError: there is no file, it is for another hand, or something in it is wrong.
    """
    folder = load_object(name).folder
    path = (folder or Path(name)) / TURNING_FILE
    stored = read_motion(path)
    if stored.joints != robot.hand.names:
        raise InputError(
            f"{path} has motions of the hand of {stored.robot}, not of {robot.name}: make some of that one with "
            "`python -m dora.tools.in_task.turning`."
        )
    positive, negative = (torch.tensor(way, dtype=torch.float32) for way in (stored.positive, stored.negative))
    return FingerMotion(stored.seconds, positive, negative)


def read_motion(path: Path) -> StoredMotion:
    """The motions of a file; raises InputError if there is none or something in it is wrong."""
    check_file(path)
    stored = built(StoredMotion, read_toml(path, "file of finger motions"), str(path))
    if stored.format != FORMAT:
        raise InputError(f"{path}: the format is {shown(stored.format)}, not {FORMAT!r}: write the file again.")
    if not 0 < stored.seconds <= LARGEST:
        raise InputError(f"{path}: seconds is {stored.seconds} and has to be above 0 and at most {LARGEST:g}.")
    for way in ("positive", "negative"):
        rows = getattr(stored, way)
        if not 1 <= len(rows) <= LARGEST or any(len(row) != len(stored.joints) for row in rows):
            raise InputError(f"{path}: {way} needs 1 to {LARGEST:g} rows of one offset for each of the joints.")
        if not all(abs(x) <= LARGEST for row in rows for x in row):
            raise InputError(f"{path}: {way} has an offset that is not a number or beyond {LARGEST:g} rad: correct it.")
    return stored
