"""Speed of the grasp search: candidates per second, shares of its parts, growth with size, ratio to a reference.

All times are processor times of one thread, without Numba's compilation. The reference is the same
optimisation, energy and gradient, with forward kinematics of pytorch_kinematics and with closest points of
trimesh instead of the distance field, in the same process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.hand.chain_hand import ChainHand
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.hand.postures import pregrasp, squeeze
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.signed_distance import CHANNELS, SignedDistanceField
from dora.affordance.search.cache import forget
from dora.affordance.search.compiled import CompiledDescent, CompiledEnergy
from dora.affordance.search.descent import Rows, Schedule
from dora.affordance.search.energies import GraspEnergy, Table
from dora.affordance.search.initial_poses import InitialPoses
from dora.affordance.search.native.parts import PARTS, repeat
from dora.affordance.search.optimise import optimise, seated, table_of
from dora.affordance.search.quasi_static_closing import close_hand
from dora.affordance.search.search import Search, Settings
from dora.parallel import one_thread
from dora.robot import RobotDescription

NUM = 256
"""Candidates asked for."""
BATCHES = (32, 128, 512)
"""Candidates searched at once."""
ROWS = (1, 8, 32, 128, 512)
"""Candidates evaluated at once."""
SUBDIVISIONS = (0, 1, 2)
"""How often the object's faces are divided by four."""
PART_REPEATS = 200
"""How often a part is done for each candidate, in one measurement."""
PART_ROWS = 32
"""Candidates of such a measurement [1]."""
REFERENCE_ROWS = 8
"""Candidates of the reference, which takes seconds per evaluation for more."""
REFERENCE_REPEATS = 3
"""Measurements of the reference [1]."""
REPEATS = 10
"""Measurements of a short piece of work; the fastest counts, since other programs only slow it down."""


