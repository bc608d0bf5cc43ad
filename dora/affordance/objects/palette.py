"""Colours of regions, shared by pictures, pages and simulated scenes."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int, UInt8

PALETTE = (
    (78, 121, 167), (242, 142, 43), (89, 161, 79), (225, 87, 89),
    (118, 183, 178), (237, 201, 72), (176, 122, 161), (156, 117, 95),
)  # fmt: skip
"""Colours of regions (red, green, blue, 0 to 255) in the order of an object's labels, repeated if there are more."""


def colours(indices: Int[np.ndarray, " n"], table: Sequence[tuple[int, int, int]]) -> UInt8[np.ndarray, "n 4"]:
    """Red, green, blue and opacity (0 to 255) of indices into a table of colours, which is repeated."""
    return np.append(
        np.asarray(table, dtype=np.uint8)[indices % len(table)], np.full((len(indices), 1), 255, np.uint8), 1
    )


def legend_of(labels: Sequence[str]) -> dict[str, tuple[int, int, int]]:
    """The colour (red, green, blue, 0 to 255) of every region, by label."""
    return {label: PALETTE[index % len(PALETTE)] for index, label in enumerate(labels)}
