"""Signed distance to an object: exact by libigl, and on a grid with trilinear interpolation for the search.

Distances are positive outside. Nodes near the surface have exact values; the others are interpolated from a grid that
is `COARSENING` times coarser, which makes filling several times faster. The error of the interpolation stays well
below a millimetre (`SignedDistanceField.error` measures it).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from dora.errors import InputError

os.environ.setdefault("IGL_NUM_THREADS", "1")  # read once, when libigl is first used
import igl

SPACING = 2.5e-3
"""Distance of neighbouring nodes of the grid [m]."""
MARGIN = 0.05
"""Margin of the grid around the object's bounding box; more than the radius of any capsule of a hand [m]."""
COARSENING = 4
"""Ratio of the coarse to the fine spacing [1]."""
BAND = 0.01
"""Distance from the surface up to which nodes have exact values [m]."""
MAX_NODES = 1.6e7
"""Largest number of nodes, the range in which float32 represents all integers."""
CHANNELS = 4
"""Columns of a field's table without the region: distance [m] and unit gradient (3,)."""
_TINY = 1e-12
"""Lower bound of a length by which a vector is divided [m]."""
_FLAT = 1e-6
"""Ratio of twice the area to the squared longest edge below which a triangle is flat: its normal is rounding [1]."""
_ON_IT = 1e-6
"""Distance from the surface up to which a point lies on it [m]."""
CULL = 1.25
"""Bound on |interpolated distance - distance at the nearest node| in spacings, for unit gradients [1]."""


@dataclass(frozen=True)
class FieldError:
    """Mean and largest error [m] of a field against the mesh at points within `reach` [m] of its surface."""

    mean: float
    largest: float
    reach: float


