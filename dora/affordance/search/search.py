"""Gradient descent on the grasp energy from many initial poses at once.

Each row of a batch is one candidate. Adam moves wrist and joints. At intervals half of the contact points of a row are
drawn again, and the new ones are kept if they lower its energy. A row starts as the best of several draws; after a
share of the iterations only the better rows stay; the weights of terms that must vanish grow towards the end; rows
that have converged leave the batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from jaxtyping import Int
from torch import Tensor

from dora.affordance.search.backends import descent_of
from dora.affordance.search.descent import Rows, Schedule
from dora.affordance.search.energies import GraspEnergy, Weights
from dora.affordance.search.initial_poses import InitialPoses, PosesNear, Spread
from dora.errors import InputError

MOST_SEATING = 2.0
"""Largest angle by which a hand is closed after the search [rad]."""


@dataclass(frozen=True)
class Settings:
    """Settings of the search.

    Attributes:
        iterations: gradient steps per candidate.
        contacts: contact points per candidate: one on the palm, one on the thumb (the first finger), then one on
            each other finger in random order, then on random fingers.
        weights: weights of the energy terms.
        ramp: factor on the weights of penetration, table and self-penetration at the end [1].
        ramp_start: share of the iterations after which the ramp begins [1].
        resample: iterations between attempts to draw contact points again.
        resample_until: share of the iterations after which contact points stay [1].
        starts: initial poses drawn per candidate, of which the best is taken.
        field_size: rows started per candidate; at the share `halving` of the iterations only the best stay [1].
        halving: see `field_size` [1].
        settle: share of the iterations after which converged rows leave the batch [1].
        oversampling: candidates finished per candidate asked for; the best are returned [1].
        seat: angle by which the hand closes around the object after the search, to make missing contacts [rad]; 0
            leaves this out.
        polish: gradient steps after that, which remove overlaps.
        polish_weights: weights of the energy terms in those steps.
        translation: largest translation of the wrist in a step [m].
        rotation: largest rotation of the wrist in a step [rad].
        joint: largest change of a joint in a step [rad].
        batch: rows searched at once; larger batches exceed a core's cache.
        table: whether to keep the hand above the object's table; None: if it is on one before it is grasped.
        spread: random spread of the initial poses.

    Raises:
        InputError: a count is below 1, or `seat` is no angle from 0 to `MOST_SEATING`.
    """

    iterations: int = 40
    contacts: int = 9
    weights: Weights = field(default_factory=Weights)
    ramp: float = 12.0
    ramp_start: float = 0.4
    resample: int = 8
    resample_until: float = 0.6
    starts: int = 8
    field_size: float = 2.0
    halving: float = 0.5
    settle: float = 0.6
    oversampling: float = 2.5
    seat: float = 0.7
    polish: int = 80
    polish_weights: Weights = field(default_factory=lambda: Weights(closure=0.0, closing=300.0))
    translation: float = 2e-3
    rotation: float = 0.02
    joint: float = 0.02
    batch: int = 128
    table: bool | None = None
    spread: Spread = field(default_factory=Spread)

    def __post_init__(self) -> None:
        for name in ("iterations", "contacts", "resample", "starts", "batch", "polish", "oversampling", "field_size"):
            if not getattr(self, name) >= 1:
                raise InputError(f"the search needs {name} of at least 1, not {getattr(self, name)}.")
        if not 0 <= self.ramp_start < 1:
            raise InputError(f"the search needs ramp_start from 0 to below 1, not {self.ramp_start}.")
        if not 0 <= self.seat <= MOST_SEATING:
            raise InputError(f"the hand can be closed by 0 to {MOST_SEATING} rad after the search, not by {self.seat}.")


CHECK = 5
"""Iterations between checks for converged rows."""
SETTLED = 2e-3
"""Relative change of the energy between two checks below which a row has converged [1]."""
TOLERANCE = 1e-4
"""Largest sum of overlaps of a converged row, skin included [m]."""
POLISH_STEP = 0.5
"""Ratio of the largest steps of polishing to those of the search [1]."""
LAST_STEP = 0.01
"""Share of the step sizes at the end of the cosine schedule [1]."""


class Search:
    """Gradient search for grasps of one object with one hand.

    Args:
        energy: the energy to minimise.
        initial: source of initial poses.
        settings: settings of the search.
    """

    def __init__(self, energy: GraspEnergy, initial: InitialPoses | PosesNear, settings: Settings) -> None:
        self.energy, self.initial, self.settings = energy, initial, settings
        hand = energy.hand
        steps = [settings.translation] * 3 + [settings.rotation] * 3 + [settings.joint] * len(hand.lower)
        kind = descent_of(energy)
        self.descent = kind(energy, hand.lower.new_tensor(steps))
        self.polishing = kind(energy.weighted(settings.polish_weights), hand.lower.new_tensor(steps))
        parts = hand.contact_part.unique().tolist()
        self._points = [(hand.contact_part == part).nonzero().squeeze(1) for part in parts]

    def work(self, count: int) -> int:
        """Row-iterations of the search for `count` candidates, of which `run` reports as many unless rows settle."""
        settings, halving = self.settings, self._halving
        return math.ceil(count * settings.field_size) * halving + count * (settings.iterations - halving)

    @property
    def _halving(self) -> int:
        """Iterations after which only the best rows stay."""
        return max(1, int(self.settings.halving * self.settings.iterations))

    def run(self, count: int, generator: torch.Generator, progress: Callable[[int], None]) -> Rows:
        """Search and return `count` candidates; `progress` is called with the candidate-iterations of each stretch."""
        settings, hand = self.settings, self.energy.hand
        rows = self.start(math.ceil(count * settings.field_size), generator)
        last = settings.iterations
        halving = self._halving
        resampling = range(settings.resample, math.ceil(settings.resample_until * last), settings.resample)
        checks = range(CHECK * (1 + int(settings.settle * last) // CHECK), last, CHECK)
        finished = []
        for start, stop in pairwise(sorted({0, last, halving, *resampling, *checks})):
            if start in resampling:
                self._resample(rows, self._ramp(start), generator)
            before = rows.total
            steps = range(start, stop)
            self.descent(rows, Schedule(start, [self._ramp(i) for i in steps], [fading(i / last) for i in steps]))
            progress(len(rows) * len(steps))
            if stop == halving:
                rows = rows.select(rows.total.argsort()[:count])
            elif stop in checks:
                settled = ((before - rows.total).abs() < SETTLED * rows.total) & (rows.overlap < TOLERANCE)
                finished.append(rows.select(settled))
                rows = rows.select(~settled)
                if not len(rows):
                    break
        rows = Rows.join([*finished, rows])
        rows.joints = torch.clamp(rows.joints, hand.lower, hand.upper)
        return rows

    def _ramp(self, step: int) -> float:
        """Factor on the weights of `RAMPED`."""
        settings = self.settings
        return 1 + (settings.ramp - 1) * max(0.0, step / settings.iterations - settings.ramp_start) / (
            1 - settings.ramp_start
        )

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
        """Random contact points, indices into `hand.contacts`, on the parts that `Settings.contacts` describes."""
        fingers, contacts = len(self._points) - 1, self.settings.contacts
        others = torch.rand(count, fingers - 1, generator=generator).argsort(1) + 2
        extra = torch.randint(1, fingers + 1, (count, contacts), generator=generator)
        part = torch.cat((torch.tensor([[0, 1]]).expand(count, -1), others, extra), 1)[:, :contacts]
        share = torch.rand(count, contacts, generator=generator)
        sizes = torch.tensor([len(points) for points in self._points])
        starts = sizes.cumsum(0) - sizes
        every = torch.cat(self._points)
        return every[(starts[part] + (share * sizes[part]).long()).to(every.device)]

    def _resample(self, rows: Rows, ramp: float, generator: torch.Generator) -> None:
        """Draw half of the contact points again; keep them where the energy is lower."""
        fresh = self.draw_contacts(len(rows), generator)
        stay = (torch.rand(fresh.shape, generator=generator) < 0.5).to(fresh.device)
        fresh = torch.where(stay, rows.contacts, fresh)
        now, then = (self.energy(rows.wrist, rows.joints, points, ramp).total for points in (rows.contacts, fresh))
        rows.contacts = torch.where((then < now).unsqueeze(1), fresh, rows.contacts)

    def polish(self, rows: Rows, iterations: int) -> Rows:
        """Rows after `iterations` more steps, with the full weights on overlaps and the nearest points as contacts."""
        settings, hand = self.settings, self.energy.hand
        rows = Rows.begin(rows.wrist, rows.joints, self.nearest_contacts(rows), rows.total)
        sizes = [POLISH_STEP * fading(step / iterations) for step in range(iterations)]
        self.polishing(rows, Schedule(0, [settings.ramp] * iterations, sizes))
        rows.joints = torch.clamp(rows.joints, hand.lower, hand.upper)
        return rows

    def nearest_contacts(self, rows: Rows) -> Int[Tensor, "c k"]:
        """Per row the nearest point of the palm and of those other links that are nearest to the object."""
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


def fading(done: float) -> float:
    """Cosine schedule of step sizes: from 1 at `done` = 0 to `LAST_STEP` at 1."""
    return LAST_STEP + (1 - LAST_STEP) * 0.5 * (1 + math.cos(math.pi * done))
