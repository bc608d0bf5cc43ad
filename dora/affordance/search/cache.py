"""Hands, distance fields, initial poses and affordance maps that a process keeps for the objects used last."""

from __future__ import annotations

from functools import lru_cache

from dora.affordance.hand.chain_hand import ChainHand
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search.initial_poses import InitialPoses, Spread
from dora.robot import RobotDescription

CACHE_SIZE = 4
"""Number of results kept of each kind; a field may take tens of megabytes. Objects are compared by identity."""


@lru_cache(CACHE_SIZE)
def hand_of(robot: RobotDescription, device: str) -> HandModel:
    """The hand of a robot on a torch device."""
    return HandModel(robot, device=device)


@lru_cache(CACHE_SIZE)
def chain_hand_of(robot: RobotDescription, device: str) -> ChainHand:
    """The hand of a robot on a torch device, with kinematics of pytorch_kinematics."""
    return ChainHand(robot, device=device)


@lru_cache(CACHE_SIZE)
def field_of(obj: AffordanceObject, region: str | None, device: str) -> SignedDistanceField:
    """The distance field of an object on a torch device, with a channel for the distance to `region` unless None.

    Raises:
        InputError: the object has no such region, or is too large for the grid.
    """
    return SignedDistanceField(obj.solid, None if region is None else obj.region(region), device=device)


@lru_cache(CACHE_SIZE)
def initial_of(
    obj: AffordanceObject, robot: RobotDescription, region: str | None, spread: Spread, device: str
) -> InitialPoses:
    """Initial poses of a robot's hand in front of a region of an object, or all around it if `region` is None."""
    return InitialPoses(obj, hand_of(robot, device), region, spread)


@lru_cache(CACHE_SIZE)
def map_of(obj: AffordanceObject, device: str) -> AffordanceMap:
    """The affordance map of an object on a torch device."""
    return AffordanceMap.from_object(obj).to(device)


def forget() -> None:
    """Empty the cache."""
    for kept in (hand_of, chain_hand_of, field_of, initial_of, map_of):
        kept.cache_clear()
