"""What a search needs and what takes long to make; kept within a process, for the objects and robots used last."""

from __future__ import annotations

from functools import lru_cache

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search.initial_poses import InitialPoses, Spread
from dora.robot import RobotDescription

KEPT = 4
"""Results kept of each kind; a field may take tens of megabytes. Objects and robots are told apart by identity."""


@lru_cache(KEPT)
def hand_of(robot: RobotDescription, device: str) -> HandModel:
    """The hand of a robot on a torch device."""
    return HandModel(robot, device=device)


@lru_cache(KEPT)
def field_of(obj: AffordanceObject, region: str | None, device: str) -> SignedDistanceField:
    """The distance field of an object on a torch device, with the distance to a region if there is one."""
    return SignedDistanceField(obj.solid, None if region is None else obj.region(region), device=device)


@lru_cache(KEPT)
def initial_of(
    obj: AffordanceObject, robot: RobotDescription, region: str | None, spread: Spread, device: str
) -> InitialPoses:
    """Initial poses of a robot's hand before a region of an object."""
    return InitialPoses(obj, hand_of(robot, device), region, spread)


@lru_cache(KEPT)
def map_of(obj: AffordanceObject, device: str) -> AffordanceMap:
    """The affordance map of an object on a torch device."""
    return AffordanceMap.from_object(obj).to(device)


def forget() -> None:
    """Drop everything that is kept."""
    for kept in (hand_of, field_of, initial_of, map_of):
        kept.cache_clear()
