"""Signed distance to an object: exact by libigl, and on a grid with trilinear interpolation for the optimiser.

Distances are positive outside. The grid is filled exactly near the surface and, farther away, by
interpolation of a grid that is `COARSENING` times coarser: filling is several times faster so, and the
interpolant's error stays well below a millimetre (`SignedDistanceField.error` measures it).
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
"""Grid spacing [m]."""
MARGIN = 0.05
"""Width [m] of the grid around the object's bounding box; more than the radius of any hand capsule."""
COARSENING = 4
"""Ratio of the coarse and the fine spacing."""
BAND = 0.01
"""Nodes within this distance [m] of the surface are exact."""
MAX_NODES = 1.6e7
"""Largest grid, whose nodes float32 can still count; a larger object is absurdly large for a hand."""
CHANNELS = 4
"""Columns of a field's table without the region: distance [m] and unit gradient (3,)."""
_TINY = 1e-12
CULL = 1.25
"""|interpolated value - value at the nearest node| is at most this times the spacing, gradients being unit."""


@dataclass(frozen=True)
class FieldError:
    """Error [m] of a field against the mesh at points within `reach` [m] of its surface."""

    mean: float
    largest: float
    reach: float


class ExactDistance:
    """Exact signed distance to a watertight mesh [m] by libigl, on one thread."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._vertices = np.array(mesh.vertices, dtype=np.float64)
        self._faces = np.array(mesh.faces, dtype=np.int64)

    def __call__(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Signed distance [m] of points in the mesh's frame."""
        return self.with_gradient(points)[:, 0]

    def with_gradient(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
        """Signed distance and its unit gradient; on the surface the gradient is the mesh's normal."""
        if not len(points):
            return np.zeros((0, CHANNELS))
        points = np.ascontiguousarray(points, dtype=np.float64)
        distance, _, closest, normal = igl.signed_distance(
            points, self._vertices, self._faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        )
        safe = np.where(np.abs(distance) > 1e-6, distance, 1.0)[:, None]
        gradient = np.where(np.abs(distance)[:, None] > 1e-6, (points - closest) / safe, normal)
        return np.column_stack((distance, gradient))

    def unsigned(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance [m] to the surface, which need not be closed."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        return np.sqrt(igl.point_mesh_squared_distance(points, self._vertices, self._faces)[0])


class SignedDistanceField:
    """Signed distance, its gradient and optionally the distance to a region on a regular grid.

    Args:
        solid: watertight mesh [m] with outward faces.
        region: open surface [m], part of the object, to which the last channel is the unsigned distance.
        dtype: floating type of every tensor.
        device: torch device of every tensor.
        spacing: grid spacing [m].

    Attributes:
        exact: the exact distance to `solid`.
        table: (nodes, 4 or 5) distance, unit gradient, distance to the region; the last axis runs fastest.
        shape: nodes along x, y, z; `lower`, `upper` (3,) are the positions of the first and the last [m].

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

        A point that is left out is farther away. Costs one look-up of the nearest node.
        """
        node = torch.clamp(self._place(points).round_(), self._zero, self._last) @ self._strides
        near = self._distance.index_select(0, node.int().flatten()).view(node.shape)
        return (near < reach + CULL * self.spacing).flatten().nonzero().squeeze(1)

    def _place(self, points: Tensor) -> Tensor:
        """Positions in units of the spacing, from the first node."""
        return torch.addcmul(self._origin, points, self._scale)

    def sample(
        self, points: Float[Tensor, "n 3"], channels: int | None = None
    ) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n k 3"]]:
        """Interpolated channels of the table, and the exact derivatives of the interpolant [1/m].

        Outside the grid the distances grow by the distance to the grid, and gradients stay constant.
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
        """Interpolated signed distance [m]."""
        return self.sample(points.reshape(-1, 3), 1)[0].reshape(points.shape[:-1])

    def error(self, count: int = 20_000, reach: float = BAND, seed: int = 0) -> FieldError:
        """Compare with the exact distance at random points near the surface."""
        generator = np.random.default_rng(seed)
        points = trimesh.sample.sample_surface(self.solid, count, seed=seed)[0]
        points = points + generator.uniform(-reach, reach, points.shape) / np.sqrt(3)
        found = self.distance(self.table.new_tensor(points)).double().cpu().numpy()
        difference = np.abs(found - self.exact(points))
        return FieldError(float(difference.mean()), float(difference.max()), reach)


def _mix(corner: Tensor, share: Tensor) -> Tensor:
    """Interpolation (m/2, n, k) between the first and the second half of corners (m, n, k)."""
    low, high = corner.chunk(2)
    return torch.lerp(low, high, share)


def _blend(corner: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Slope and interpolation between the first and the second half of corners."""
    low, high = corner.chunk(2)
    slope = high - low
    return slope, torch.addcmul(low, slope, share)


def _nodes(lower: np.ndarray, spacing: float, shape: Sequence[int] | np.ndarray) -> np.ndarray:
    """Positions (nodes, 3) of a grid's nodes, the last axis running fastest."""
    axes = [start + spacing * np.arange(count) for start, count in zip(lower, shape, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)


def _refined(values: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Trilinear interpolation of values (nodes, k) on a grid to one `COARSENING` times finer."""
    volume = torch.as_tensor(values.T.reshape(1, -1, *shape))
    size = [int(count - 1) * COARSENING + 1 for count in shape]
    fine = torch.nn.functional.interpolate(volume, size=size, mode="trilinear", align_corners=True)
    return fine[0].flatten(1).T.numpy()


def _fill(exact: ExactDistance, lower: np.ndarray, spacing: float, coarse: np.ndarray, fine: np.ndarray) -> np.ndarray:
    """Distance and gradient (nodes, 4) on the fine grid."""
    values = _refined(exact.with_gradient(_nodes(lower, COARSENING * spacing, coarse)), coarse).copy()
    near = np.abs(values[:, 0]) < BAND
    values[near] = exact.with_gradient(_nodes(lower, spacing, fine)[near])
    return values
