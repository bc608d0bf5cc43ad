"""From an object to grasp candidates: the search, then what is measured and told about every candidate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.candidates import GraspCandidates, hand_digest
from dora.affordance.compiled import CompiledEnergy
from dora.affordance.contact_map import hand_contacts
from dora.affordance.energies import GraspEnergy, Table
from dora.affordance.hand import HandModel
from dora.affordance.holding import Steps, hold
from dora.affordance.initial import InitialPoses
from dora.affordance.map import AffordanceMap
from dora.affordance.measures import Penetration, self_penetration
from dora.affordance.protocol import STANDARD, pregrasp, squeeze
from dora.affordance.search import Rows, Search, Settings
from dora.affordance.signed_distance import SignedDistanceField
from dora.affordance.structure import AffordanceObject
from dora.affordance.voting import NO_CONTACT, vote
from dora.errors import InputError
from dora.robot import RobotDescription
from dora.robot.rotations import matrix_from_quaternion, quaternion_from_matrix

__all__ = ["Settings", "optimise"]

Progress = Callable[[int, int], None]
"""Called with the candidate-iterations done and their total."""
OFF_TABLE = ("hammer", "microwave")
"""Objects that their tasks do not take from a table: one is caught in the air, the other is a door's handle."""
OPENINGS = (0.25, 0.5, 0.75, 1.0)
"""Shares of the protocol's opening that are tried."""
OPENING_DEPTH = 1e-3
"""Overlap (m) with the object up to which a finger counts as clear of it."""
SEATING = Steps(closing=60, settling=20, weight=0)
"""Steps of the hand that closes around the object."""
NO_CLASS = "NoContact"
"""Grasp class of a candidate without contact."""


