"""Search for grasps by gradient descent on the grasp energy, from many initial poses at once.

Every row is one candidate. Adam moves wrist and joints; now and then half of the contact points of a row
are drawn anew and kept if its energy is lower. Rows start as the best of several draws; the weights of
terms that must vanish grow in the last part; rows that have converged leave the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates, hand_digest
from dora.affordance.contact_map import hand_contacts
from dora.affordance.energies import RAMPED, Evaluation, GraspEnergy, Table, Weights
from dora.affordance.hand import HandModel
from dora.affordance.initial import InitialPoses, Spread
from dora.affordance.map import AffordanceMap
from dora.affordance.measures import Penetration, self_penetration
from dora.affordance.protocol import STANDARD, pregrasp, squeeze
from dora.affordance.signed_distance import SignedDistanceField
from dora.affordance.structure import AffordanceObject
from dora.affordance.voting import NO_CONTACT, vote
from dora.errors import InputError
from dora.robot import RobotDescription
from dora.robot.rotations import matrix_from_quaternion, quaternion_from_matrix

Progress = Callable[[int, int], None]
"""Called with the candidate-iterations done and their total."""


OFF_TABLE = ("hammer", "microwave")
"""Objects that their tasks do not take from a table: one is caught in the air, the other is a door's handle."""


@dataclass(frozen=True)
class Settings:
    """Settings of the search.

    Attributes:
        iterations: gradient steps per candidate.
        contacts: contact points per candidate: one on the palm, one on the thumb (the first finger), the others on
            the other fingers in random order, and on any finger beyond that.
        weights: of the energy terms.
        ramp: factor on the weights of penetration, table and self-penetration at the end.
        ramp_start: share of the iterations after which the ramp begins.
        resample: iterations between attempts to draw contact points anew.
        resample_until: share of the iterations after which contact points stay.
        starts: initial poses drawn per candidate; the best is taken.
        field_size: rows started per candidate; at the share `halving` of the iterations only the best stay.
        halving: see `field_size`.
        settle: share of the iterations after which rows that have converged stop.
        oversampling: candidates finished per candidate asked for; the best are returned.
        translation: largest step of the wrist (m).
        rotation: largest rotation of the wrist in a step (rad).
        joint: largest step of a joint (rad).
        batch: candidates searched at once; more does not fit a core's cache.
        table: keep the hand above the table on which the object rests; None: unless it is one of `OFF_TABLE`.
        spread: of the initial poses.
    """

    iterations: int = 200
    contacts: int = 8
    weights: Weights = field(default_factory=Weights)
    ramp: float = 12.0
    ramp_start: float = 0.4
    resample: int = 20
    resample_until: float = 0.6
    starts: int = 6
    field_size: float = 3.0
    halving: float = 0.25
    settle: float = 0.6
    oversampling: float = 1.0
    translation: float = 2e-3
    rotation: float = 0.02
    joint: float = 0.02
    batch: int = 128
    table: bool | None = None
    spread: Spread = field(default_factory=Spread)

    def __post_init__(self) -> None:
        for name in ("iterations", "contacts", "resample", "starts", "batch"):
            if getattr(self, name) < 1:
                raise InputError(f"the search needs {name} of at least 1, not {getattr(self, name)}.")


@dataclass
class Rows:
    """Candidates under search.

    `wrist` (c, 4, 4) in the object frame, `joints` (c, a) in rad, `contacts` (c, k) indices of contact points,
    `mean` and `square` (c, 6 + a) Adam's moments, `total` (c,) energy when last looked at.
    """

    wrist: Tensor
    joints: Tensor
    contacts: Tensor
    mean: Tensor
    square: Tensor
    total: Tensor

    @classmethod
    def begin(cls, wrist: Tensor, joints: Tensor, contacts: Tensor, total: Tensor) -> Rows:
        """Rows that have not moved yet."""
        mean = joints.new_zeros(len(joints), 6 + joints.shape[1])
        return cls(wrist, joints, contacts, mean, torch.zeros_like(mean), total)

    def __len__(self) -> int:
        return len(self.joints)

    def select(self, index: Tensor) -> Rows:
        """The rows of an index or a mask."""
        return Rows(*(getattr(self, part.name)[index] for part in fields(self)))

    @staticmethod
    def join(parts: list[Rows]) -> Rows:
        """Rows of several parts, in their order."""
        return Rows(*(torch.cat([getattr(rows, part.name) for rows in parts]) for part in fields(Rows)))


CHECK = 5
"""Iterations between checks for rows that have settled."""
SETTLED = 2e-3
"""Relative change of the energy between two checks below which a row has settled."""
TOLERANCE = 1e-4
"""Sum of overlaps (m) that a settled row may have, skin included."""
MEAN_DECAY, SQUARE_DECAY = 0.9, 0.98
"""Adam's decay rates."""
LAST_STEP = 0.01
"""Share of the step sizes that is left at the end of the cosine schedule."""


