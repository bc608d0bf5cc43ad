"""Contact semantic maps as files hold them: only the points that are touched, with the part of the hand."""

from __future__ import annotations

import torch
from jaxtyping import UInt8
from torch import Tensor

from dora.affordance.maps.voting import HAND_PARTS
from dora.errors import InputError, shown

COUNT, POINT, PART = "contact_map/count", "contact_map/point", "contact_map/part"
"""Names of the tensors: (c,) touched points per row; (t,) their indices, rows one after the other; (t,) their parts."""
KINDS = (torch.uint8, torch.int16, torch.int32, torch.int64)
"""Types of the tensors that are accepted."""
MOST_POINTS, MOST_CELLS = 2**20, 2**28
"""Largest number of points of a map, and of all maps of a file together."""


def pack(maps: UInt8[Tensor, "c p"]) -> dict[str, Tensor]:
    """Tensors of a file, 3 bytes per touched point if a map has at most 2^15 points.

    Raises:
        InputError: there are more points than a file may have.
    """
    rows, points = maps.shape
    if points > MOST_POINTS or rows * points > MOST_CELLS:
        raise InputError(
            f"{rows} contact maps of {points} points each are too large for a file of {MOST_CELLS} points, at "
            f"most {MOST_POINTS} of each: keep at most {MOST_CELLS // points} candidates, for instance the best ones."
        )
    row, point = maps.cpu().nonzero().unbind(1)
    return {
        COUNT: torch.bincount(row, minlength=len(maps)).int(),
        POINT: point.to(torch.int16 if maps.shape[1] <= 2**15 else torch.int32),
        PART: maps.cpu()[row, point],
    }


def unpack(tensors: dict[str, Tensor], rows: int, points: object, whose: str) -> UInt8[Tensor, "c p"]:
    """The maps that `pack` packed, which are taken out of `tensors`.

    Args:
        tensors: of the file.
        rows: number c of maps.
        points: number p of points of each, as the file says.
        whose: they are, for the message.

    Raises:
        InputError: a tensor is missing, of another kind or length, or names a point or part that there is not.
    """
    found = [tensors.pop(name, None) for name in (COUNT, POINT, PART)]
    fault = f"{whose} holds damaged contact maps"
    again = "use another file, or make it again."
    if not isinstance(points, int) or not 0 < points <= MOST_POINTS or any(each is None for each in found):
        raise InputError(f"{fault} (incomplete, or of {shown(points)} points): {again}")
    if rows * points > MOST_CELLS:
        raise InputError(f"{fault} ({rows} of {points} points each, more than {MOST_CELLS} together): {again}")
    if any(each.ndim != 1 or each.dtype not in KINDS for each in found if each is not None):
        raise InputError(f"{fault} (a table that is not one column of integers): {again}")
    count, point, part = (each.long() for each in found if each is not None)
    if bool((count < 0).any()) or len(count) != rows or not int(count.sum()) == len(point) == len(part):
        raise InputError(f"{fault} (tables that do not fit {rows} candidates): {again}")
    cell = torch.arange(rows).repeat_interleave(count) * points + point
    if bool(((point < 0) | (point >= points)).any()) or bool((cell.diff() <= 0).any()):
        raise InputError(f"{fault} (points that are not 0 to {points - 1} in ascending order): {again}")
    if bool(((part < 1) | (part > HAND_PARTS)).any()):
        raise InputError(f"{fault} (parts of the hand that are not 1 to {HAND_PARTS}): {again}")
    return torch.zeros(rows * points, dtype=torch.uint8).index_put_((cell,), part.byte()).view(rows, points)
