"""How fast the grasp search is: candidates per second, where the time goes, how it grows, and against what.

The reference is the same search with forward kinematics of pytorch_kinematics and with closest points of
trimesh instead of the distance field, in the same process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytorch_kinematics
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.energies import GraspEnergy
from dora.affordance.hand import HandModel
from dora.affordance.initial import InitialPoses
from dora.affordance.objects import load_object
from dora.affordance.optimise import optimise
from dora.affordance.search import Rows, Search, Settings
from dora.affordance.signed_distance import CHANNELS, SignedDistanceField
from dora.affordance.structure import AffordanceObject
from dora.robot import RobotDescription

BATCHES = (32, 128, 256)
"""Candidates searched at once."""
SUBDIVISIONS = (0, 1, 2)
"""How often the object's faces are divided by four."""
REFERENCE_ROWS = 8
"""Candidates of the reference, which takes seconds per iteration for more."""
REFERENCE_ITERATIONS = 3
REPEATS = 20
"""Measurements of a part; the fastest counts."""


@dataclass(frozen=True)
class GraspBenchmark:
    """Result of `measure`; times are processor times of one thread.

    Attributes:
        object: name.
        iterations: gradient steps per candidate.
        candidates_per_second: of the whole of `optimise`, tables included, at the standard batch.
        by_batch: candidates/s of the search alone, by batch size.
        shares: share of an iteration's time by part: forward kinematics, groups of energy terms, the rest.
        by_faces: seconds to fill the distance field and milliseconds of one evaluation of energy and gradient at the
            standard batch, by number of faces.
        reference_candidates_per_second: of the reference search.
        ratio: candidates/s of the search at the standard batch over those of the reference.
    """

    object: str
    iterations: int
    candidates_per_second: float
    by_batch: dict[int, float]
    shares: dict[str, float]
    by_faces: dict[int, dict[str, float]]
    reference_candidates_per_second: float
    ratio: float


class PlainHand(HandModel):
    """The hand with forward kinematics of pytorch_kinematics; coupled joints expanded."""

    def __init__(self, robot: RobotDescription) -> None:
        self._chain = pytorch_kinematics.build_chain_from_urdf(robot.urdf.read_bytes())
        super().__init__(robot)

    def forward(self, wrist: Float[Tensor, "c 4 4"], actuated: Float[Tensor, "c a"]) -> Float[Tensor, "c b 4 4"]:
        """As `HandModel.forward`."""
        full = self.robot.expand_hand(actuated)
        angles = {name: full[:, index] for index, name in enumerate(self.robot.hand.names)}
        angles |= {name: torch.zeros_like(full[:, 0]) for name in self.robot.arm.names}
        found = self._chain.forward_kinematics(angles)
        frames = torch.stack([found[link].get_matrix().expand(len(full), -1, -1) for link in self.links], 1)
        return (wrist @ torch.linalg.inv(frames[:, 0])).unsqueeze(1) @ frames


class PlainField(SignedDistanceField):
    """The object by trimesh's closest-point query; normals count as constant."""

    def may_touch(self, points: Float[Tensor, "c p 3"], reach: Float[Tensor, " p"]) -> Int[Tensor, " n"]:
        """All points: there is nothing to tell them apart by."""
        return torch.arange(points.shape[0] * points.shape[1])

    def sample(
        self, points: Float[Tensor, "n 3"], channels: int | None = None
    ) -> tuple[Float[Tensor, "n k"], Float[Tensor, "n k 3"]]:
        """As `SignedDistanceField.sample`."""
        where = points.double().numpy()
        closest, distance, face = trimesh.proximity.closest_point(self.solid, where)
        normal = self.solid.face_normals[face]
        sign = np.where(((where - closest) * normal).sum(1) < 0, -1.0, 1.0)
        value = torch.as_tensor(np.column_stack((sign * distance, normal)), dtype=points.dtype)
        jacobian = torch.zeros(len(points), CHANNELS, 3)
        jacobian[:, 0] = value[:, 1:]
        return value[:, :channels], jacobian[:, :channels]


