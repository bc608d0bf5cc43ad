"""The affordance map of an object: surface points, each with the label of its region."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.maps.nearest_points import NearestTable, RegionField
from dora.affordance.maps.poisson_disk import sample_evenly
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.containers import check_triangles
from dora.errors import InputError
from dora.files import read_tensors, write_tensors

COUNT = 4096
"""Default number of surface points of a map."""
FORMAT = "dora-map 1"
"""Format and version of a file of a map."""
STORED = {
    "points": ("n", 3, False), "normals": ("n", 3, False), "areas": ("n", 0, False), "labels": ("n", 0, True),
    "vertices": ("v", 3, False), "faces": ("f", 3, True), "face_labels": ("f", 0, True),
}  # fmt: skip
"""Tensors of a file: of what they have rows, numbers in a row, and whether they are whole."""
CANDIDATES_PER_NEIGHBOUR, FEWEST_CANDIDATES = 6, 48
"""Points stored per cell of the nearest-point table: this many per neighbour asked for, and at least the second."""


@dataclass(frozen=True, eq=False)
class AffordanceMap:
    """M_Aff of the paper: P points spread evenly over a surface, each with one label; in the object frame.

    Attributes:
        name: name of the object.
        points: (p, 3) positions [m].
        normals: (p, 3) outward unit normals.
        areas: (p,) area that each point represents [m^2].
        labels: (p,) index into `names`.
        names: names of the regions.
        mesh: the surface [m].
        face_labels: (f,) index into `names` of every face of `mesh`.
        digest: digest of the object's labelled surface.
    """

    name: str
    points: Float[Tensor, "p 3"]
    normals: Float[Tensor, "p 3"]
    areas: Float[Tensor, " p"]
    labels: Int[Tensor, " p"]
    names: tuple[str, ...]
    mesh: trimesh.Trimesh
    face_labels: Int[np.ndarray, " f"]
    digest: str
    _tables: dict[int, NearestTable] = field(default_factory=dict, repr=False)
    _fields: dict[int, RegionField] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def from_object(cls, obj: AffordanceObject, count: int = COUNT, seed: int = 0) -> AffordanceMap:
        """Sample an object's surface.

        Args:
            obj: the object.
            count: number of points P.
            seed: seed of the random points.

        Raises:
            InputError: `count` is less than the number of regions.
        """
        if count < len(obj.labels):
            raise InputError(f"{count} points cannot show {len(obj.labels)} regions; ask for {COUNT}.")
        points, faces, areas = sample_evenly(obj.mesh, count, seed)
        return cls(
            name=obj.name,
            points=torch.from_numpy(points).float(),
            normals=torch.from_numpy(np.array(obj.mesh.face_normals[faces])).float(),
            areas=torch.from_numpy(areas).float(),
            labels=torch.from_numpy(obj.face_labels[faces]).long(),
            names=obj.labels,
            mesh=obj.mesh,
            face_labels=obj.face_labels,
            digest=obj.digest,
        )

    @property
    def spacing(self) -> float:
        """Typical distance of neighbouring points: that of a hexagonal grid of equal density [m]."""
        return float((2 * self.areas.mean() / 3**0.5) ** 0.5)

    def label_index(self, label: str) -> int:
        """Index of a region.

        Raises:
            InputError: the map has no such region.
        """
        if label not in self.names:
            raise InputError(f"{self.name} has no region {label!r}; choose one of: {', '.join(self.names)}.")
        return self.names.index(label)

    def nearest_points(
        self, queries: Float[Tensor, "*b 3"], k: int
    ) -> tuple[Float[Tensor, "*b k"], Int[Tensor, "*b k"]]:
        """The k points nearest to each query, exactly.

        Fast for queries within a few spacings of the surface; others are compared with all points. The table for a
        value of k is built at its first use.

        Args:
            queries: positions in the object frame [m].
            k: number of points per query.

        Returns:
            Distances, ascending [m], and indices of the points.

        Raises:
            InputError: k is not in 1 .. P.
        """
        if not 1 <= k <= len(self):
            raise InputError(f"{k} neighbours were asked of a map with {len(self)} points; ask for 1 to {len(self)}.")
        size = max(FEWEST_CANDIDATES, CANDIDATES_PER_NEIGHBOUR * k)
        if size not in self._tables:
            self._tables[size] = NearestTable(self.points, self.spacing, size)
        distance, index = self._tables[size].query(queries.reshape(-1, 3), k)
        shape = (*queries.shape[:-1], k)
        return distance.view(shape), index.view(shape)

    def nearest(self, queries: Float[Tensor, "*b 3"], k: int) -> tuple[Float[Tensor, "*b k"], Int[Tensor, "*b k"]]:
        """Distances, ascending [m], and labels of the k points nearest to each query; as `nearest_points`."""
        distance, index = self.nearest_points(queries, k)
        return distance, self.labels[index]

    def region_distance(self, queries: Float[Tensor, "*b 3"], label: str) -> Float[Tensor, "*b"]:
        """Unsigned distance [m] of queries ([m], object frame) to a region's surface, interpolated on a grid.

        Differentiable. The grid of a region is built at its first use.

        Raises:
            InputError: the map has no such region.
        """
        index = self.label_index(label)
        if index not in self._fields:
            region = trimesh.Trimesh(self.mesh.vertices, self.mesh.faces[self.face_labels == index])
            self._fields[index] = RegionField(region, self.points.device)
        return self._fields[index](queries.reshape(-1, 3)).view(queries.shape[:-1])

    def to(self, device: torch.device | str) -> AffordanceMap:
        """The same map on another device."""
        moved = {name: value.to(device) for name, value in self._tensors().items()}
        return replace(self, **moved, _tables={}, _fields={})

    def _tensors(self) -> dict[str, Tensor]:
        """The tensors that `to` moves."""
        return {name: getattr(self, name) for name in ("points", "normals", "areas", "labels")}

    def save(self, path: Path | str) -> None:
        """Write a safetensors file.

        Raises:
            InputError: it cannot be written.
        """
        metadata = {"name": self.name, "names": list(self.names), "digest": self.digest}
        surface = {
            "vertices": torch.tensor(np.array(self.mesh.vertices)),
            "faces": torch.tensor(np.array(self.mesh.faces)),
            "face_labels": torch.tensor(self.face_labels),
        }
        write_tensors(Path(path), FORMAT, self._tensors() | surface, metadata)

    @classmethod
    def load(cls, path: Path | str, obj: AffordanceObject | None = None) -> AffordanceMap:
        """Read what `save` wrote and, if an object is given, check that the map is of its surface.

        Raises:
            InputError: no such file, damaged, of another format, or of another object.
        """
        tensors, metadata = read_tensors(Path(path), FORMAT)
        if obj is not None and metadata.get("digest") != obj.digest:
            raise InputError(f"{path} is the map of another shape or labelling than {obj.name}: make it again.")
        _check_stored(Path(path), tensors, metadata)
        vertices, faces, face_labels = (tensors[key].numpy() for key in ("vertices", "faces", "face_labels"))
        return cls(
            points=tensors["points"].float(),
            normals=tensors["normals"].float(),
            areas=tensors["areas"].float(),
            labels=tensors["labels"].long(),
            name=metadata["name"],
            names=tuple(metadata["names"]),
            mesh=trimesh.Trimesh(vertices, faces, process=False),
            face_labels=face_labels.astype(np.int64),
            digest=metadata["digest"],
        )


def _check_stored(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Refuses what is no map: names, types, shapes and indices of its tensors and texts."""
    names = metadata.get("names")
    texts = [metadata.get("name"), metadata.get("digest"), *(names if isinstance(names, list) else [None])]
    if set(tensors) != set(STORED) or not all(isinstance(text, str) for text in texts):
        raise InputError(f"{path} lacks tensors or texts of a map: make it again.")
    rows = {"n": len(tensors["points"]), "v": len(tensors["vertices"]), "f": len(tensors["faces"])}
    for key, (count, width, whole) in STORED.items():
        value = tensors[key]
        if value.shape != ((rows[count], width) if width else (rows[count],)):
            raise InputError(f"{path} has {key} of shape {tuple(value.shape)}: make it again.")
        if value.dtype not in ((torch.int64, torch.int32, torch.uint8) if whole else (torch.float32, torch.float64)):
            raise InputError(f"{path} has {key} of the type {value.dtype}: make it again.")
        if not whole and not bool(torch.isfinite(value).all()):
            raise InputError(f"{path} has {key} that are not finite: make it again.")
    check_triangles(path, tensors["vertices"].numpy(), tensors["faces"].numpy())
    labels = torch.cat([tensors["labels"], tensors["face_labels"]]).long()
    if not rows["n"] or int(labels.min()) < 0 or int(labels.max()) >= len(texts) - 2:
        raise InputError(f"{path} has no points, or labels without a name: make it again.")
