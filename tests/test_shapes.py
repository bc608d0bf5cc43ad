"""Shapes made in memory, and mass and friction of bodies by environment."""

from collections.abc import Iterator

import numpy as np
import pytest
import sapien
import trimesh

import dora.tasks as tasks
from dora.robot.shapes import Shape
from dora.sim.properties import ObjectProperties
from dora.sim.shapes import collision_shape
from dora.tasks.env.table import TABLE_HEIGHT, TableTop, room_shapes, table_shapes

TURNED = (0.5, 0.5, 0.5, 0.5)
"""A quaternion."""


@pytest.mark.parametrize(
    ("kind", "size", "read"),
    [
        ("box", (0.1, 0.2, 0.3), lambda made: tuple(made.half_size)),
        ("sphere", (0.1,), lambda made: (made.radius,)),
        ("cylinder", (0.1, 0.3), lambda made: (made.radius, made.half_length)),
        ("capsule", (0.1, 0.3), lambda made: (made.radius, made.half_length)),
    ],
)
def test_primitives_have_their_sizes_and_places_times_the_scale(kind, size, read):
    made = collision_shape(Shape(kind, (1.0, 2.0, 3.0), TURNED, size), sapien.physx.PhysxMaterial(0.5, 0.4, 0.0), 2.0)
    np.testing.assert_allclose(read(made), 2 * np.array(size), rtol=1e-6)
    np.testing.assert_allclose(made.local_pose.p, (2.0, 4.0, 6.0))
    np.testing.assert_allclose(made.local_pose.q, TURNED)
    assert made.physical_material.static_friction == pytest.approx(0.5)


def test_meshes_become_convex_and_are_scaled():
    mesh = trimesh.creation.box((0.2, 0.4, 0.6))
    made = collision_shape(mesh, sapien.physx.PhysxMaterial(0.5, 0.5, 0.0), 0.5)
    assert isinstance(made, sapien.physx.PhysxCollisionShapeConvexMesh)
    np.testing.assert_allclose(made.vertices.max(0), (0.05, 0.1, 0.15), rtol=1e-6)
    np.testing.assert_allclose(made.vertices.min(0), (-0.05, -0.1, -0.15), rtol=1e-6)


@pytest.fixture(scope="module")
def task() -> Iterator[tasks.DoraEnv]:
    made = tasks.make_task("DoraCube-v1", 3, preset="none")
    yield made
    made.close()


def test_mass_inertia_and_friction_are_set_in_the_rows_that_are_named(task: tasks.DoraEnv):
    properties = ObjectProperties(task.target_object)
    inertia = [np.array(body.inertia) for body in properties.bodies]
    m = properties.nominal
    properties.apply([2, 0], [2 * m[2], 0.5 * m[0]], [0.3, 0.9])
    for row, share in ((0, 0.5), (1, 1.0), (2, 2.0)):
        body = properties.bodies[row]
        assert body.mass == pytest.approx(share * m[row])
        np.testing.assert_allclose(body.inertia, share * inertia[row], rtol=1e-5)
    for row, friction in ((0, 0.9), (2, 0.3)):
        for shape in properties.bodies[row].get_collision_shapes():
            assert shape.physical_material.static_friction == pytest.approx(friction)
            assert shape.physical_material.dynamic_friction == pytest.approx(friction)
    properties.apply([2, 0], [m[2], m[0]], [0.6, 0.6])
    np.testing.assert_allclose([body.mass for body in properties.bodies], m, rtol=1e-6)
    np.testing.assert_allclose(properties.bodies[2].inertia, inertia[2], rtol=1e-5)


def test_the_drawn_table_stands_on_the_floor_and_its_legs_are_under_the_top():
    top = TableTop((0.45, 0.1), (0.8, 0.75, 0.02))
    board, *legs = (drawn.shape for drawn in table_shapes(top))
    assert board.position == (0.45, 0.1, -0.02)
    assert board.size == top.half
    assert len({leg.position[:2] for leg in legs}) == 4
    for leg in legs:
        assert leg.position[2] + leg.size[2] == pytest.approx(-2 * top.half[2])
        assert leg.position[2] - leg.size[2] == pytest.approx(-TABLE_HEIGHT)
        for k in range(2):
            assert abs(leg.position[k] - top.centre[k]) + leg.size[k] < top.half[k]
    floor, *walls = (drawn.shape for drawn in room_shapes(top))
    assert floor.position[2] + floor.size[2] == pytest.approx(-TABLE_HEIGHT)
    for wall in walls:
        assert wall.position[2] - wall.size[2] == pytest.approx(-TABLE_HEIGHT)
        away = np.abs(np.array(wall.position[:2]) - top.centre)
        assert sorted(away) == pytest.approx([0.0, floor.size[0]])
        assert wall.size[int(away.argmax())] < wall.size[int(away.argmin())]
