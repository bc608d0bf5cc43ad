"""Reading of contacts between groups of bodies: impulses, separations and contact points."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.errors import InputError
from dora.sim.batch.queries import ContactScanner
from dora.sim.batch.scene import BatchScene
from dora.sim.substeps import watch_contacts


@dataclass(frozen=True)
class Contacts:
    """Contacts among g groups of bodies in n environments.

    Attributes:
        impulse: (n, g, g, 3) sum over contact points of the impulse on group i by group j in the world frame [N s].
            Antisymmetric in the groups; contacts inside a group add up to 0.
        separation: (n, g, g) smallest separation over the contact points of two groups [m]; negative values are
            penetration depths, +inf means that PhysX reports no contact. Symmetric. NaN on a GPU, which does not
            report it.
        point: (n, g, g, 3) mean of the contact points of two groups, weighted by their impulses, in the world frame
            [m]; only if the monitor keeps points, and 0 where there are none. Symmetric.
    """

    impulse: Float[Tensor, "n g g 3"]
    separation: Float[Tensor, "n g g"]
    point: Float[Tensor, "n g g 3"] | None = None


class ContactMonitor:
    """Reads the contacts between named groups of actors and links.

    Works on a single CPU environment, on ``physx_cpu_batch`` (where it is fastest) and, through pair
    queries, on a GPU (impulses only; not tested). The order of the groups in `Contacts` is that of
    ``groups``.

    PhysX reports the contacts of the last physics step only. To detect impacts that are shorter than a control
    step, let the monitor collect the contacts of every physics step and `take` them once per control step.

    Args:
        scene: the ManiSkill scene of the bodies; a reconfiguration requires a new monitor.
        groups: actors or links by the name of their group. A body may be in one group only.
        pairs: names of the two groups of every pair that is read, in any order; all pairs by default. Contact points
            of other pairs are skipped, which saves most of the cost for a hand.
        located: pairs (group, other) whose contact points `points` returns; none by default.
        every_step: whether to collect the contacts of every physics step for `take`. Not on a GPU.

    Raises:
        InputError: a body is in two groups, or a pair names an unknown group.
    """

    def __init__(
        self,
        scene: Any,
        groups: Mapping[str, Sequence[Any]],
        pairs: Iterable[tuple[str, str]] | None = None,
        located: Iterable[tuple[str, str]] = (),
        every_step: bool = False,
    ):
        self.names = tuple(groups)
        wanted = _wanted(self.names, pairs)
        places = _places(self.names, located)
        self._scene = scene
        self._collector: _GroupScanner | None = None
        if scene.gpu_sim_enabled and not isinstance(scene, BatchScene):
            self._scanner, self._pairs = None, _gpu_pairs(groups, wanted)
            return
        if isinstance(scene, BatchScene):
            readers = [system.get_contacts for system in scene.px.systems]
        else:
            readers = [scene.px.get_contacts]
        self._scanner = _GroupScanner(readers, groups, wanted, places)
        if isinstance(scene, BatchScene):
            scene.px.stepper.add_scanner(self._scanner)
        if every_step:
            self._collector = _GroupScanner(readers, groups, wanted, places)
            watch_contacts(scene, self._collector.take, self._collector.drop)

    def read(self) -> Contacts:
        """Contacts of the last physics step."""
        scanner = self._scanned()
        return scanner.result() if scanner else self._read_gpu()

    def keep_points(self) -> None:
        """From now on `Contacts.point` says where groups touch. Not on a GPU."""
        for scanner in (self._scanner, self._collector):
            if scanner is not None:
                scanner.keeps_points = True
                scanner.clear()

    def _scanned(self) -> "_GroupScanner | None":
        """The scanner after it has scanned the contacts of the last physics step; None on a GPU."""
        if self._scanner and isinstance(self._scene, BatchScene):
            self._scene.px.stepper.scan_contacts(self._scanner)
        elif self._scanner:
            self._scanner.begin_step()
            self._scanner.scan(0)
        return self._scanner

    def points(self, count: int) -> tuple[Float[Tensor, "n k 3"], Int[Tensor, "n k"]]:
        """Contact points of the located pairs in the last physics step that carry an impulse.

        Args:
            count: k, number of rows per environment; further points are left out.

        Returns:
            Positions in the world frame [m], and the index of the pair's first group, -1 in empty rows, which come
            last. On a GPU all rows are empty.
        """
        if scanner := self._scanned():
            return scanner.points(count)
        environments = self._scene.num_envs
        return torch.zeros(environments, count, 3), torch.full((environments, count), -1)

    def take(self) -> Contacts:
        """Contacts since the last `take`: sums of impulses and smallest separations over the physics steps.

        Without `every_step` these are the contacts of the last physics step.
        """
        if self._collector is None:
            return self.read()
        if isinstance(self._scene, BatchScene):
            self._scene.px.stepper.flush()
        contacts = self._collector.result()
        self._collector.clear()
        return contacts

    def _read_gpu(self) -> Contacts:
        count = len(self.names)
        impulse = torch.zeros(self._scene.num_envs, count, count, 3, device=self._scene.device)
        for first, second, one, other in self._pairs:
            pair = self._scene.get_pairwise_contact_impulses(one, other)
            impulse[:, first, second] += pair
            impulse[:, second, first] -= pair
        return Contacts(impulse, torch.full(impulse.shape[:-1], torch.nan, device=impulse.device))


def _wanted(names: tuple[str, ...], pairs: Iterable[tuple[str, str]] | None) -> list[bool]:
    """Flat list over pairs (first, second) of groups: whether contacts between them are read."""
    count = len(names)
    if pairs is None:
        return [True] * count**2
    wanted = [False] * count**2
    for one, other in pairs:
        if unknown := {one, other} - set(names):
            raise InputError(f"the contact pair ({one}, {other}) names the unknown group {unknown.pop()}.")
        first, second = names.index(one), names.index(other)
        wanted[first * count + second] = wanted[second * count + first] = True
    return wanted


def _places(names: tuple[str, ...], located: Iterable[tuple[str, str]]) -> list[int]:
    """Flat list over pairs (first, second) of groups: the index of the located group, -1 if the pair is not located."""
    places = [-1] * len(names) ** 2
    for one, other in located:
        first, second = names.index(one), names.index(other)
        places[first * len(names) + second] = places[second * len(names) + first] = first
    return places


def _gpu_pairs(groups: Mapping[str, Sequence[Any]], wanted: Sequence[bool]) -> list[tuple[int, int, Any, Any]]:
    members = list(enumerate(groups.values()))
    return [
        (first, second, one, other)
        for first, ones in members
        for second, others in members[first + 1 :]
        if wanted[first * len(members) + second]
        for one in ones
        for other in others
    ]


class _GroupScanner(ContactScanner):
    """Collects contact points between bodies of groups; sums them up only when the result is asked for."""

    def __init__(
        self,
        readers: Sequence[Callable[[], list]],
        groups: Mapping[str, Sequence[Any]],
        wanted: Sequence[bool],
        places: Sequence[int],
    ):
        super().__init__(readers)
        self._wanted, self._places = wanted, places
        self._count = len(groups)
        self.keeps_points = False
        self._group_of: dict[int, int] = {}
        members = [member for group in groups.values() for member in group]
        self._kept_alive = [body for member in members for body in member._bodies]  # ids stay unique
        for index, (name, group) in enumerate(groups.items()):
            for member in group:
                if any(self._group_of.setdefault(id(body), index) != index for body in member._bodies):
                    raise InputError(f"{member.name} is in group {name} and in another one: leave it in one of them.")
        self.clear()

    def clear(self) -> None:
        """Drop all collected points."""
        self._slots: list[int] = []
        self._impulses: list[np.ndarray] = []
        self._separations: list[float] = []
        self._places_of_all: list[np.ndarray] = []
        self._point_slots: list[tuple[int, int]] = []
        self._point_impulses: list[np.ndarray] = []
        self._positions: list[np.ndarray] = []

    def drop(self, environment: int) -> None:
        """Drop the collected points of one environment."""
        pairs = self._count**2
        kept = [k for k, slot in enumerate(self._slots) if slot // pairs != environment]
        all_places = [self._places_of_all] if self.keeps_points else []
        _keep(kept, self._slots, self._impulses, self._separations, *all_places)
        kept = [k for k, (owner, _) in enumerate(self._point_slots) if owner != environment]
        _keep(kept, self._point_slots, self._point_impulses, self._positions)

    def take(self, environment: int, contacts: list) -> None:
        """Collect the points between groups: index of (environment, first, second), impulse on first, separation."""
        group_of, count, wanted = self._group_of.get, self._count, self._wanted
        for contact in contacts:
            first, second = contact.bodies
            first = group_of(id(first))
            if first is None:
                continue
            second = group_of(id(second))
            if second is None:
                continue
            pair = first * count + second
            if not wanted[pair]:
                continue
            slot = environment * count * count + pair
            for point in contact.points:
                self._slots.append(slot)
                self._impulses.append(point.impulse)
                self._separations.append(point.separation)
            if self.keeps_points:
                self._places_of_all += [point.position for point in contact.points]
            if (place := self._places[pair]) >= 0:
                for point in contact.points:
                    self._point_slots.append((environment, place))
                    self._point_impulses.append(point.impulse)
                    self._positions.append(point.position)

    def points(self, count: int) -> tuple[Tensor, Tensor]:
        """The located points that carry an impulse, `count` rows per environment; see `ContactMonitor.points`."""
        shape = (len(self._readers), count)
        position, group = np.zeros((*shape, 3), np.float32), np.full(shape, -1)
        if self._point_slots:
            loaded = np.array(self._point_impulses).any(-1)
            environment, place = np.array(self._point_slots)[loaded].T
            order = np.argsort(environment, kind="stable")
            environment = environment[order]
            row = np.arange(len(order)) - np.searchsorted(environment, environment)
            kept = row < count
            slot = environment[kept], row[kept]
            position[slot] = np.array(self._positions)[loaded][order][kept]
            group[slot] = place[order][kept]
        return torch.from_numpy(position), torch.from_numpy(group)

    def result(self) -> Contacts:
        """Impulses and separations of the collected points by pair of groups."""
        shape = (len(self._readers), self._count, self._count)
        impulse = np.zeros((*shape, 3), np.float32)
        separation = np.full(shape, np.inf, np.float32)
        if self._slots:
            np.add.at(impulse.reshape(-1, 3), self._slots, np.array(self._impulses))
            np.minimum.at(separation.reshape(-1), self._slots, self._separations)
        impulse = impulse - impulse.swapaxes(1, 2)
        separation = np.minimum(separation, separation.swapaxes(1, 2))
        return Contacts(torch.from_numpy(impulse), torch.from_numpy(separation), self._middles(shape))

    def _middles(self, shape: tuple[int, int, int]) -> Tensor | None:
        """Means (n, g, g, 3) of the points of each pair, weighted by impulses; None if points are not kept."""
        if not self.keeps_points:
            return None
        total, weight = np.zeros((*shape, 3)), np.zeros(shape)
        if self._slots:
            size = np.linalg.norm(np.array(self._impulses), axis=-1)
            np.add.at(weight.reshape(-1), self._slots, size)
            np.add.at(total.reshape(-1, 3), self._slots, size[:, None] * np.array(self._places_of_all))
        total, weight = total + total.swapaxes(1, 2), (weight + weight.swapaxes(1, 2))[..., None]
        return torch.from_numpy(np.divide(total, weight, out=np.zeros_like(total), where=weight > 0)).float()


def _keep(kept: Sequence[int], *lists: list[Any]) -> None:
    """Leaves in each list only the entries with these indices."""
    for values in lists:
        values[:] = [values[k] for k in kept]
