"""The furniture every task shares."""

from dataclasses import dataclass

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.structs import Actor, Pose

from dora.sim.shapes import DrawnShape, draw, drawn_box

TABLE_HEIGHT = 0.74
"""Height of the table top above the floor [m]."""
LEG_HALF = 0.03
"""Half width of a table leg [m]."""
WOOD, STEEL = (0.55, 0.42, 0.30, 1.0), (0.25, 0.26, 0.28, 1.0)
"""Colours of the table top and the legs: red, green, blue and opacity [1]."""
FLOOR, WALL = (0.75, 0.76, 0.78, 1.0), (0.86, 0.88, 0.90, 1.0)
"""Colours of the room [1]."""
ROOM_HALF = 3.0
"""Half width of the room that is only drawn [m]."""


@dataclass(frozen=True)
class TableTop:
    """The table top, on which the robots stand.

    Attributes:
        centre: in the world frame [m].
        half: half extents [m]; the upper face is z = 0.
    """

    centre: tuple[float, float] = (0.35, 0.0)
    half: tuple[float, float, float] = (0.65, 0.6, 0.02)


def table_shapes(top: TableTop) -> tuple[DrawnShape, ...]:
    """The table top and its legs, in the frame in which the upper face is z = 0."""
    (x, y), half = top.centre, TABLE_HEIGHT / 2 - top.half[2]
    legs = [
        drawn_box(
            (
                x + sx * (top.half[0] - 2 * LEG_HALF),
                y + sy * (top.half[1] - 2 * LEG_HALF),
                -2 * top.half[2] - half,
            ),
            (LEG_HALF, LEG_HALF, half),
            STEEL,
        )
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return (drawn_box((x, y, -top.half[2]), top.half, WOOD), *legs)


def room_shapes(top: TableTop) -> tuple[DrawnShape, ...]:
    """Floor and walls around the table."""
    x, y = top.centre
    floor = drawn_box((x, y, -TABLE_HEIGHT - 0.01), (ROOM_HALF, ROOM_HALF, 0.01), FLOOR)
    walls = [
        drawn_box(
            (x + sx * ROOM_HALF, y + sy * ROOM_HALF, ROOM_HALF - TABLE_HEIGHT),
            (0.01 if sx else ROOM_HALF, 0.01 if sy else ROOM_HALF, ROOM_HALF),
            WALL,
        )
        for sx, sy in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    return (floor, *walls)


def add_table(scene: ManiSkillScene, top: TableTop) -> Actor:
    """A static table whose upper face is z = 0, with legs and a room that are only drawn."""
    x, y = top.centre
    builder = scene.create_actor_builder()
    builder.add_box_collision(sapien.Pose([x, y, -top.half[2]]), top.half)
    if scene.can_render():
        draw(builder, (*table_shapes(top), *room_shapes(top)), roughness=0.7, specular=0.3)
    builder.initial_pose = Pose.create(sapien.Pose())
    return builder.build_static("table")