class ExactDistance:
    """Exact signed distance to a watertight mesh [m] by libigl, on one thread.

    The sign is that of the pseudonormals (Baerentzen and Aanaes, 2005). Where the nearest triangle has a corner of a
    flat one, as meshes of CAD programs have them, the pseudonormal may point anywhere: there, the generalised winding
    number (Jacobson et al., 2013) decides.
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._vertices = np.array(mesh.vertices, dtype=np.float64)
        self._faces = np.array(mesh.faces, dtype=np.int64)
        flat = _flat(self._vertices[self._faces])
        self._sturdy = self._faces[~flat]
        self._doubtful = np.any(np.isin(self._faces, self._faces[flat]), axis=1)
        self._inward = bool(flat.any() and mesh.volume < 0)

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Signed distance (n,) of points (n, 3) in the mesh's frame, negative inside [m]."""
        return self.with_gradient(points)[:, 0]

    def with_gradient(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
        """(n, 4) signed distance [m] and its unit gradient; on the surface the gradient is the mesh's normal."""
        if not len(points):
            return np.zeros((0, CHANNELS))
        points = np.ascontiguousarray(points, dtype=np.float64)
        found = igl.signed_distance(points, self._vertices, self._faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
        distance, face, closest, normal = map(np.asarray, found)
        if self._doubtful.any() and (doubtful := self._doubtful[face]).any():
            distance[doubtful] = np.abs(distance[doubtful]) * self._side(points[doubtful])
            on_it = doubtful & (np.abs(distance) <= _ON_IT)
            normal[on_it] = self._normals(points[on_it])
        safe = np.where(np.abs(distance) > _ON_IT, distance, 1.0)[:, None]
        gradient = np.where(np.abs(distance)[:, None] > _ON_IT, (points - closest) / safe, normal)
        return np.column_stack((distance, gradient))

    def _side(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """-1 for points (n, 3) inside of the mesh and 1 for others (n,), by the winding number."""
        winding = np.asarray(igl.fast_winding_number(self._vertices, self._faces, points))
        return np.where(winding > (-0.5 if self._inward else 0.5), -1.0, 1.0)

    def _normals(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Normals (n, 3) of the triangles nearest to points (n, 3), without flat ones."""
        if not len(points):
            return points
        nearest = igl.point_mesh_squared_distance(points, self._vertices, self._sturdy)[1]
        a, b, c = self._vertices[self._sturdy[np.asarray(nearest)]].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def unsigned(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Unsigned distance (n,) of points (n, 3) to the surface, which may be open [m]."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        return np.sqrt(igl.point_mesh_squared_distance(points, self._vertices, self._faces)[0])


class SignedDistanceField:
    """Signed distance, its gradient and optionally the distance to a region on a regular grid.

    Args:
        solid: watertight mesh with outward faces [m].
        region: open surface whose unsigned distance is the last channel [m]; no such channel if None.
        dtype: floating type of every tensor.
        device: torch device of every tensor.
        spacing: distance of neighbouring nodes [m].

    Attributes:
        exact: the exact distance to `solid`.
        table: (nodes, 4 or 5) distance [m], unit gradient, distance to the region [m]; z varies fastest.
        shape: number of nodes along x, y, z; `lower`, `upper` (3,) are the positions of the first and the last [m].

    Raises:
        InputError: the object is too large for a grid of this spacing.
    """

    def __init__(
        self,
        solid: trimesh.Trimesh,
        region: trimesh.Trimesh | None = None,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        spacing: float = SPACING,
    ) -> None:
        lower, upper = np.asarray(solid.bounds) + np.array([[-MARGIN], [MARGIN]])
        coarse = np.ceil((upper - lower) / (COARSENING * spacing)).astype(int) + 1
        fine = (coarse - 1) * COARSENING + 1
        if fine.prod(dtype=float) > MAX_NODES:
            size = " x ".join(f"{extent:.2f}" for extent in solid.extents)
            raise InputError(f"the object measures {size} m, too large for a hand; check its units and scale.")
        self.exact = ExactDistance(solid)
        self.spacing, self.solid = spacing, solid
        nodes = _fill(self.exact, lower, spacing, coarse, fine)
        if region is not None:
            distance = ExactDistance(region).unsigned(_nodes(lower, COARSENING * spacing, coarse))
            nodes = np.column_stack((nodes, _refined(distance[:, None], coarse)))
        self.table = torch.as_tensor(nodes, dtype=dtype, device=device).contiguous()
        self._distance = self.table[:, 0].contiguous()
        self._scale = self.table.new_full((3,), 1 / spacing)
        self._origin = self.table.new_tensor(-lower / spacing)
        self._zero, self._last = torch.zeros_like(self._origin), self.table.new_tensor(fine - 1.0)
        corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)
        strides = np.array([fine[1] * fine[2], fine[2], 1])
        self._strides = self.table.new_tensor(strides)
        self._corners = torch.as_tensor(corners @ strides, device=device).unsqueeze(1)
        self.shape = tuple(int(n) for n in fine)
        self.lower, self.upper = self.table.new_tensor(lower), self.table.new_tensor(lower + (fine - 1) * spacing)

    def may_touch(self, points: Float[Tensor, "c p 3"], reach: Float[Tensor, " p"]) -> Int[Tensor, " n"]:
        """Flat indices into (c, p) of all points whose interpolated distance may be below `reach` (p,) [m].

        Conservative: a point that is left out is farther away. Costs one look-up of the nearest node.
        """
        node = torch.clamp(self._place(points).round_(), self._zero, self._last) @ self._strides
        near = self._distance.index_select(0, node.int().flatten()).view(node.shape)
        return (near < reach + CULL * self.spacing).flatten().nonzero().squeeze(1)

    def _place(self, points: Tensor) -> Tensor:
        """Positions relative to the first node, in spacings."""
        return torch.addcmul(self._origin, points, self._scale)

    def sample(
        self, points: Float[Tensor, "n 3"], channels: int | None = None
    ) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n k 3"]]:
        """Interpolated channels of the table at points in the object frame [m], and their exact derivatives [1/m].

        Outside the grid the distance to the grid is added to the distances, and gradients are constant.

        Args:
            points: (n, 3) positions [m].
            channels: number of channels, from the first; all if None.
        """
        place = self._place(points)
        inside = torch.clamp(place, self._zero, self._last)
        base = torch.minimum(inside.floor(), self._last - 1)
        x, y, z = (inside - base).T.unsqueeze(-1)
        index = (base @ self._strides).long() + self._corners
        value = self._distance[index].unsqueeze(-1) if channels == 1 else self.table[index][..., :channels]
        by_x, value = _blend(value, x)
        by_x, (by_y, value) = _mix(by_x, y), _blend(value, y)
        by_x, by_y, (by_z, value) = _mix(by_x, z), _mix(by_y, z), _blend(value, z)
        value, jacobian = value[0], torch.stack((by_x[0], by_y[0], by_z[0]), -1) / self.spacing
        outside = (place - inside) * self.spacing
        if outside.count_nonzero():
            jacobian = jacobian * (outside == 0).unsqueeze(1)
            length = outside.norm(dim=-1, keepdim=True)
            grow = [channel for channel in (0, CHANNELS) if channel < value.shape[1]]
            value[:, grow] += length
            jacobian[:, grow] += (outside / length.clamp_min(_TINY)).unsqueeze(1)
        return value, jacobian

    def distance(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Interpolated signed distance of points in the object frame [m]."""
        return self.sample(points.reshape(-1, 3), 1)[0].reshape(points.shape[:-1])

    def error(self, count: int = 20_000, reach: float = BAND, seed: int = 0) -> FieldError:
        """Error against the exact distance at `count` random points within `reach` [m] of the surface."""
        generator = np.random.default_rng(seed)
        points = trimesh.sample.sample_surface(self.solid, count, seed=seed)[0]
        points = points + generator.uniform(-reach, reach, points.shape) / np.sqrt(3)
        found = self.distance(self.table.new_tensor(points)).double().cpu().numpy()
        difference = np.abs(found - self.exact(points))
        return FieldError(float(difference.mean()), float(difference.max()), reach)


def _flat(corners: Float[np.ndarray, "f 3 3"]) -> np.ndarray:
    """Whether triangles (f, 3 corners, 3) are so flat that their normals are rounding (f,)."""
    edges = corners - np.roll(corners, 1, axis=1)
    longest = (edges**2).sum(-1).max(1)
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) <= _FLAT * longest


def _mix(corner: Tensor, share: Tensor) -> Tensor:
    """Interpolation (m/2, n, k) between the first and the second half of corners (m, n, k)."""
    low, high = corner.chunk(2)
    return torch.lerp(low, high, share)


def _blend(corner: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Difference of, and interpolation between, the first and the second half of corners."""
    low, high = corner.chunk(2)
    slope = high - low
    return slope, torch.addcmul(low, slope, share)


def _nodes(lower: np.ndarray, spacing: float, shape: Sequence[int] | np.ndarray) -> np.ndarray:
    """Positions (nodes, 3) of a grid's nodes [m]; z varies fastest."""
    axes = [start + spacing * np.arange(count) for start, count in zip(lower, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _refined(values: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Trilinear interpolation of values (nodes, k) from a grid to one that is `COARSENING` times finer."""
    volume = torch.as_tensor(values.T.reshape(1, -1, *shape))
    size = [int(count - 1) * COARSENING + 1 for count in shape]
    fine = torch.nn.functional.interpolate(volume, size=size, mode="trilinear", align_corners=True)
    return fine[0].flatten(1).T.numpy()


def _fill(exact: ExactDistance, lower: np.ndarray, spacing: float, coarse: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """Distance [m] and unit gradient (nodes, 4) on the fine grid."""
    values = _refined(exact.with_gradient(_nodes(lower, COARSENING * spacing, coarse)), coarse).copy()
    near = np.abs(values[:, 0]) < BAND
    values[near] = exact.with_gradient(_nodes(lower, spacing, fine)[near])
    return values
