"""The paper's voting: the region of an object that a hand holds, from its contacts and the affordance map."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dora.affordance.maps.affordance_map import AffordanceMap
from dora.errors import InputError

HAND_PARTS = 6
"""Number of parts of a hand that vote: palm and up to five fingers, contact classes 1 to 6; class 0 is no contact."""
NO_CONTACT = -1
"""Result of a vote without any contact."""


@dataclass(frozen=True)
class VotingSettings:
    """Settings of the vote.

    Attributes:
        neighbours: N, number of labels looked up per contact.
        weights: w_f of palm, thumb, index, middle, ring and pinky [1].

    Raises:
        InputError: `neighbours` is below 1, or there are not six positive weights.
    """

    neighbours: int = 8
    weights: tuple[float, ...] = (1.0, 2.0, 1.0, 1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if self.neighbours < 1:
            raise InputError(f"a vote needs at least 1 neighbour per contact, not {self.neighbours}.")
        if len(self.weights) != HAND_PARTS or not all(weight > 0 for weight in self.weights):
            raise InputError(f"a vote needs {HAND_PARTS} positive weights: palm, thumb and the other fingers.")


STANDARD = VotingSettings()
"""The settings behind every number in the docs."""


def vote(
    map: AffordanceMap,
    contacts: Float[Tensor, "b k 3"],
    finger: Int[Tensor, "b k"],
    settings: VotingSettings = STANDARD,
) -> Int[Tensor, " b"]:
    """Index into `map.names` of the region that is held; -1 where there is no contact.

    The paper's equations, with M = 6 parts of the hand (the palm counts as one):

    1. N(p_i) = the labels of the N points of the map nearest to contact p_i;
    2. A_f = mode of the union (with multiplicity) of N(p_i) over the contacts of part f;
    3. A = argmax_a sum_f w_f [A_f = a].

    Parts without contact do not vote. The paper leaves ties open: among labels that are equally frequent at one part,
    and among labels with equal sums of weights, the label wins that is more frequent among the neighbours of all
    contacts together; if that is equal too, the label that the map names first.

    Args:
        map: affordance map of the object.
        contacts: (b, k, 3) contact points in the object frame [m].
        finger: (b, k) contact class of every point: 0 none (its point is ignored), 1 palm, 2 thumb ... 6 pinky.
        settings: N and the weights.
    """
    labels = len(map.names)
    touching = (finger > 0) & (finger <= HAND_PARTS)
    where = torch.where(touching.unsqueeze(-1), contacts, map.points[0].to(contacts))
    _, near = map.nearest(where, settings.neighbours)
    cell = (finger.clamp(0, HAND_PARTS) * labels).unsqueeze(-1) + near
    counts = contacts.new_zeros(len(contacts), (HAND_PARTS + 1) * labels)
    counts.scatter_add_(1, cell.flatten(1), torch.ones_like(cell, dtype=counts.dtype).flatten(1))
    return _decided(counts.unflatten(1, (HAND_PARTS + 1, labels))[:, 1:], settings)


def vote_over_map(
    map: AffordanceMap, contact_map: UInt8[Tensor, "b p"], settings: VotingSettings = STANDARD
) -> Int[Tensor, " b"]:
    """The vote as the paper prints it: the contacts p_i are all points of M_Aff that M_CoS gives to a part of the hand.

    Equations, ties and result are those of `vote`. A point's own label is the first of its N neighbours; a part that is
    near many points has many contacts, but as many votes as any other.

    Args:
        map: affordance map M_Aff of the object, with p points.
        contact_map: (b, p) contact semantic maps M_CoS over the same points: 0 no contact, 1 palm, 2 thumb ... 6 pinky.
        settings: N and the weights.

    Raises:
        InputError: the contact maps are over another number of points.
    """
    if contact_map.shape[1] != len(map):
        raise InputError(
            f"the contact maps have {contact_map.shape[1]} points and the affordance map of {map.name} {len(map)}: "
            "make them anew with `dora grasps --contact-maps`."
        )
    _, near = map.nearest(map.points, settings.neighbours)
    around = torch.nn.functional.one_hot(near, len(map.names)).sum(1).to(map.points)
    counts = [(contact_map == part).to(around) @ around for part in range(1, HAND_PARTS + 1)]
    return _decided(torch.stack(counts, 1), settings)


def _decided(counts: Float[Tensor, "b parts labels"], settings: VotingSettings) -> Int[Tensor, " b"]:
    """Mode of every part, and the region with the largest sum of weights, from how often each part is near a label."""
    overall = counts.sum(1, keepdim=True)
    preference = overall / (overall.sum(-1, keepdim=True) + 1)
    choice = (counts + preference * (counts > 0)).argmax(-1)
    voting = counts.sum(-1) > 0
    weights = torch.where(voting, counts.new_tensor(settings.weights), 0.0)
    sums = counts.new_zeros(len(counts), counts.shape[2]).scatter_add_(1, choice, weights)
    smallest = min(settings.weights)
    winner = (sums + preference.squeeze(1) * _TIE * smallest).argmax(-1)
    return torch.where(voting.any(-1), winner, NO_CONTACT)


_TIE = 1e-3
"""Share of the smallest weight by which all neighbours together can change a sum, so that they decide ties only [1]."""
