"""Every clause of every stage of the three tasks of one arm: a state that ends the stage, and what takes that away."""

from math import pi
from typing import Any

import pytest
import torch
from invented import TIP_RADIUS, extension, invented
from torch import Tensor

from dora.geometry.rotations import quaternion_apply, quaternion_from_rotation_vector
from dora.tasks import cube, jug
from dora.tasks.hammer import mdp as hammer
from dora.tasks.hammer.snapshot import HAND_CENTRE, HammerSnapshot
from dora.tasks.hammer.task import HammerConfig
from dora.tasks.mdp.snapshot import Snapshot

CUBE, JUG, HAMMER = cube.CubeConfig(), jug.JugConfig(), HammerConfig()
"""The tasks' own numbers."""
HANDLE, BODY = (0.08, 0.0, 0.0), (-0.06, 0.0, 0.0)
"""A point on the jug's handle and one on its body, jug frame [m]."""


def touching(*parts: int) -> Tensor:
    """Contacts of the named parts of the hand: thumb, four fingers, palm."""
    return torch.zeros(1, 6, dtype=torch.bool).index_fill_(1, torch.tensor(parts, dtype=torch.long), True)


def at(*place: float) -> Tensor:
    return torch.tensor([place])


def turned(*vector: float) -> Tensor:
    return quaternion_from_rotation_vector(torch.tensor([vector]))


def voted(point: tuple[float, float, float]) -> dict[str, Tensor]:
    """Contacts of thumb and index at a point of the jug."""
    return {"contact_p": torch.tensor([[point, point]]), "contact_finger": torch.tensor([[1, 2]])}


def is_done(stages: list[Any], name: str, state: Any) -> bool:
    """Whether a state ends the stage of this name."""
    return next(stage for stage in stages if stage.name == name).done(state).item()


# ------------------------------------------------------------------------- cube


def tips_above(height: float) -> Tensor:
    """All fingertips over the middle of the cube, their surfaces at this distance from its upper face."""
    return at(0.0, 0.0, 0.03 + TIP_RADIUS + height)[:, None].repeat(1, 5, 1)


LIFTED = {"object_p": at(0.0, 0.0, CUBE.lift + 1e-3), "touch": touching(0, 1)}
OF_THE_CUBE: dict[tuple[str, str], dict[str, Tensor]] = {
    ("reach", ""): {"tip_p": tips_above(CUBE.reach - 1e-3)},
    ("reach", "near"): {"tip_p": tips_above(CUBE.reach + 1e-3)},
    ("grasp", ""): {"touch": touching(0, 3)},
    ("grasp", "thumb"): {"touch": touching(1, 2, 3, 4)},
    ("grasp", "finger"): {"touch": touching(0, 5)},
    ("lift", ""): LIFTED,
    ("lift", "height"): LIFTED | {"object_p": at(0.0, 0.0, CUBE.lift - 1e-3)},
    ("lift", "opposed"): LIFTED | {"touch": touching(1, 2)},
    ("lift", "off the table"): LIFTED | {"supported": torch.tensor([True])},
}
"""States by stage and by the clause that they break."""


@pytest.mark.parametrize(("name", "clause"), OF_THE_CUBE)
def test_stages_of_the_cube_need_every_clause(name: str, clause: str):
    assert is_done(cube.stages(CUBE), name, invented(1, **OF_THE_CUBE[name, clause])) == (not clause)


# ------------------------------------------------------------------------- jug


def jug_state(**given: Tensor) -> Snapshot:
    return invented(1, object_half=torch.as_tensor(jug.jug().mesh.extents / 2, dtype=torch.float32)[None], **given)


def beside_handle(distance: float) -> Tensor:
    """All fingertips beyond the outermost point of the handle, their surfaces at this distance from it."""
    outermost = torch.as_tensor(jug.jug().mesh.vertices, dtype=torch.float32)
    point = outermost[outermost[:, 0].argmax()]
    return (point + torch.tensor([TIP_RADIUS + distance, 0.0, 0.0])).repeat(1, 5, 1)


RAISED = {"object_p": at(0.0, 0.0, JUG.lift + 1e-3), "touch": touching(0, 1), **voted(HANDLE)}
OF_THE_JUG: dict[tuple[str, str], dict[str, Tensor]] = {
    ("reach", ""): {"tip_p": beside_handle(JUG.reach - 5e-3)},
    ("reach", "near"): {"tip_p": beside_handle(JUG.reach + 5e-3)},
    ("grasp", ""): {"touch": touching(0, 1), **voted(HANDLE)},
    ("grasp", "opposed"): {"touch": touching(1, 2), **voted(HANDLE)},
    ("grasp", "class"): {"touch": touching(0, 1), **voted(BODY)},
    ("lift", ""): RAISED,
    ("lift", "height"): RAISED | {"object_p": at(0.0, 0.0, JUG.lift - 1e-3)},
    ("lift", "upright"): RAISED | {"object_q": turned(JUG.upright + 0.01, 0.0, 0.0)},
    ("lift", "opposed"): RAISED | {"touch": touching(1, 2)},
    ("lift", "off the table"): RAISED | {"supported": torch.tensor([True])},
    ("lift", "class"): RAISED | voted(BODY),
}


@pytest.mark.parametrize(("name", "clause"), OF_THE_JUG)
def test_stages_of_the_jug_need_every_clause(name: str, clause: str):
    assert is_done(jug.stages(JUG), name, jug_state(**OF_THE_JUG[name, clause])) == (not clause)


# ------------------------------------------------------------------------- hammer