class Search:
    """Gradient search of one object with one hand."""

    def __init__(self, energy: GraspEnergy, initial: InitialPoses, settings: Settings) -> None:
        self.energy, self.initial, self.settings = energy, initial, settings
        hand = energy.hand
        steps = [settings.translation] * 3 + [settings.rotation] * 3 + [settings.joint] * len(hand.lower)
        self._steps = hand.lower.new_tensor(steps)
        parts = hand.contact_part.unique().tolist()
        self._points = [(hand.contact_part == part).nonzero().squeeze(1) for part in parts]

    def run(self, count: int, generator: torch.Generator, progress: Callable[[int], None]) -> Rows:
        """Search and return `count` candidates; `progress` gets the number of rows after every iteration."""
        settings, hand = self.settings, self.energy.hand
        rows = self.start(math.ceil(count * settings.field_size), generator)
        finished = []
        halving = int(settings.halving * settings.iterations)
        for step in range(settings.iterations):
            found = self._step(rows, step, generator)
            progress(len(rows))
            if step == halving:
                rows = rows.select(found.total.argsort()[:count])
            elif step > settings.settle * settings.iterations and step % CHECK == 0:
                settled = self._settled(rows, found)
                rows.total = found.total
                finished.append(rows.select(settled))
                rows = rows.select(~settled)
                if not len(rows):
                    break
        rows = Rows.join([*finished, rows])
        rows.joints = torch.clamp(rows.joints, hand.lower, hand.upper)
        return rows

    def _settled(self, rows: Rows, found: Evaluation) -> Tensor:
        """Rows (c,) whose energy has stopped falling and whose terms that must vanish have vanished."""
        still = (rows.total - found.total).abs() < SETTLED * found.total
        return still & (sum(found.terms.get(name, found.total * 0) for name in RAMPED) < TOLERANCE)

    def start(self, count: int, generator: torch.Generator) -> Rows:
        """The best of `starts` initial poses of every candidate."""
        starts = self.settings.starts
        wrist, joints = self.initial.draw(count * starts, generator)
        contacts = self.draw_contacts(count * starts, generator)
        total = torch.cat(
            [
                self.energy(*part).total
                for part in zip(*(x.split(self.settings.batch) for x in (wrist, joints, contacts)), strict=True)
            ]
        )
        best = total.view(starts, count).argmin(0) * count + torch.arange(count, device=total.device)
        return Rows.begin(wrist[best], joints[best], contacts[best], total[best])

    def draw_contacts(self, count: int, generator: torch.Generator) -> Int[Tensor, "c k"]:
        """Random contact points: palm, first finger, the other fingers in random order, then any finger."""
        fingers, contacts = len(self._points) - 1, self.settings.contacts
        others = torch.rand(count, fingers - 1, generator=generator).argsort(1) + 2
        extra = torch.randint(1, fingers + 1, (count, contacts), generator=generator)
        part = torch.cat((torch.tensor([[0, 1]]).expand(count, -1), others, extra), 1)[:, :contacts]
        share = torch.rand(count, contacts, generator=generator)
        sizes = torch.tensor([len(points) for points in self._points])
        starts = sizes.cumsum(0) - sizes
        every = torch.cat(self._points)
        return every[(starts[part] + (share * sizes[part]).long()).to(every.device)]

    def _step(self, rows: Rows, step: int, generator: torch.Generator) -> Evaluation:
        settings = self.settings
        done = step / settings.iterations
        ramp = 1 + (settings.ramp - 1) * max(0.0, done - settings.ramp_start) / (1 - settings.ramp_start)
        found = self.energy(rows.wrist, rows.joints, rows.contacts, ramp)
        if step and step % settings.resample == 0 and done < settings.resample_until:
            found = self._resample(rows, found, ramp, generator)
        self._descend(rows, found, step)
        return found

    def _resample(self, rows: Rows, found: Evaluation, ramp: float, generator: torch.Generator) -> Evaluation:
        """Draw half of the contact points anew; keep them where the energy is lower."""
        fresh = self.draw_contacts(len(rows), generator)
        stay = (torch.rand(fresh.shape, generator=generator) < 0.5).to(fresh.device)
        fresh = torch.where(stay, rows.contacts, fresh)
        other = self.energy(rows.wrist, rows.joints, fresh, ramp)
        better = other.total < found.total
        rows.contacts = torch.where(better.unsqueeze(1), fresh, rows.contacts)
        return Evaluation(
            torch.where(better, other.total, found.total),
            {name: torch.where(better, other.terms[name], value) for name, value in found.terms.items()},
            torch.where(better.unsqueeze(1), other.wrist, found.wrist),
            torch.where(better.unsqueeze(1), other.joints, found.joints),
        )

    def _descend(self, rows: Rows, found: Evaluation, step: int) -> None:
        """One Adam step with a cosine schedule; rotations move along their tangent."""
        gradient = torch.cat((found.wrist, found.joints), 1)
        rows.mean.lerp_(gradient, 1 - MEAN_DECAY)
        rows.square.lerp_(gradient.square(), 1 - SQUARE_DECAY)
        mean = rows.mean / (1 - MEAN_DECAY ** (step + 1))
        root = (rows.square / (1 - SQUARE_DECAY ** (step + 1))).sqrt_().add_(1e-8)
        size = LAST_STEP + (1 - LAST_STEP) * 0.5 * (1 + math.cos(math.pi * step / self.settings.iterations))
        move = -size * self._steps * mean / root
        rows.wrist[:, :3, 3] += move[:, :3]
        half = torch.nn.functional.pad(0.5 * move[:, 3:6], (1, 0), value=1.0)
        turn = matrix_from_quaternion(torch.nn.functional.normalize(half, dim=-1))
        rows.wrist[:, :3, :3] = turn @ rows.wrist[:, :3, :3]
        rows.joints = rows.joints + move[:, 6:]


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
    energy = GraspEnergy(hand, field, settings.weights, table_of(obj) if on_table else None)
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
        search.run(size, torch.Generator().manual_seed(batch_seed(seed, index)), report)
        for index, size in enumerate(sizes)
    ]
    rows = [torch.cat([getattr(part, name) for part in found]) for name in ("wrist", "joints", "contacts")]
    return _candidates(obj, energy, rows[0], rows[1], rows[2], num, settings)


