"""Search for grasps by gradient descent on the grasp energy, from many initial poses at once.

Every row is one candidate. Adam moves wrist and joints; now and then half of the contact points of a row
are drawn anew and kept if its energy is lower. Rows start as the best of several draws; the weights of
terms that must vanish grow in the last part; rows that have converged leave the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates, hand_digest
from dora.affordance.contact_map import hand_contacts
from dora.affordance.energies import Evaluation, GraspEnergy, Table, Weights
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
        contacts: contact points per candidate: one on the thumb (the first finger), the others on the other
            fingers in random order, and any finger beyond that.
        weights: of the energy terms.
        ramp: factor on the weights of penetration, table and self-penetration at the end.
        ramp_start: share of the iterations after which the ramp begins.
        resample: iterations between attempts to draw contact points anew.
        resample_until: share of the iterations after which contact points stay.
        starts: initial poses drawn per candidate; the best is taken.
        oversampling: candidates searched per candidate asked for; the best are returned.
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


class Rows:
    """Candidates under search: `wrist` (c, 4, 4), `joints` (c, a), `contacts` (c, k), Adam's moments."""

    def __init__(self, wrist: Tensor, joints: Tensor, contacts: Tensor) -> None:
        self.wrist, self.joints, self.contacts = wrist, joints, contacts
        self.mean = joints.new_zeros(len(joints), 6 + joints.shape[1])
        self.square = torch.zeros_like(self.mean)

    def __len__(self) -> int:
        return len(self.joints)


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
        self._points = [(hand.contact_part == part).nonzero().squeeze(1) for part in parts if part > 1]

    def run(self, count: int, generator: torch.Generator, progress: Callable[[int], None]) -> Rows:
        """Search `count` candidates; `progress` gets the number of rows after every iteration."""
        rows = self.start(count, generator)
        for step in range(self.settings.iterations):
            self._step(rows, step, generator)
            progress(len(rows))
        hand = self.energy.hand
        rows.joints = torch.clamp(rows.joints, hand.lower, hand.upper)
        return rows

    def start(self, count: int, generator: torch.Generator) -> Rows:
        """The best of `starts` initial poses of every candidate."""
        starts = self.settings.starts
        wrist, joints = self.initial.draw(count * starts, generator)
        contacts = self.draw_contacts(count * starts, generator)
        total = [
            self.energy(*part).total
            for part in zip(*(x.split(self.settings.batch) for x in (wrist, joints, contacts)), strict=True)
        ]
        best = torch.cat(total).view(starts, count).argmin(0) * count + torch.arange(count)
        return Rows(wrist[best], joints[best], contacts[best])

    def draw_contacts(self, count: int, generator: torch.Generator) -> Int[Tensor, "c k"]:
        """Random contact points: the first finger, then the others in random order, then any."""
        fingers, contacts = len(self._points), self.settings.contacts
        others = torch.rand(count, fingers - 1, generator=generator).argsort(1) + 1
        extra = torch.randint(fingers, (count, contacts), generator=generator)
        finger = torch.cat((torch.zeros(count, 1, dtype=torch.long), others, extra), 1)[:, :contacts]
        share = torch.rand(count, contacts, generator=generator)
        sizes = torch.tensor([len(points) for points in self._points])
        starts = sizes.cumsum(0) - sizes
        every = torch.cat(self._points).cpu()
        return every[starts[finger] + (share * sizes[finger]).long()].to(self._points[0].device)

    def _step(self, rows: Rows, step: int, generator: torch.Generator) -> None:
        settings = self.settings
        done = step / settings.iterations
        ramp = 1 + (settings.ramp - 1) * max(0.0, done - settings.ramp_start) / (1 - settings.ramp_start)
        found = self.energy(rows.wrist, rows.joints, rows.contacts, ramp)
        if step and step % settings.resample == 0 and done < settings.resample_until:
            found = self._resample(rows, found, ramp, generator)
        self._descend(rows, found, step)

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
        pregrasp=pregrasp(robot, full),
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


NO_CLASS = "NoContact"
"""Grasp class of a candidate without contact."""
