"""An object's surface, subdivided finely enough to carry the colours of regions and of contact semantic maps."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from jaxtyping import Int, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from dora.affordance.hand.link_meshes import GAMMA
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.palette import PALETTE, colours
from dora.affordance.search.cache import map_of
from dora.affordance.views.pictures import PARTS

EDGE, SHARE = 0.004, 1 / 30
"""Longest edge of the triangles that carry colours, in metres [m] and in largest extents of the object [1]."""
MOST_CUTS = 12
"""Largest number of times that a triangle is subdivided."""
NEIGHBOURS, BLUR = 8, 0.7
"""Points of a map that a face looks at, and the distance, in spacings of the points, at which one weighs 1/e [1]."""


class Surface:
    """The object's mesh, subdivided into triangles with edges of at most `EDGE` and `SHARE`, each with a colour.

    For a contact semantic map a face shows the class with the largest weight among the nearest points of the affordance
    map on its side of a wall, so that spots have smooth edges. With `finer` edges are shorter by that factor [1].
    """

    def __init__(self, obj: AffordanceObject, finer: float = 1.0) -> None:
        edge = min(EDGE, SHARE * float(obj.mesh.extents.max())) / finer
        vertices, faces, *origin = trimesh.remesh.subdivide_to_size(
            obj.mesh.vertices, obj.mesh.faces, edge, MOST_CUTS, return_index=True
        )
        self.mesh = trimesh.Trimesh(vertices, faces, process=False)
        self.labels = obj.face_labels[origin[0]]
        self.map = map_of(obj, "cpu")
        wide = self.map.spacing
        tree = KDTree(torch.cat([self.map.points, wide * self.map.normals], 1).numpy())
        faces = np.concatenate([self.mesh.triangles_center, wide * self.mesh.face_normals], 1)
        distance, self.nearest = tree.query(faces, k=min(NEIGHBOURS, len(self.map)))
        self.weight = np.exp(-((distance / (BLUR * wide)) ** 2))

    def regions(self) -> UInt8[np.ndarray, "f 4"]:
        """Face colours of the affordance map."""
        return colours(self.labels, PALETTE)

    def contacts(self, contact_map: UInt8[Tensor, " p"]) -> UInt8[np.ndarray, "f 4"]:
        """Face colours of a contact semantic map over the points of the object's affordance map."""
        return colours(self.parts(contact_map), tuple(PARTS.values()))

    def parts(self, contact_map: UInt8[Tensor, " p"]) -> Int[np.ndarray, " f"]:
        """For each face the part of the hand by a contact semantic map, an index into `PARTS`."""
        near = contact_map.numpy()[self.nearest]
        classes = np.unique(near).astype(np.int64)
        return classes[np.argmax([(self.weight * (near == part)).sum(1) for part in classes], axis=0)]

    def painted(self, face_colours: UInt8[np.ndarray, "f 4"]) -> trimesh.Trimesh:
        """The mesh in these face colours, with separate vertices for each face."""
        return unshared(self.mesh, face_colours)


def unshared(mesh: trimesh.Trimesh, face_colours: np.ndarray) -> trimesh.Trimesh:
    """A mesh with separate vertices for each face, so that glTF keeps the edges between colours, which are linear."""
    linear = (255 * (face_colours[:, :3] / 255) ** GAMMA).round()
    corners = mesh.triangles.reshape(-1, 3)
    normals = mesh.vertex_normals[mesh.faces].reshape(-1, 3)
    return trimesh.Trimesh(
        corners,
        np.arange(len(corners)).reshape(-1, 3),
        vertex_normals=normals,
        vertex_colors=np.repeat(linear.astype(np.uint8), 3, axis=0),
        process=False,
    )
