"""Gradient descent on the grasp energy from many initial poses at once.

Every row is one candidate. Adam moves wrist and joints; now and then half of the contact points of a row
are drawn anew and kept if its energy is lower. A row starts as the best of several draws; after a part of the
iterations only the better rows stay; the weights of terms that must vanish grow in the last part; rows that
have converged leave the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields

import torch
from jaxtyping import Int
from torch import Tensor

from dora.affordance.energies import RAMPED, Evaluation, GraspEnergy, Weights
from dora.affordance.initial import InitialPoses, Spread
from dora.errors import InputError
from dora.robot.rotations import matrix_from_quaternion


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
        seat: how far the hand then closes around the object (rad), for contacts that are not made yet; 0: not at all.
        polish: gradient steps that remove overlaps after that.
        translation: largest step of the wrist (m).
        rotation: largest rotation of the wrist in a step (rad).
        joint: largest step of a joint (rad).
        batch: candidates searched at once; more does not fit a core's cache.
        table: keep the hand above the table on which the object rests; None: unless it is one of `OFF_TABLE`.
        spread: of the initial poses.
    """

    iterations: int = 70
    contacts: int = 9
    weights: Weights = field(default_factory=Weights)
    ramp: float = 12.0
    ramp_start: float = 0.4
    resample: int = 20
    resample_until: float = 0.6
    starts: int = 6
    field_size: float = 2.0
    halving: float = 0.25
    settle: float = 0.6
    oversampling: float = 2.5
    seat: float = 0.7
    polish: int = 60
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
POLISH_STEP = 0.5
"""Largest steps of polishing, in those of the search."""
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
        self.descend(rows, found, step, done)
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

    def polish(self, rows: Rows, iterations: int) -> Rows:
        """Descend from where rows are: full weights on overlaps, the nearest points as contacts."""
        settings, hand = self.settings, self.energy.hand
        rows = Rows.begin(rows.wrist, rows.joints, self.nearest_contacts(rows), rows.total)
        for step in range(iterations):
            found = self.energy(rows.wrist, rows.joints, rows.contacts, settings.ramp)
            self.descend(rows, found, step, step / iterations, POLISH_STEP)
        rows.joints = torch.clamp(rows.joints, hand.lower, hand.upper)
        return rows

    def nearest_contacts(self, rows: Rows) -> Int[Tensor, "c k"]:
        """The nearest point of the palm, and of the nearest of the other links."""
        hand = self.energy.hand
        points = hand.place(hand.forward(rows.wrist, rows.joints), hand.contacts)
        distance = self.energy.field.distance(points).abs()
        counts = torch.unique_consecutive(hand.contacts.body, return_counts=True)[1]
        starts = counts.cumsum(0) - counts
        found = [part.min(1) for part in distance.split(counts.tolist(), 1)]
        index = torch.stack([part.indices for part in found], 1) + starts
        gap = torch.stack([part.values for part in found], 1)
        gap[:, 0] = -1.0
        return torch.take_along_dim(index, gap.argsort(1)[:, : self.settings.contacts], 1)

    def descend(self, rows: Rows, found: Evaluation, step: int, done: float, scale: float = 1.0) -> None:
        """One Adam step with a cosine schedule in the share `done`; rotations move along their tangent."""
        gradient = torch.cat((found.wrist, found.joints), 1)
        rows.mean.lerp_(gradient, 1 - MEAN_DECAY)
        rows.square.lerp_(gradient.square(), 1 - SQUARE_DECAY)
        mean = rows.mean / (1 - MEAN_DECAY ** (step + 1))
        root = (rows.square / (1 - SQUARE_DECAY ** (step + 1))).sqrt_().add_(1e-8)
        size = scale * (LAST_STEP + (1 - LAST_STEP) * 0.5 * (1 + math.cos(math.pi * done)))
        move = -size * self._steps * mean / root
        rows.wrist[:, :3, 3] += move[:, :3]
        half = torch.nn.functional.pad(0.5 * move[:, 3:6], (1, 0), value=1.0)
        turn = matrix_from_quaternion(torch.nn.functional.normalize(half, dim=-1))
        rows.wrist[:, :3, :3] = turn @ rows.wrist[:, :3, :3]
        rows.joints = rows.joints + move[:, 6:]
