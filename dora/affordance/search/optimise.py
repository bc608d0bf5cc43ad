"""From an object to grasp candidates: the search, then the measurement, selection and classification of its rows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dora.affordance.candidates import GraspCandidates, hand_digest
from dora.affordance.hand.grasp_test_settings import STANDARD
from dora.affordance.hand.postures import pregrasp, squeeze
from dora.affordance.maps.contact_semantic_map import contact_semantic_map, pressed_contacts
from dora.affordance.maps.voting import NO_CONTACT, vote
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.search.backends import check_kinematics, closing_model_of, described, energy_of
from dora.affordance.search.cache import hand_of, initial_of, map_of
from dora.affordance.search.compiled import CompiledEnergy
from dora.affordance.search.descent import Rows
from dora.affordance.search.energies import GraspEnergy, Table
from dora.affordance.search.initial_poses import Nearness, PosesNear
from dora.affordance.search.penetration import Penetration, self_penetration
from dora.affordance.search.quasi_static_closing import Steps, close_hand
from dora.affordance.search.search import Search, Settings
from dora.affordance.search.torch_energies import ExtraEnergies
from dora.errors import InputError
from dora.geometry.rotations import matrix_from_quaternion, quaternion_from_matrix
from dora.robot import RobotDescription

__all__ = ["Settings", "optimise"]

Progress = Callable[[int, int], None]
"""Function that is called with the candidate-iterations done and their total."""
OPENINGS = (0.25, 0.5, 0.75, 1.0)
"""Shares of the grasp test's opening that are tried, ascending in equal steps [1]."""
OPENING_DEPTH = 1e-3
"""Penetration depth up to which an opened finger counts as clear of the object [m]."""
SHALLOW_PENETRATION = 9e-4
"""Penetration depth above which a candidate comes after those with less [m]."""
SEATING = Steps(closing=60, settling=20, weight=0)
"""Steps of the quasi-static closing around the object after the search, without load."""
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
    kinematics: str = "compiled",
    extra_energies: ExtraEnergies | None = None,
    near: GraspCandidates | None = None,
) -> GraspCandidates:
    """Search for grasps of an object.

    Args:
        obj: the object.
        robot: the robot whose hand grasps.
        num: number of candidates.
        seed: seed of all random draws; equal seeds give equal candidates.
        region: label of the region to be held; None for any.
        settings: settings of the search; the defaults if None.
        device: torch device of the search and of the result; hands are closed on the CPU.
        progress: called with the candidate-iterations done and their total.
        kinematics: one of `Kinematics`: "compiled" loops with gradients by hand, or "pytorch_kinematics" with automatic
            differentiation, which is slower and takes energies of yours.
        extra_energies: energies to be added to the terms: by name a constant weight, per unit of the energy, and a
            differentiable function of `GraspState` whose value is (c,).
        near: candidates of this object and hand, near which the search begins (`Nearness`), instead of in front of the
            region.

    Returns:
        `num` candidates in the object frame, best first. `valid` says whether the penetration depth at the candidate
        is within the grasp test's limit; whether the grasp withstands the test is decided by simulation.

    Raises:
        InputError: `num` is less than 1, the object has no such region or is too large for a hand, unknown kinematics,
            extra energies that cannot be used, or `near` is of another object or hand.
    """
    settings = settings or Settings()
    if num < 1:
        raise InputError(f"the search makes at least 1 candidate, not {num}.")
    check_kinematics(kinematics, extra_energies)
    place = str(torch.device(device))
    on_table = obj.on_table if settings.table is None else settings.table
    table = table_of(obj) if on_table else None
    energy = energy_of(kinematics, obj, robot, region, place, settings.weights, table, extra_energies)
    model = closing_model_of(energy, obj, robot, region)
    if near is None:
        initial = initial_of(obj, robot, region, settings.spread, place)
    else:
        near.check_fits("the set near which is searched", obj, robot, stored=False)
        initial = PosesNear(near, hand_of(robot, place), Nearness())
    search = Search(energy, initial, settings)
    wanted = math.ceil(num * settings.oversampling)
    sizes = [min(settings.batch, wanted - start) for start in range(0, wanted, settings.batch)]
    done, total = 0, sum(map(search.work, sizes))

    def report(rows: int) -> None:
        nonlocal done
        done += rows
        if progress is not None:
            progress(done, total)

    def batch(size: int, index: int) -> Rows:
        rows = search.run(size, torch.Generator().manual_seed(batch_seed(seed, index)), report)
        if settings.seat:
            rows = search.polish(seated(model, rows, obj.mass, settings.seat), settings.polish)
        return rows

    found = [batch(size, index) for index, size in enumerate(sizes)]
    candidates = _candidates(obj, energy, model, Rows.join(found), num, settings)
    return replace(candidates, settings=candidates.settings + described(kinematics, extra_energies))