def hammer_state(
    centre: float = 0.0, speed: float = 0.0, drift: tuple[float, float] = (0.0, 0.0), touch: Tensor | None = None,
    tilt: float = 0.0, face: tuple[float, float] = (0.0, 0.05), driven: float = 0.0, carried: float = 0.0,
) -> HammerSnapshot:  # fmt: skip
    """A held hammer over a nail.

    Args:
        centre: distance of the middle of the hand from the handle's axis [m].
        speed: of the hammer in the hand [m/s].
        drift: in the hand [m], [rad].
        touch: contacts; thumb and index if None.
        tilt: of the striking axis [rad].
        face: of the striking face beside and above the nail [m].
        driven: depth by blows [m].
        carried: speed of hand and hammer together [m/s].
    """
    q = quaternion_from_rotation_vector(torch.tensor([[0.0, pi / 2 + tilt, 0.0]]))
    point = torch.tensor([[0.04, 0.0, 0.04]])
    p = at(face[0], 0.0, face[1]) - quaternion_apply(q, point)
    side = quaternion_apply(q, at(0.0, centre, -0.05))
    wrist = p + side - torch.tensor([HAND_CENTRE])
    fixed = {
        "nail_p": torch.zeros(1, 3), "nail_depth": torch.zeros(1), "nail_driven": torch.tensor([driven]),
        "drift_p": torch.tensor([drift[0]]), "drift_r": torch.tensor([drift[1]]), "turned": torch.zeros(1),
        "way": torch.ones(1), "face": point,
        "butt": at(0.0, 0.0, -0.2), "neck": torch.zeros(1, 3), "object_p": p, "object_q": q, "wrist_p": wrist,
        "wrist_v": at(carried, 0.0, 0.0), "object_v": at(carried + speed, 0.0, 0.0),
        "touch": touching(0, 1) if touch is None else touch,
    }  # fmt: skip
    return extension(HammerSnapshot, 1, **fixed)


LOW, HIGH = HAMMER.height
OF_THE_HAMMER: dict[tuple[str, str], dict[str, Any]] = {
    ("catch", ""): {"centre": HAMMER.in_hand - 1e-3, "speed": HAMMER.caught_speed - 0.01, "carried": 2.0},
    ("catch", "place"): {"centre": HAMMER.in_hand + 1e-3},
    ("catch", "fingers"): {"touch": touching(1, 5)},
    ("catch", "at rest in the hand"): {"speed": HAMMER.caught_speed + 0.01},
    ("stabilise", ""): {"drift": (HAMMER.still[0] - 1e-3, HAMMER.still[1] - 0.01)},
    ("stabilise", "place"): {"centre": HAMMER.in_hand + 1e-3},
    ("stabilise", "fingers"): {"touch": touching(1, 5)},
    ("stabilise", "shift"): {"drift": (HAMMER.still[0] + 1e-3, 0.0)},
    ("stabilise", "turn"): {"drift": (0.0, HAMMER.still[1] + 0.01)},
    ("orient", ""): {"tilt": HAMMER.aligned - 0.01, "face": (HAMMER.beside - 1e-3, HIGH - 1e-3)},
    ("orient", "place"): {"centre": HAMMER.in_hand + 1e-3},
    ("orient", "fingers"): {"touch": touching(1, 5)},
    ("orient", "angle"): {"tilt": HAMMER.aligned + 0.01},
    ("orient", "beside the nail"): {"face": (HAMMER.beside + 1e-3, 0.05)},
    ("orient", "above the nail"): {"face": (0.0, LOW - 1e-3)},
    ("orient", "near the nail"): {"face": (0.0, HIGH + 1e-3)},
    ("strike", ""): {"driven": HAMMER.nail.driven + 1e-4},
    ("strike", "depth"): {"driven": HAMMER.nail.driven - 1e-4},
}


@pytest.mark.parametrize(("name", "clause"), OF_THE_HAMMER)
def test_stages_of_the_hammer_need_every_clause(name: str, clause: str):
    assert is_done(hammer.stages(HAMMER), name, hammer_state(**OF_THE_HAMMER[name, clause])) == (not clause)


@pytest.mark.parametrize("name", ["stabilise", "orient", "strike"])
@pytest.mark.parametrize("beyond", [-1e-3, 1e-3])
def test_a_hammer_that_is_lost_has_to_be_caught_again(name: str, beyond: float):
    stage = next(stage for stage in hammer.stages(HAMMER) if stage.name == name)
    assert stage.lost is not None
    assert stage.lost(hammer_state(centre=HAMMER.lost + beyond)).tolist() == [beyond > 0]
    assert stage.back_to == "catch"


@pytest.mark.parametrize(
    ("stages", "name", "state", "back"),
    [
        (cube.stages(CUBE), "grasp", lambda d: invented(1, tip_p=tips_above(CUBE.lost + d)), "reach"),
        (cube.stages(CUBE), "lift", lambda d: invented(1, tip_p=tips_above(CUBE.lost + d)), "reach"),
        (jug.stages(JUG), "grasp", lambda d: jug_state(tip_p=beside_handle(JUG.lost + d)), "reach"),
        (jug.stages(JUG), "lift", lambda d: jug_state(tip_p=beside_handle(JUG.let_go + d)), "reach"),
    ],
)
def test_what_is_let_go_has_to_be_reached_again(stages: list[Any], name: str, state: Any, back: str):
    stage = next(stage for stage in stages if stage.name == name)
    assert [stage.lost(state(beyond)).item() for beyond in (-5e-3, 5e-3)] == [False, True]
    assert stage.back_to == back
