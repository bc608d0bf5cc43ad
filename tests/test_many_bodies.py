"""Meshes of many bodies: dropped, in each other, and running into each other."""

import numpy as np
import pytest
import trimesh
from test_unruly_meshes import at, cube, mended, scaled, scrap, without

from dora.affordance.objects.signed_distance import ExactDistance
from dora.errors import InputError


def beads(count: int, edge: float = 0.01, copies: int = 1) -> list[trimesh.Trimesh]:
    """Cubes apart from each other in rows of ten, each with smaller ones inside."""
    own = trimesh.creation.box((edge,) * 3)
    places = [(0.1 + 0.05 * (i % 10), 0.05 * (i // 10)) for i in range(count)]
    return [at(scaled(own, 0.97**k), x, y, 0) for x, y in places for k in range(copies)]


@pytest.mark.parametrize(
    ("meshes", "words"),
    [
        (beads(110), "falls into 0 bodies and 110 loose scraps, which are 100% of its surface: join them"),
        (beads(101, copies=2), "falls into 0 bodies and 101 loose scraps, which are 100% of its surface"),
        ([cube(), *beads(99, 0.006)], "falls into 1 bodies and 99 loose scraps, which are 59% of its surface"),
        (
            [cube(), *beads(25, 0.005), at(scrap(0.025), 0, 0.1, 0)],
            "falls into 1 bodies and 26 loose scraps, which are 23%",
        ),
    ],
    ids=["equal", "equal with bodies inside", "beside a large one", "and an open one"],
)
def test_bodies_that_touch_nothing_are_not_dropped_if_they_are_most(meshes: list[trimesh.Trimesh], words: str):
    with pytest.raises(InputError, match=words):
        mended(*meshes)


def leaning(number: int) -> trimesh.Trimesh:
    """An open box, turned, so that many of them have boxes that overlap and lie in none of each other."""
    turn = trimesh.transformations.rotation_matrix(0.005 * number, [0.3, 0.5, 1.0])
    return trimesh.creation.box((0.1, 0.03, 0.01)).apply_transform(turn)


def test_open_bodies_are_compared_all_at_once(monkeypatch: pytest.MonkeyPatch):
    """Few searches of distances, which take long for many pairs of bodies."""
    made, own = [], ExactDistance.__init__
    monkeypatch.setattr(ExactDistance, "__init__", lambda self, mesh: (made.append(mesh), own(self, mesh))[1])
    cubes = [at(scaled(cube(), 1 - 0.002 * (i % 2)), 0.0002 * i, 0, 0) for i in range(50)]
    assert mended(*(without(each, np.arange(12) < 2) for each in cubes)).mesh.is_watertight
    assert len(made) <= 4 * len(cubes)


def test_too_many_bodies_that_run_into_each_other_are_refused():
    with pytest.raises(InputError, match=r"has 210 bodies, 21945 pairs of which overlap or may do so, and may have 20"):
        mended(*(leaning(i) for i in range(210)))
