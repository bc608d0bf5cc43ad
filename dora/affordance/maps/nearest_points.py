"""Fast queries against a fixed surface: the nearest of a set of points, and the distance to a mesh."""

from __future__ import annotations

import igl
import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

CHUNK = 512
"""Queries compared with all points at a time."""


class NearestTable:
    """The k nearest of P points, exactly, for queries near the points.

    Space is divided into cells; each cell near a point stores the M points nearest to its centre. A query q is compared
    with the M points of its cell. Let c be the cell's centre and R the distance of its M-th point from c: every other
    point is at least R - |q - c| from q, so k results within that distance are exact. Other queries, and those outside
    the cells, are compared with all points.
    """

    CELL = 1.5
    """Edge length of a cell in spacings of the points [1]."""
    BAND = 3.0
    """Distance to the nearest point, in edge lengths, up to which a cell stores points [1]."""
    MOST_CELLS = 400_000
    """Largest number of cells; cells grow instead."""

    def __init__(self, points: Float[Tensor, "p 3"], spacing: float, candidates: int):
        """Builds the table.

        Args:
            points: (p, 3) positions [m].
            spacing: typical distance of neighbouring points [m].
            candidates: M; at least the largest k, and a few times as much for speed.
        """
        self.points = points
        self.candidates = min(candidates, len(points))
        low, high = points.amin(0), points.amax(0)
        edge = max(self.CELL * spacing, float((high - low + 1e-3).prod() / self.MOST_CELLS) ** (1 / 3))
        self.edge, self.low = edge, low - self.BAND * edge
        self.shape = ((high + self.BAND * edge - self.low) / edge).ceil().long()
        axes = [torch.arange(int(n), device=points.device) for n in self.shape]
        cells = torch.cartesian_prod(*axes)
        centers = self.low + (cells + 0.5) * edge
        tree = KDTree(points.cpu().numpy())
        near = torch.from_numpy(tree.query(centers.cpu().numpy(), distance_upper_bound=self.BAND * edge)[0]).isfinite()
        near = near.to(points.device)
        self.row = torch.where(near, near.long().cumsum(0) - 1, -1)
        self.centers = centers[near]
        distance, index = tree.query(self.centers.cpu().numpy(), k=self.candidates)
        index = torch.from_numpy(index).view(-1, self.candidates).to(points.device)
        self.index = index
        self.places = (points[index] - self.centers[:, None]).mT.contiguous()
        self.squares = self.places.square().sum(1)
        all_known = self.candidates == len(points)
        reach = torch.from_numpy(distance).view(-1, self.candidates)[:, -1].to(points)
        self.reach = torch.full_like(reach, torch.inf) if all_known else reach

    def query(self, queries: Float[Tensor, "b 3"], k: int) -> tuple[Float[Tensor, "b k"], Int[Tensor, "b k"]]:
        """Distances, ascending [m], and indices of the k points nearest to queries [m]; k is at most `candidates`."""
        cell = ((queries - self.low) / self.edge).floor().long()
        inside = ((cell >= 0) & (cell < self.shape)).all(-1)
        cell = torch.where(inside[:, None], cell, 0)
        row = self.row[(cell[:, 0] * self.shape[1] + cell[:, 1]) * self.shape[2] + cell[:, 2]]
        known = inside & (row >= 0)
        row = row.clamp(min=0)
        local = queries - self.centers[row]
        own = local.square().sum(-1)
        apart = torch.baddbmm(self.squares[row][:, None], local[:, None], self.places[row], alpha=-2)[:, 0]
        square, place = apart.topk(k, largest=False)
        distance = (square + own[:, None]).clamp(min=0).sqrt()
        index = self.index[row[:, None], place]
        slack = self.reach[row] - own.sqrt()
        doubtful = (~known | (distance[:, -1] > slack)).nonzero()[:, 0]
        if len(doubtful):
            distance[doubtful], index[doubtful] = nearest_by_comparison(self.points, queries[doubtful], k)
        return distance, index


def nearest_by_comparison(
    points: Float[Tensor, "p 3"], queries: Float[Tensor, "b 3"], k: int
) -> tuple[Float[Tensor, "b k"], Int[Tensor, "b k"]]:
    """Distances, ascending [m], and indices of the k nearest points, by comparison with all; slow and exact."""
    found = [
        torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist").topk(k, largest=False)
        for part in queries.split(CHUNK)
    ]
    return torch.cat([f.values for f in found]), torch.cat([f.indices for f in found])


class RegionField:
    """Unsigned distance to a triangle mesh, interpolated on a grid.

    A node of the grid stores the nearest point of the mesh and its distance. Near the mesh, where the distance has a
    kink, the nearest point is interpolated between nodes; elsewhere, where the nearest point can jump, the distance is.
    Outside the grid the nearest point is that of the nearest node.
    """

    NODE_SPACING = 0.004
    """Distance of neighbouring nodes [m]."""
    MARGIN = 0.05
    """Margin of the grid around the mesh [m]."""
    MOST_NODES = 400_000
    """Largest number of nodes; their distance grows instead."""
    POINT_BAND = 1.0
    """Interpolated distance, in distances of nodes, below which the nearest point is interpolated instead [1]."""

    def __init__(self, mesh: trimesh.Trimesh, device: torch.device | str = "cpu"):
        """Builds the grid around a mesh [m], which may be open."""
        low, high = mesh.bounds[0] - self.MARGIN, mesh.bounds[1] + self.MARGIN
        self.node = max(self.NODE_SPACING, float((high - low).prod() / self.MOST_NODES) ** (1 / 3))
        count = np.ceil((high - low) / self.node).astype(int) + 1
        nodes = low + np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), -1).reshape(-1, 3) * self.node
        vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
        square, _, nearest = igl.point_mesh_squared_distance(nodes, vertices, faces)[:3]
        values = torch.from_numpy(np.concatenate([nearest, np.sqrt(square)[:, None]], -1)).float().to(device)
        self.nearest = values[:, :3].contiguous()
        self.values = values.T.reshape(1, 4, *count.tolist()).contiguous()
        self.low, self.last = self.values.new_tensor(low), torch.tensor(count - 1, device=device)

    def __call__(self, queries: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
        """Distance of queries in the frame of the mesh [m]; differentiable almost everywhere."""
        place = (queries - self.low) / self.node
        values = torch.nn.functional.grid_sample(
            self.values, (2 * place / self.last - 1).flip(-1)[None, None, None], align_corners=True
        )[0, :, 0, 0].T
        point, length = values[:, :3], values[:, 3]
        inside = ((place >= 0) & (place <= self.last)).all(-1)
        node = torch.minimum(place.detach().round().long().clamp(min=0), self.last)
        border = self.nearest[(node[:, 0] * (self.last[1] + 1) + node[:, 1]) * (self.last[2] + 1) + node[:, 2]]
        near = inside & (length < self.POINT_BAND * self.node)
        exact = (torch.where(inside[:, None], point, border) - queries).norm(dim=-1)
        return torch.where(near | ~inside, exact, length)