@dataclass(frozen=True)
class GraspBenchmark:
    """Result of `measure`.

    Attributes:
        object: name.
        region: what is to be held.
        num: candidates asked for.
        candidates_per_second: of the whole of `optimise` for an object that it has met before in this process.
        first_candidates_per_second: of its first call, which fills the distance field and samples surfaces, too.
        by_batch: candidates/s of `optimise` by candidates searched at once.
        stages: milliseconds per candidate asked for: search, closing the hands, polish, and judging by the model (here
            of all rows; `optimise` judges only those without fault).
        evaluation_microseconds: of energy and gradient of one candidate, by candidates evaluated at once.
        step_microseconds: of a step of descent of one candidate.
        shares: share of the time of a step, by part. Parts are timed one by one in compiled loops and overlap a
            little with their surroundings; `rest` is what their sum lacks.
        by_faces: seconds to fill the distance field, and microseconds of an evaluation, by the mesh's number of faces.
        reference_microseconds: of an evaluation of one candidate in the reference.
        ratio: `reference_microseconds` over those of ours at the standard batch. Both searches take the same
            evaluations, so this is the ratio of candidates per second of the optimisation.
        reference_candidates_per_second: of the search alone with the reference, by its number of evaluations.
        search_candidates_per_second: of the search alone.
    """

    object: str
    region: str
    num: int
    candidates_per_second: float
    first_candidates_per_second: float
    by_batch: dict[int, float]
    stages: dict[str, float]
    evaluation_microseconds: dict[int, float]
    step_microseconds: float
    shares: dict[str, float]
    by_faces: dict[int, dict[str, float]]
    reference_microseconds: float
    ratio: float
    reference_candidates_per_second: float
    search_candidates_per_second: float


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
        name: one of `available_objects`; what its task wants held is the region.
        robot: the robot whose hand grasps.
        settings: of the search.

    Raises:
        InputError: there is no such object.
    """
    with one_thread():
        return _measure(load_object(name), robot, settings or Settings())


def _measure(obj: AffordanceObject, robot: RobotDescription, settings: Settings) -> GraspBenchmark:
    def whole(batch: int) -> float:
        return _seconds(lambda: optimise(obj, robot, NUM, 0, obj.target, replace(settings, batch=batch)))

    optimise(obj, robot, 1, 0, obj.target, settings)
    forget()
    first, later = whole(settings.batch), whole(settings.batch)
    search = _search(obj, HandModel(robot), SignedDistanceField(obj.solid, obj.region(obj.target)), settings)
    evaluation = {rows: 1e6 * _evaluation(search, rows) for rows in ROWS}
    alone = _seconds(lambda: search.run(settings.batch, _generator(), lambda rows: None)) / settings.batch
    step, shares = _shares(search)
    reference = _reference(obj, robot, settings)
    ratio = reference / _evaluation(search, settings.batch)
    return GraspBenchmark(
        object=obj.name,
        region=obj.target,
        num=NUM,
        candidates_per_second=NUM / later,
        first_candidates_per_second=NUM / first,
        by_batch={batch: NUM / whole(batch) for batch in BATCHES},
        stages=_stages(obj, search),
        evaluation_microseconds=evaluation,
        step_microseconds=1e6 * step,
        shares=shares,
        by_faces=_by_faces(obj, search, settings),
        reference_microseconds=1e6 * reference,
        ratio=ratio,
        reference_candidates_per_second=1 / (alone * ratio),
        search_candidates_per_second=1 / alone,
    )


def _table(obj: AffordanceObject) -> Table | None:
    """The table of an object that stands on one, as `optimise` takes it."""
    return table_of(obj) if obj.on_table else None


def _search(obj: AffordanceObject, hand: HandModel, field: SignedDistanceField, settings: Settings) -> Search:
    """What `optimise` searches with."""
    energy = CompiledEnergy(hand, field, settings.weights, _table(obj))
    return Search(energy, InitialPoses(obj, hand, obj.target, settings.spread), settings)


def _reference(obj: AffordanceObject, robot: RobotDescription, settings: Settings) -> float:
    """Seconds of an evaluation of one candidate with pytorch_kinematics and trimesh."""
    hand = ChainHand(robot)
    energy = GraspEnergy(hand, PlainField(obj.solid), settings.weights, _table(obj))
    search = Search(energy, InitialPoses(obj, hand, obj.target, settings.spread), replace(settings, starts=1))
    return _evaluation(search, REFERENCE_ROWS, REFERENCE_REPEATS)


def _by_faces(obj: AffordanceObject, search: Search, settings: Settings) -> dict[int, dict[str, float]]:
    """Growth with the mesh: see `GraspBenchmark.by_faces`."""
    found, solid = {}, obj.solid
    for _ in SUBDIVISIONS:
        start = time.process_time()
        field = SignedDistanceField(solid)
        filled = time.process_time() - start
        energy = CompiledEnergy(search.energy.hand, field, settings.weights, _table(obj))
        rate = _evaluation(Search(energy, search.initial, settings), settings.batch)
        found[len(solid.faces)] = {"fill_seconds": filled, "evaluation_microseconds": 1e6 * rate}
        solid = solid.subdivide()
    return found


def _stages(obj: AffordanceObject, search: Search) -> dict[str, float]:
    """Milliseconds that each stage of `optimise` takes per candidate asked for, by one batch of the search."""
    settings, energy, robot = search.settings, search.energy, search.energy.hand.robot
    assert isinstance(energy, CompiledEnergy)
    rows: list[Rows] = []

    def judge(rows: Rows) -> None:
        full = robot.expand_hand(rows.joints)
        close_hand(energy, rows.wrist, pregrasp(robot, full), squeeze(robot, full), obj.mass, wanted=wanted)

    wanted = round(settings.batch / settings.oversampling)
    seconds = {
        "search": _seconds(lambda: rows.append(search.run(settings.batch, _generator(), lambda count: None))),
        "seating": _seconds(lambda: rows.append(seated(energy, rows[0], obj.mass, settings.seat))),
        "polish": _seconds(lambda: rows.append(search.polish(rows[1], settings.polish))),
        "judging": _seconds(lambda: judge(rows[2])),
    }
    return {name: 1e3 * value * settings.oversampling / settings.batch for name, value in seconds.items()}


def _shares(search: Search) -> tuple[float, dict[str, float]]:
    """Seconds of a step of descent of one candidate, and the share of each part, at candidates that touch."""
    rows = search.run(PART_ROWS, _generator(), lambda count: None)
    energy, descent = search.energy, search.descent
    assert isinstance(energy, CompiledEnergy)
    assert isinstance(descent, CompiledDescent)
    adam = descent.adam([0.0])
    arrays = energy.arrays, energy.field_arrays, energy.factors(1.0), energy.plane(), adam
    places = rows.wrist.numpy(), rows.joints.numpy(), rows.contacts.numpy()
    done = PART_ROWS * PART_REPEATS
    still = Schedule(0, [1.0] * PART_REPEATS, [0.0] * PART_REPEATS)
    step = min(_seconds(lambda: search.descent(rows, still)) for _ in range(REPEATS)) / done
    shares = {}
    for index, name in enumerate(PARTS):
        repeat(index, 1, *arrays, *places)
        seconds = min(_seconds(lambda i=index: repeat(i, PART_REPEATS, *arrays, *places)) for _ in range(REPEATS))
        shares[name] = seconds / done / step
    for twice in ("forward_kinematics", "gradient"):
        shares[twice] *= 2
    return step, shares | {"rest": max(0.0, 1 - sum(shares.values()))}


def _evaluation(search: Search, rows: int, repeats: int = REPEATS) -> float:
    """Seconds of energy and gradient of one candidate, evaluated with others, all in front of the object."""
    start = search.start(rows, _generator())
    places = start.wrist, start.joints, start.contacts
    return min(_seconds(lambda: search.energy(*places)) for _ in range(repeats)) / rows


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _seconds(work: Callable[[], object]) -> float:
    """Processor time."""
    start = time.process_time()
    work()
    return time.process_time() - start
