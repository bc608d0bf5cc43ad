"""A small object of two regions, for tests that write and damage folders."""

import numpy as np
import trimesh

from dora.affordance.objects.affordance_object import AffordanceObject, Piece, assemble
from dora.robot.shapes import Shape


def two_regions() -> AffordanceObject:
    """A box with a side and the rest."""
    mesh = trimesh.creation.box((0.05, 0.06, 0.07))
    labels = (mesh.face_normals[:, 0] > 0.9).astype(np.int64)
    box = Shape("box", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.025, 0.03, 0.035))
    return assemble("box", mesh, labels, {"body": "BodyGrasp", "side": "SideGrasp"}, "side", [(mesh, 0.2)],
                    [Piece("body", box), Piece("side", mesh)], solid=mesh)  # fmt: skip