def batch_seed(seed: int, index: int) -> int:
    """Seed of one batch of a search."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])


def table_of(obj: AffordanceObject) -> Table:
    """The table under a resting object, in the object frame."""
    up = matrix_from_quaternion(torch.tensor(obj.rest, dtype=torch.float64))[2].tolist()
    return Table((up[0], up[1], up[2]), obj.support)


def _candidates(
    obj: AffordanceObject, energy: GraspEnergy, model: CompiledEnergy, rows: Rows, num: int, settings: Settings
) -> GraspCandidates:
    """The `num` best rows as candidates: fewest faults first, then highest quality; `model` closes hands."""
    hand, robot = energy.hand, energy.hand.robot
    found = energy(rows.wrist, rows.joints, rows.contacts, settings.ramp)
    poses = hand.forward(rows.wrist, rows.joints)
    depth, self_depth = Penetration(hand, energy.field)(poses), self_penetration(energy, poses)
    faults = 4 * (depth > STANDARD.penetration).long() + 2 * (self_depth > STANDARD.strict_self_penetration).long()
    faults += (depth > SHALLOW_PENETRATION).long()
    selected = faults.argsort(stable=True)[: _selected_count(faults, num)]
    quality, predicted, closed = _quality(obj, model, rows, selected, num)
    order = quality.argsort(descending=True)
    best = order[faults[order].argsort(stable=True)][:num]
    joints, wrist = rows.joints[best], rows.wrist[best]
    closed_wrist, closed_joints = (part[best] for part in closed)
    points, finger = pressed_contacts(hand, energy.field, hand.forward(closed_wrist, closed_joints))
    regions = map_of(obj, str(points.device))
    voted = vote(regions, points, finger)
    position, quaternion = wrist[:, :3, 3].contiguous(), quaternion_from_matrix(wrist[:, :3, :3])
    full = robot.expand_hand(joints)
    normal = full.new_tensor(hand.palm_frame.normal)
    return GraspCandidates(
        object=obj.name,
        position=position,
        quaternion=quaternion,
        approach=wrist[:, :3, :3] @ normal,
        pregrasp=opened(energy, wrist, full),
        grasp=squeeze(robot, full),
        grasp_class=tuple(NO_CLASS if label == NO_CONTACT else obj.classes[label] for label in voted.tolist()),
        joints=full,
        contacts=points,
        contact_finger=finger,
        contact_map=contact_semantic_map(regions.points, position, quaternion, full, hand).byte(),
        energy={name: value[best] for name, value in (found.terms | predicted).items()},
        penetration=depth[best],
        self_penetration=self_depth[best],
        valid=depth[best] <= STANDARD.penetration,
        digest=obj.digest,
        robot=robot.name,
        robot_digest=hand_digest(robot),
        settings=repr(settings),
    )


def _selected_count(faults: Tensor, num: int) -> int:
    """Number of rows whose quality is computed: all without fault, but at least `num`."""
    return max(num, int((faults == 0).sum()))


def _quality(
    obj: AffordanceObject, model: CompiledEnergy, rows: Rows, selected: Tensor, num: int
) -> tuple[Tensor, dict[str, Tensor], tuple[Tensor, Tensor]]:
    """Quality (c,) of the selected rows, of which the `num` best must be exact; others have -inf.

    Returns:
        Quality, more is better; the model's predictions (c,) by name, nan for other rows; and the closed hand's wrist
        (c, 4, 4) in the object frame and actuated joints (c, a) [rad].
    """
    robot = model.hand.robot
    full = robot.expand_hand(rows.joints[selected])
    closed_hand = close_hand(
        model, rows.wrist[selected], pregrasp(robot, full), squeeze(robot, full), obj.mass, wanted=num
    )

    def spread(values: Tensor, missing: float) -> Tensor:
        return values.new_full((len(rows), *values.shape[1:]), missing).index_copy_(0, selected, values)

    predictions = {
        "predicted_shift": spread(closed_hand.shift, math.nan),
        "predicted_displacement": spread(closed_hand.displacement[:, -1], math.nan),
        "predicted_force": spread(closed_hand.force, math.nan),
    }
    closed = spread(closed_hand.wrist, math.nan), spread(robot.reduce_hand(closed_hand.joints), math.nan)
    return spread(closed_hand.quality, -math.inf), predictions, closed


def seated(energy: CompiledEnergy, rows: Rows, mass: float, squeezed: float) -> Rows:
    """Rows after quasi-static closing around the object, with all contacts made.

    Args:
        energy: its hand, object and table are used.
        rows: rows whose fingers are near the points that they should touch.
        mass: mass of the object [kg].
        squeezed: angle by which the command goes beyond the posture [rad].
    """
    robot = energy.hand.robot
    full = robot.expand_hand(rows.joints)
    closed = squeeze(robot, full, replace(STANDARD, squeeze=squeezed))
    closed_hand = close_hand(energy, rows.wrist, pregrasp(robot, full), closed, mass, steps=SEATING, on_table=True)
    return replace(rows, wrist=closed_hand.wrist.contiguous(), joints=robot.reduce_hand(closed_hand.joints))


def opened(energy: GraspEnergy, wrist: Float[Tensor, "c 4 4"], joints: Float[Tensor, "c j"]) -> Float[Tensor, "c j"]:
    """The open hand of the grasp test, each finger opened only as far as it stays clear of the object behind it.

    Args:
        energy: its hand and object are used.
        wrist: (c, 4, 4) pose of the wrist in the object frame [m].
        joints: (c, j) all hand joints in contact [rad], in the order of `RobotDescription.hand`.

    Returns:
        (c, j) hand joints before closing [rad], in the same order.
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
        overlap = torch.stack([depth[:, part == index].amax(1) for index in range(hand.fingers)], 1)
        share = torch.where((overlap < OPENING_DEPTH) & (share == trial - OPENINGS[0]), trial, share)
    return torch.lerp(joints, wide, share[:, owner])