def measure(name: str, robot: RobotDescription, settings: Settings | None = None) -> GraspBenchmark:
    """Measure the search of one object, on one thread.

    Args:
        name: one of `available_objects`.
        robot: whose hand it is.
        settings: of the search.

    Raises:
        InputError: there is no such object.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _measure(load_object(name), robot, settings or Settings())
    finally:
        torch.set_num_threads(threads)


def _measure(obj: AffordanceObject, robot: RobotDescription, settings: Settings) -> GraspBenchmark:
    hand = HandModel(robot)
    whole = settings.batch / _seconds(lambda: optimise(obj, robot, settings.batch, 0, settings=settings))
    search = _search(obj, hand, SignedDistanceField(obj.solid), settings)
    by_batch = {batch: _rate(search, batch) for batch in BATCHES}
    by_faces = {}
    solid = obj.solid
    for _ in SUBDIVISIONS:
        start = time.process_time()
        field = SignedDistanceField(solid)
        filled = time.process_time() - start
        evaluation = _iteration(_search(obj, hand, field, settings), settings.batch, REPEATS)
        by_faces[len(solid.faces)] = {"fill_seconds": filled, "milliseconds": 1e3 * evaluation}
        solid = solid.subdivide()
    plain = _search(obj, PlainHand(robot), PlainField(obj.solid), settings)
    ours = _iteration(search, settings.batch, REPEATS)
    reference = _iteration(plain, REFERENCE_ROWS, REFERENCE_ITERATIONS)
    ratio = (reference / REFERENCE_ROWS) / (ours / settings.batch)
    return GraspBenchmark(
        object=obj.name,
        iterations=settings.iterations,
        candidates_per_second=whole,
        by_batch=by_batch,
        shares=_shares(search, settings.batch),
        by_faces=by_faces,
        reference_candidates_per_second=by_batch[settings.batch] / ratio
        if settings.batch in by_batch
        else whole / ratio,
        ratio=ratio,
    )


def _search(obj: AffordanceObject, hand: HandModel, field: SignedDistanceField, settings: Settings) -> Search:
    energy = GraspEnergy(hand, field, settings.weights)
    return Search(energy, InitialPoses(obj, hand, None, settings.spread), settings)


def _rate(search: Search, count: int) -> float:
    """Candidates per second of the search alone."""
    return count / _seconds(lambda: search.run(count, torch.Generator().manual_seed(0), lambda rows: None))


def _seconds(work: Callable[[], object]) -> float:
    start = time.process_time()
    work()
    return time.process_time() - start


def _settled_rows(search: Search, count: int) -> Rows:
    """Candidates that touch, as in most of a search."""
    return search.run(count, torch.Generator().manual_seed(0), lambda rows: None)


def _iteration(search: Search, count: int, repeats: int) -> float:
    """Seconds of one evaluation of energy and gradient."""
    rows = search.start(count, torch.Generator().manual_seed(0))
    return min(_seconds(lambda: search.energy(rows.wrist, rows.joints, rows.contacts)) for _ in range(repeats))


def _shares(search: Search, count: int) -> dict[str, float]:
    """Shares of one iteration's time, at converged candidates; `rest` is assembling the gradient and Adam."""
    energy, hand = search.energy, search.energy.hand
    rows = _settled_rows(search, count)
    count = len(rows)
    poses = hand.forward(rows.wrist, rows.joints)
    wrench = poses.new_zeros(count, poses.shape[1], 6)
    found = energy(rows.wrist, rows.joints, rows.contacts)
    parts: dict[str, Callable[[], object]] = {
        "forward_kinematics": lambda: hand.forward(rows.wrist, rows.joints),
        "closure_distance_region": lambda: energy.contact_terms(poses, rows.contacts),
        "penetration_table": lambda: energy.sphere_terms(poses),
        "closing": lambda: energy.closing(poses, rows.contacts),
        "self_penetration": lambda: energy.self_penetration(poses),
        "limits": lambda: energy.limits(rows.joints),
        "pull_back": lambda: hand.pull_back(poses, wrench),
        "adam": lambda: search.descend(rows, found, 0, 0.0),
    }
    seconds = {name: min(_seconds(part) for _ in range(REPEATS)) for name, part in parts.items()}
    whole = seconds["adam"] + min(
        _seconds(lambda: energy(rows.wrist, rows.joints, rows.contacts)) for _ in range(REPEATS)
    )
    shares = {name: value / whole for name, value in seconds.items()}
    return shares | {"rest": max(0.0, 1 - sum(shares.values()))}