def batch_seed(seed: int, index: int) -> int:
    """Seed of one batch of a search."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])


def table_of(obj: AffordanceObject) -> Table:
    """The table under an object at rest, in the object frame."""
    up = matrix_from_quaternion(torch.tensor(obj.rest, dtype=torch.float64))[2].tolist()
    return Table((up[0], up[1], up[2]), obj.support)


def _candidates(
    obj: AffordanceObject,
    energy: GraspEnergy,
    wrist: Tensor,
    joints: Tensor,
    contacts: Tensor,
    num: int,
    settings: Settings,
) -> GraspCandidates:
    """The `num` best rows, measured and classified."""
    hand, robot = energy.hand, energy.hand.robot
    found = energy(wrist, joints, contacts, settings.ramp)
    poses = hand.forward(wrist, joints)
    depth, self_depth = Penetration(hand, energy.field)(poses), self_penetration(energy, poses)
    invalid = depth > STANDARD.penetration
    best = (found.total + invalid * found.total.max()).argsort()[:num]
    poses, joints, wrist = poses[best], joints[best], wrist[best]
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
        energy={name: value[best] for name, value in found.terms.items()},
        penetration=depth[best],
        self_penetration=self_depth[best],
        valid=~invalid[best],
        digest=obj.digest,
        robot=robot.name,
        robot_digest=hand_digest(robot),
        settings=repr(settings),
    )


def opened(
    energy: GraspEnergy, wrist: Float[Tensor, "c 4 4"], joints: Float[Tensor, "c j"]
) -> Float[Tensor, "c j"]:
    """The protocol's open hand, every finger opened only as far as it stays clear of the object behind it.

    Args:
        energy: knows hand and object.
        wrist: pose of the wrist in the object frame.
        joints: all hand joints in contact (rad), in the order of `RobotDescription.hand`.
    """
    hand = energy.hand
    wide = pregrasp(hand.robot, joints)
    names = [joint for finger in hand.robot.fingers.values() for joint in finger.joints]
    finger = [next(i for i, f in enumerate(hand.robot.fingers.values()) if n in f.joints) for n in hand.robot.hand.names]
    assert sorted(names) == sorted(hand.robot.hand.names)
    share = joints.new_zeros(len(joints), hand.fingers)
    for trial in OPENINGS:
        poses = hand.forward(wrist, hand.robot.reduce_hand(torch.lerp(joints, wide, trial)))
        depth = hand.sphere_radius - energy.field.distance(hand.place(poses, hand.spheres))
        part = hand.part[hand.spheres.body] - 2
        deepest = torch.stack([depth[:, part == index].amax(1) for index in range(hand.fingers)], 1)
        share = torch.where((deepest < OPENING_DEPTH) & (share == trial - OPENINGS[0]), trial, share)
    return torch.lerp(joints, wide, share[:, finger])


OPENINGS = (0.25, 0.5, 0.75, 1.0)
"""Shares of the protocol's opening that are tried."""
OPENING_DEPTH = 1e-3
"""Overlap (m) with the object up to which a finger counts as clear of it."""
NO_CLASS = "NoContact"
"""Grasp class of a candidate without contact."""
