"""Fast queries against a fixed set of surface points: the nearest ones, and the distance to a surface."""

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

    Space is divided into cells; each cell near a point knows the M points nearest to its centre. A query looks at
    those M. Let c be the cell's centre and R the distance of its M-th point: every other point is at least
    R - |q - c| away, so k results within that are the true ones. Queries for which this fails, or outside the
    cells, are compared with all points.
    """

    CELL = 1.5
    """Edge of a cell in spacings of the points."""
    BAND = 3.0
    """Cells with a point within this many cell edges have a row."""
    MOST_CELLS = 400_000
    """Cells grow if there would be more."""

    def __init__(self, points: Float[Tensor, "p 3"], spacing: float, candidates: int):
        """Builds the table.

        Args:
            points: (p, 3) [m].
            spacing: typical distance [m] of neighbouring points.
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
        """Distances [m], ascending, and indices of the k nearest points; k is at most `candidates`."""
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
    """Distances [m], ascending, and indices of the k nearest points, from all distances; slow and exact."""
    found = [
        torch.cdist(part, points, compute_mode="donot_use_mm_for_euclid_dist").topk(k, largest=False)
        for part in queries.split(CHUNK)
    ]
    return torch.cat([f.values for f in found]), torch.cat([f.indices for f in found])


class RegionField:
    """Unsigned distance to a triangle mesh, interpolated on a grid.

    A node of the grid holds the nearest point of the mesh, and its distance. Between nodes the nearest point is
    interpolated near the mesh, where the distance has a kink, and the distance elsewhere, where the nearest point
    can jump. Beyond the grid the nearest point is that of the nearest node.
    """

    NODE = 0.004
    """Distance of the nodes [m]."""
    MARGIN = 0.05
    """Room of the grid around the mesh [m]."""
    MOST_NODES = 400_000
    """Nodes move apart if there would be more."""
    NEAR = 1.0
    """Interpolated distance, in distances of the nodes, below which the nearest point is interpolated."""

    def __init__(self, mesh: trimesh.Trimesh, device: torch.device | str = "cpu"):
        """Builds the grid around a mesh [m], which may be open."""
        low, high = mesh.bounds[0] - self.MARGIN, mesh.bounds[1] + self.MARGIN
        self.node = max(self.NODE, float((high - low).prod() / self.MOST_NODES) ** (1 / 3))
        count = np.ceil((high - low) / self.node).astype(int) + 1
        nodes = low + np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), -1).reshape(-1, 3) * self.node
        vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
        square, _, nearest = igl.point_mesh_squared_distance(nodes, vertices, faces)[:3]
        values = torch.from_numpy(np.concatenate([nearest, np.sqrt(square)[:, None]], -1)).float().to(device)
        self.nearest = values[:, :3].contiguous()
        self.values = values.T.reshape(1, 4, *count.tolist()).contiguous()
        self.low, self.last = self.values.new_tensor(low), torch.tensor(count - 1, device=device)

    def __call__(self, queries: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
        """Distance [m]; differentiable almost everywhere."""
        place = (queries - self.low) / self.node
        values = torch.nn.functional.grid_sample(
            self.values, (2 * place / self.last - 1).flip(-1)[None, None, None], align_corners=True
        )[0, :, 0, 0].T
        point, length = values[:, :3], values[:, 3]
        inside = ((place >= 0) & (place <= self.last)).all(-1)
        node = torch.minimum(place.detach().round().long().clamp(min=0), self.last)
        border = self.nearest[(node[:, 0] * (self.last[1] + 1) + node[:, 1]) * (self.last[2] + 1) + node[:, 2]]
        near = inside & (length < self.NEAR * self.node)
        exact = (torch.where(inside[:, None], point, border) - queries).norm(dim=-1)
        return torch.where(near | ~inside, exact, length)
