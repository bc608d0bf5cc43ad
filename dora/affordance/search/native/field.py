"""Signed distance of one point in compiled loops: nearest node, and trilinear interpolation."""

import math
from typing import NamedTuple

import numpy as np

from dora.affordance.objects.signed_distance import CHANNELS
from dora.affordance.search.native.compiling import inlined, native


class FieldArrays(NamedTuple):
    """Arrays of a `SignedDistanceField`.

    `table` (nodes, channels), `distance` (nodes,) [m], `shape` nodes per axis, `lower` position of the first node [m],
    `inverse` of the spacing [1/m], `cull` largest difference between interpolated and nearest-node distance [m].
    """

    table: np.ndarray
    distance: np.ndarray
    shape: tuple[int, int, int]
    lower: tuple[float, float, float]
    inverse: float
    cull: float


@inlined
def _nearest(position, lower, inverse, count):
    """Index of the nearest node along one axis."""
    return int(min(max((position - lower) * inverse + 0.5, 0.0), count - 0.5))


@inlined
def nearest_node_distance(field, point):
    """Distance at the node nearest to a point [m]."""
    i = _nearest(point[0], field.lower[0], field.inverse, field.shape[0])
    j = _nearest(point[1], field.lower[1], field.inverse, field.shape[1])
    k = _nearest(point[2], field.lower[2], field.inverse, field.shape[2])
    return field.distance[(i * field.shape[1] + j) * field.shape[2] + k]


@inlined
def _cell(position, lower, inverse, count):
    """Along one axis: first node of the cell, relative position in the cell [1], distance beyond the grid [m]."""
    place = (position - lower) * inverse
    inside = min(max(place, 0.0), count - 1.0)
    base = min(int(inside), count - 2)
    return base, inside - base, (place - inside) / inverse


@native
def sample(field, table, point, value, slope):
    """Writes the interpolated channels and their derivatives [1/m], as `SignedDistanceField.sample`."""
    i, x, outside_x = _cell(point[0], field.lower[0], field.inverse, field.shape[0])
    j, y, outside_y = _cell(point[1], field.lower[1], field.inverse, field.shape[1])
    k, z, outside_z = _cell(point[2], field.lower[2], field.inverse, field.shape[2])
    outside = (outside_x, outside_y, outside_z)
    distant = math.sqrt(outside_x**2 + outside_y**2 + outside_z**2)
    row, plane = field.shape[2], field.shape[1] * field.shape[2]
    a = i * plane + j * row + k
    b = a + plane
    for c in range(table.shape[1]):
        v000, v001 = table[a, c], table[a + 1, c]
        v010, v011 = table[a + row, c], table[a + row + 1, c]
        v100, v101 = table[b, c], table[b + 1, c]
        v110, v111 = table[b + row, c], table[b + row + 1, c]
        d00, d01, d10, d11 = v100 - v000, v101 - v001, v110 - v010, v111 - v011
        v00, v01, v10, v11 = v000 + x * d00, v001 + x * d01, v010 + x * d10, v011 + x * d11
        v0, v1 = v00 + y * (v10 - v00), v01 + y * (v11 - v01)
        value[c] = v0 + z * (v1 - v0)
        d0, d1 = d00 + y * (d10 - d00), d01 + y * (d11 - d01)
        slope[c, 0] = (d0 + z * (d1 - d0)) * field.inverse
        slope[c, 1] = ((v10 - v00) + z * ((v11 - v01) - (v10 - v00))) * field.inverse
        slope[c, 2] = (v1 - v0) * field.inverse
        if distant > 0.0:
            for axis in range(3):
                if outside[axis] != 0.0:
                    slope[c, axis] = 0.0
                if c == 0 or c == CHANNELS:
                    slope[c, axis] += outside[axis] / distant
            if c == 0 or c == CHANNELS:
                value[c] += distant


@inlined
def distance_to(field, point):
    """Interpolated distance [m] and its gradient: `sample` of the first channel alone."""
    i, x, outside_x = _cell(point[0], field.lower[0], field.inverse, field.shape[0])
    j, y, outside_y = _cell(point[1], field.lower[1], field.inverse, field.shape[1])
    k, z, outside_z = _cell(point[2], field.lower[2], field.inverse, field.shape[2])
    row, plane, table = field.shape[2], field.shape[1] * field.shape[2], field.distance
    a = i * plane + j * row + k
    b = a + plane
    v000, v001, v010, v011 = table[a], table[a + 1], table[a + row], table[a + row + 1]
    d00, d01, d10, d11 = table[b] - v000, table[b + 1] - v001, table[b + row] - v010, table[b + row + 1] - v011
    v00, v01, v10, v11 = v000 + x * d00, v001 + x * d01, v010 + x * d10, v011 + x * d11
    v0, v1 = v00 + y * (v10 - v00), v01 + y * (v11 - v01)
    d0, d1 = d00 + y * (d10 - d00), d01 + y * (d11 - d01)
    value = v0 + z * (v1 - v0)
    slope_x = (d0 + z * (d1 - d0)) * field.inverse
    slope_y = ((v10 - v00) + z * ((v11 - v01) - (v10 - v00))) * field.inverse
    slope_z = (v1 - v0) * field.inverse
    if outside_x != 0.0 or outside_y != 0.0 or outside_z != 0.0:
        distant = math.sqrt(outside_x**2 + outside_y**2 + outside_z**2)
        value += distant
        slope_x = outside_x / distant + (slope_x if outside_x == 0.0 else 0.0)
        slope_y = outside_y / distant + (slope_y if outside_y == 0.0 else 0.0)
        slope_z = outside_z / distant + (slope_z if outside_z == 0.0 else 0.0)
    return value, (slope_x, slope_y, slope_z)