def optimise(
    obj: AffordanceObject,
    robot: RobotDescription,
    num: int,
    seed: int,
    region: str | None = None,
    settings: Settings | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> GraspCandidates:
    """Search for grasps of an object.

    Args:
        obj: object.
        robot: whose hand it is.
        num: candidates wanted.
        seed: of all random draws; equal seeds give equal candidates.
        region: label to be held; None leaves it open.
        settings: of the search.
        device: torch device of the search and of the result.
        progress: called with candidate-iterations done and their total.

    Returns:
        `num` candidates in the object frame, best first. `valid` tells which stay below the protocol's limit
        of penetration at the candidate; whether a grasp holds is for a simulation to say.

    Raises:
        InputError: `num` is less than 1, the object has no such region, or it is too large for a hand.
    """
    settings = settings or Settings()
    if num < 1:
        raise InputError(f"the search makes at least 1 candidate, not {num}.")
    hand = HandModel(robot, device=device)
    field = SignedDistanceField(obj.solid, None if region is None else obj.region(region), device=device)
    on_table = obj.name not in OFF_TABLE if settings.table is None else settings.table
    kind = CompiledEnergy if hand.device.type == "cpu" else GraspEnergy
    energy = kind(hand, field, settings.weights, table_of(obj) if on_table else None)
    search = Search(energy, InitialPoses(obj, hand, region, settings.spread), settings)
    wanted = math.ceil(num * settings.oversampling)
    sizes = [min(settings.batch, wanted - start) for start in range(0, wanted, settings.batch)]
    done, total = 0, wanted * settings.iterations

    def report(rows: int) -> None:
        nonlocal done
        done += rows
        if progress is not None:
            progress(done, total)

    found = [
        _seated(
            energy,
            search,
            search.run(size, torch.Generator().manual_seed(batch_seed(seed, index)), report),
            obj.mass,
            settings,
        )
        for index, size in enumerate(sizes)
    ]
    return _candidates(obj, energy, Rows.join(found), num, settings)


def batch_seed(seed: int, index: int) -> int:
    """Seed of one batch of a search."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])


def table_of(obj: AffordanceObject) -> Table:
    """The table under an object at rest, in the object frame."""
    up = matrix_from_quaternion(torch.tensor(obj.rest, dtype=torch.float64))[2].tolist()
    return Table((up[0], up[1], up[2]), obj.support)


def _candidates(
    obj: AffordanceObject, energy: GraspEnergy, rows: Rows, num: int, settings: Settings
) -> GraspCandidates:
    """The `num` best rows, measured and classified."""
    hand, robot = energy.hand, energy.hand.robot
    found = energy(rows.wrist, rows.joints, rows.contacts, settings.ramp)
    poses = hand.forward(rows.wrist, rows.joints)
    depth, self_depth = Penetration(hand, energy.field)(poses), self_penetration(energy, poses)
    faults = 2 * (depth > STANDARD.penetration).long() + (self_depth > STANDARD.strict_self_penetration).long()
    quality, predicted = _quality(obj, energy, rows, found.total, faults.argsort(stable=True)[: _judged(faults, num)])
    order = quality.argsort(descending=True)
    best = order[faults[order].argsort(stable=True)][:num]
    poses, joints, wrist = poses[best], rows.joints[best], rows.wrist[best]
    points, finger = hand_contacts(hand, energy.field, poses)
    held = vote(AffordanceMap.from_object(obj).to(points.device), points, finger)
    full = robot.expand_hand(joints)
    normal = full.new_tensor(hand.grip.normal)
    return GraspCandidates(
        object=obj.name,
        position=wrist[:, :3, 3].contiguous(),
        quaternion=quaternion_from_matrix(wrist[:, :3, :3]),
        approach=wrist[:, :3, :3] @ normal,
        pregrasp=opened(energy, wrist, full),
        grasp=squeeze(robot, full),
        grasp_class=tuple(NO_CLASS if label == NO_CONTACT else obj.classes[label] for label in held.tolist()),
        joints=full,
        contacts=points,
        contact_finger=finger,
        energy={name: value[best] for name, value in (found.terms | predicted).items()},
        penetration=depth[best],
        self_penetration=self_depth[best],
        valid=depth[best] <= STANDARD.penetration,
        digest=obj.digest,
        robot=robot.name,
        robot_digest=hand_digest(robot),
        settings=repr(settings),
    )


def _judged(faults: Tensor, num: int) -> int:
    """How many rows are worth judging: all without fault, but at least as many as are wanted."""
    return max(num, int((faults == 0).sum()))


def _quality(
    obj: AffordanceObject, energy: GraspEnergy, rows: Rows, total: Tensor, judged: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    """What candidates are ranked by (c,), more is better, and the predictions it is made of, for the rows judged."""
    if not isinstance(energy, CompiledEnergy):
        return -total, {}
    robot = energy.hand.robot
    full = robot.expand_hand(rows.joints[judged])
    held = hold(energy, rows.wrist[judged], pregrasp(robot, full), squeeze(robot, full), obj.mass)

    def spread(values: Tensor, missing: float) -> Tensor:
        return torch.full_like(total, missing).index_copy_(0, judged, values)

    predictions = {
        "predicted_shift": spread(held.shift, math.nan),
        "predicted_displacement": spread(held.displacement[:, -1], math.nan),
        "predicted_force": spread(held.force, math.nan),
    }
    return spread(held.quality, -math.inf), predictions


def _seated(energy: GraspEnergy, search: Search, rows: Rows, mass: float, settings: Settings) -> Rows:
    """Rows after their hands have closed around the object, overlaps removed; what a squeeze then adds is force."""
    if not settings.seat or not isinstance(energy, CompiledEnergy):
        return rows
    robot = energy.hand.robot
    full = robot.expand_hand(rows.joints)
    closed = squeeze(robot, full, replace(STANDARD, squeeze=settings.seat))
    held = hold(energy, rows.wrist, pregrasp(robot, full), closed, mass, steps=SEATING, on_table=True)
    rows.wrist, rows.joints = held.wrist.contiguous(), robot.reduce_hand(held.joints)
    return search.polish(rows, settings.polish)


def opened(energy: GraspEnergy, wrist: Float[Tensor, "c 4 4"], joints: Float[Tensor, "c j"]) -> Float[Tensor, "c j"]:
    """The protocol's open hand, every finger opened only as far as it stays clear of the object behind it.

    Args:
        energy: knows hand and object.
        wrist: pose of the wrist in the object frame.
        joints: all hand joints in contact (rad), in the order of `RobotDescription.hand`.
    """
    hand = energy.hand
    wide = pregrasp(hand.robot, joints)
    fingers = list(hand.robot.fingers.values())
    owner = [next(i for i, finger in enumerate(fingers) if name in finger.joints) for name in hand.robot.hand.names]
    share = joints.new_zeros(len(joints), hand.fingers)
    for trial in OPENINGS:
        poses = hand.forward(wrist, hand.robot.reduce_hand(torch.lerp(joints, wide, trial)))
        depth = hand.sphere_radius - energy.field.distance(hand.place(poses, hand.spheres))
        part = hand.part[hand.spheres.body] - 2
        deepest = torch.stack([depth[:, part == index].amax(1) for index in range(hand.fingers)], 1)
        share = torch.where((deepest < OPENING_DEPTH) & (share == trial - OPENINGS[0]), trial, share)
    return torch.lerp(joints, wide, share[:, owner])
