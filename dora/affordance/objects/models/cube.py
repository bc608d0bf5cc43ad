"""A cube to be held anywhere."""

import numpy as np
import trimesh

from dora.affordance.objects.affordance_object import AffordanceObject, Piece, assemble
from dora.robot.shapes import Shape

EDGE = 0.06
MASS = 0.12
FRICTION = 0.9


def build() -> AffordanceObject:
    """The cube, faces along the axes."""
    mesh = trimesh.creation.box((EDGE,) * 3)
    for _ in range(3):
        mesh = mesh.subdivide()
    box = Shape("box", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (EDGE / 2,) * 3)
    return assemble(
        "cube",
        mesh,
        np.zeros(len(mesh.faces), np.int64),
        {"body": "BodyGrasp"},
        target="body",
        weights=[(mesh, MASS)],
        pieces=[Piece("body", box)],
        friction=FRICTION,
    )
