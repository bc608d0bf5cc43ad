"""Contact semantic maps of candidates from their poses, for those that do not carry any yet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from dora.affordance.bundled_sets import ROBOT, bundled_path, load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.maps.affordance_map import AffordanceMap
from dora.affordance.maps.confusion import Confusion
from dora.affordance.maps.contact_semantic_map import contact_semantic_map
from dora.affordance.maps.voting import vote_over_map
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import load_object
from dora.robot import load_robot

LOOKED_AT, ALIKE = 4, 0.5
"""Candidates whose stored maps are looked at, and the share of touched points that have to agree with maps made anew;
rounding on another processor moves a few, the points of another mesh agree in none [1]."""


def with_contact_maps(candidates: GraspCandidates, map: AffordanceMap, hand: HandModel) -> GraspCandidates:
    """The candidates, each with its contact semantic map over the points of `map`, made anew; the rest stays.

    The hand is that of the candidate: wrist pose and `joints`, its posture at contact.
    """
    c = candidates
    found = contact_semantic_map(map.points, c.position, c.quaternion, c.joints, hand)
    return replace(c, contact_map=found.byte().to(c.position.device))


def mapped(candidates: GraspCandidates, map: AffordanceMap, hand: HandModel) -> GraspCandidates:
    """The candidates with the maps that they carry, or new ones if those are not over the points of `map`.

    The points of a mesh depend on the order of its faces, so maps that were stored with another file of the same
    surface are over others, as many. What a few candidates touch tells.
    """
    if candidates.contact_map.shape[1] == len(map):
        some = candidates.select(torch.linspace(0, len(candidates) - 1, min(LOOKED_AT, len(candidates))).long())
        stored, anew = some.contact_map, with_contact_maps(some, map, hand).contact_map
        touched = (stored > 0) | (anew > 0)
        if (stored == anew)[touched].float().mean() >= ALIKE or not touched.any():
            return candidates
    return with_contact_maps(candidates, map, hand)


def class_agreement(candidates: GraspCandidates, obj: AffordanceObject, map: AffordanceMap) -> Confusion:
    """Votes over the contact semantic maps of candidates (columns) by the region of their grasp class (rows)."""
    known = [row for row, name in enumerate(candidates.grasp_class) if name in obj.classes]
    region = torch.tensor([obj.classes.index(candidates.grasp_class[row]) for row in known], dtype=torch.long)
    return Confusion.of(obj.labels, vote_over_map(map, candidates.contact_map)[known], region)


def map_bundled_set(name: str | Path) -> tuple[Path, Confusion]:
    """Store the bundled candidates of an object with contact semantic maps made anew; all else stays as it is.

    Args:
        name: of an object or its folder, as for `load_object`.

    Returns:
        The path of the file, and the votes over the maps by the grasp class.

    Raises:
        InputError: no such object, or no candidates.
    """
    obj, path = load_object(name), bundled_path(name)
    map = AffordanceMap.from_object(obj)
    found = with_contact_maps(load_candidates(name), map, HandModel(load_robot(ROBOT)))
    found.save(path)
    return path, class_agreement(found, obj, map)
