"""Mass and friction of one actor, set per environment."""

from collections.abc import Sequence

import numpy as np
from mani_skill.utils.structs import Actor, Link
from sapien.physx import get_default_material


class ObjectProperties:
    """Sets masses (with inertia in proportion) and friction of one body per environment.

    Args:
        actor: the actor, or a link of an articulation; each of its shapes needs a material of its own.

    Attributes:
        nominal: masses as built, one per environment [kg].

    Raises:
        ValueError: shapes share a material.
    """

    def __init__(self, actor: Actor | Link):
        self.bodies = actor._bodies
        self.nominal = [float(b.mass) for b in self.bodies]
        self._inertia = [np.array(b.inertia) for b in self.bodies]
        self._materials = [[s.physical_material for s in b.get_collision_shapes()] for b in self.bodies]
        owned = [m for materials in self._materials for m in materials]
        if len(set(map(id, owned))) < len(owned) or get_default_material() in owned:
            raise ValueError(f"the shapes of {actor.name} share a material: friction would change everywhere")

    def apply(self, rows: Sequence[int], mass: Sequence[float], friction: Sequence[float]) -> None:
        """Sets the bodies of the environments `rows`; `mass` [kg] and `friction` [1] have one value per row."""
        for row, m, f in zip(rows, mass, friction, strict=True):
            body = self.bodies[row]
            body.set_mass(m)
            body.set_inertia((self._inertia[row] * (m / self.nominal[row])).tolist())
            for material in self._materials[row]:
                material.static_friction = f
                material.dynamic_friction = f
