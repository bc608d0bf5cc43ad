"""Validation of grasp candidates by simulation: the hand closes, then gravity acts in six directions in turn.

docs/validation.md describes the test; `dora.affordance.hand.grasp_test_settings` has its numbers. Candidates are
distributed over processes. Each process simulates one candidate after the other in a scene of its own: a PhysX step of
several hands takes as long as one step for each. A candidate that fails ends early.
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.grasp_test_settings import DIRECTIONS, STANDARD, GraspTestSettings
from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.search.cache import map_of
from dora.geometry.rotations import matrix_from_quaternion, quaternion_apply, quaternion_inverse
from dora.parallel import Progress, run_cases
from dora.robot import RobotDescription
from dora.sim.grasp_tests.hand_contacts import HandContacts
from dora.sim.grasp_tests.test_scene import GraspTestScene, Physics

DISPLACEMENT_INTERVAL = 0.05
"""Time between two measurements of the displacement [s]."""
CONTACT_INTERVAL = 0.25
"""Time between two readings of the contacts, each of which takes as long as a physics step [s]."""
THROWN_SHIFT = 0.05
"""Displacement by closing at which a test ends, because the object is lost [m]."""


class Reason(IntEnum):
    """How a grasp test ended."""

    PASSED = 0
    """The hand held the object under all directions."""
    THROWN = 1
    """Closing moved the object by `THROWN_SHIFT` or more."""
    SLIPPED = 2
    """The object moved too far under gravity."""
    RELEASED = 3
    """No part of the hand carried a contact force at the end of a direction."""


@dataclass(frozen=True)
class Case:
    """One candidate with the wrist at the world's origin.

    Attributes:
        position: (3,) object in the wrist frame [m].
        quaternion: (4,) object in the wrist frame, wxyz.
        pregrasp: (hand,) hand joints before closing [rad].
        grasp: (hand,) commanded hand joints of the squeezing hand [rad].
    """

    position: np.ndarray
    quaternion: np.ndarray
    pregrasp: np.ndarray
    grasp: np.ndarray


@dataclass(frozen=True)
class Trial:
    """Result of one candidate; fields as in `Validation`, and the contacts after closing in the object frame."""

    reason: Reason
    displacement: float
    closing_shift: float
    penetration: float
    touch: HandContacts | None
    direction: int = -1


@dataclass(frozen=True, eq=False)
class Validation:
    """Results of the grasp test for c candidates.

    Attributes:
        reason: (c,) how the test ended, a `Reason` each.
        displacement: (c,) largest distance of the centre of mass from its place after closing [m].
        closing_shift: (c,) displacement of the centre of mass by closing [m].
        penetration: (c,) largest penetration depth of hand and object in the simulation, from the end of closing
            on [m].
        part_force: (c, parts) contact force on palm and fingers after closing: sum over the contact points of the
            impulse's magnitude divided by the duration of the step [N].
        label_force: (c, labels) the same sums by the region of the object in which the contact points lie [N].
        contacts: (c, k, 3) contact points that carry force after closing, in the object frame [m]; rows are padded
            with zeros.
        contact_finger: (c, k) their contact classes: 0 no contact, 1 palm, 2 thumb, ... 6 pinky.
        candidate_penetration: (c,) penetration depth of hand and object at the candidate, by geometry [m].
        self_penetration: (c,) penetration depth between links of the hand at the candidate, by geometry [m].
        test_settings: settings of the test.
        direction: (c,) index into `DIRECTIONS` of the gravity under which the test ended; -1 if it ended under none,
            None if that is not known.
    """

    reason: Int[Tensor, " c"]
    displacement: Float[Tensor, " c"]
    closing_shift: Float[Tensor, " c"]
    penetration: Float[Tensor, " c"]
    part_force: Float[Tensor, "c parts"]
    label_force: Float[Tensor, "c labels"]
    contacts: Float[Tensor, "c k 3"]
    contact_finger: Int[Tensor, "c k"]
    candidate_penetration: Float[Tensor, " c"]
    self_penetration: Float[Tensor, " c"]
    test_settings: GraspTestSettings
    direction: Int[Tensor, " c"] | None = None

    @property
    def passed(self) -> Bool[Tensor, " c"]:
        """(c,) whether the simulated hand held the object under all directions."""
        return self.reason == Reason.PASSED

    @property
    def valid(self) -> Bool[Tensor, " c"]:
        """(c,) passed, and within the test's limit of the penetration depth at the candidate."""
        return self.passed & (self.candidate_penetration <= self.test_settings.penetration)

    @property
    def strict(self) -> Bool[Tensor, " c"]:
        """(c,) valid, and within the strict limits of self-penetration and of the displacement by closing."""
        tidy = self.self_penetration < self.test_settings.strict_self_penetration
        return self.valid & tidy & (self.closing_shift < self.test_settings.strict_shift)

    @property
    def touched(self) -> Bool[Tensor, "c parts"]:
        """(c, parts) whether palm and fingers carried force after closing."""
        return self.part_force > 0

    @property
    def dominant_region(self) -> Int[Tensor, " c"]:
        """(c,) index of the region with the largest contact force after closing; -1 without force."""
        return torch.where(self.label_force.sum(1) > 0, self.label_force.argmax(1), -1)


class ShakeTest:
    """Simulates candidates one after the other in one scene; arguments as for `validate`."""

    def __init__(
        self, obj: AffordanceObject, robot: RobotDescription, test_settings: GraspTestSettings, physics: Physics
    ):
        self.test_settings, self.physics = test_settings, physics
        self.weight = obj.mass * test_settings.gravity
        self.scene = GraspTestScene(obj, robot, test_settings.friction, physics)

    def __call__(self, case: Case) -> Trial:
        """Closes the hand and, unless the object was thrown, applies gravity along all directions."""
        self.scene.place(case.position, case.quaternion)
        self.scene.hand.reset(case.pregrasp)
        shift = self._close(case)
        if not shift < THROWN_SHIFT:
            return Trial(Reason.THROWN, 0.0, shift, 0.0, None)
        touch = self.scene.read_contacts()
        reason, displacement, depth, direction = self._shake(case)
        return Trial(reason, displacement, shift, max(touch.depth, depth), touch.in_frame(self.start), direction)

    def _close(self, case: Case) -> float:
        """Moves the command from the opened to the squeezing posture; returns the object's displacement [m]."""
        scene, test_settings = self.scene, self.test_settings
        steps, look = self.physics.steps(test_settings.closing_time), self.physics.steps(DISPLACEMENT_INTERVAL)
        moving = max(1, round(test_settings.ramp * steps))
        shift, change = 0.0, case.grasp - case.pregrasp
        scene.damp(test_settings.closing_damping)
        for step in range(1, steps + 1):
            if step <= moving:
                scene.hand.command(case.pregrasp + step / moving * change)
            scene.step()
            if step % look == 0 or step == steps:
                shift = float(np.linalg.norm(scene.position - case.position))
                if not shift < THROWN_SHIFT:
                    break
        scene.damp(0.0)
        self.start = scene.pose
        return shift

    def _shake(self, case: Case) -> tuple[Reason, float, float, int]:
        """Applies gravity along all directions; returns how it ended, displacement and depth [m], and the direction."""
        scene, physics = self.scene, self.physics
        turn = matrix_from_quaternion(torch.tensor(case.quaternion)).numpy()
        origin, farthest, depth = self.start.p, 0.0, 0.0
        push, step = scene.push, scene.step
        looks = max(1, round(self.test_settings.duration / DISPLACEMENT_INTERVAL))
        for index, direction in enumerate(DIRECTIONS):
            force = (turn @ np.array(direction) * self.weight).astype(np.float32)
            for look in range(1, looks + 1):
                for _ in range(physics.steps(self.test_settings.duration / looks)):
                    push(force)
                    step()
                farthest = max(farthest, float(np.linalg.norm(scene.position - origin)))
                if not farthest <= self.test_settings.displacement:
                    return Reason.SLIPPED, farthest, depth, index
                if look % round(CONTACT_INTERVAL / DISPLACEMENT_INTERVAL) == 0 or look == looks:
                    touch = scene.read_contacts()
                    depth = max(depth, touch.depth)
            if not touch.in_contact:
                return Reason.RELEASED, farthest, depth, index
        return Reason.PASSED, farthest, depth, -1


def validate(
    candidates: GraspCandidates,
    obj: AffordanceObject,
    robot: RobotDescription,
    test_settings: GraspTestSettings = STANDARD,
    physics: Physics | None = None,
    processes: int | None = None,
    progress: Progress | None = None,
) -> Validation:
    """Tests every candidate in SAPIEN.

    Equal candidates give equal results except in rare borderline cases: PhysX keeps contacts of the grasp before, which
    changes the last bits.

    Args:
        candidates: c candidates of this object and this robot.
        obj: the object.
        robot: the robot whose hand is simulated with a fixed palm, without the arm.
        test_settings: settings of the test.
        physics: resolution of the simulation; the default if None.
        processes: number of processes, one per core by default; 1 stays in this process.
        progress: called with the number of candidates done and their total.

    Raises:
        InputError: the candidates are of another object.
        WorkerFailure: a simulating process died or hangs.
    """
    candidates.check_fits("the set", obj, None, stored=False)
    trials = run_cases(
        ShakeTest, (obj, robot, test_settings, physics or Physics()), _cases(candidates), processes, progress
    )
    parts = 1 + len(robot.fingers)
    contacts = [trial.touch for trial in trials]
    points, finger = _pressed(contacts)
    numbers = torch.tensor([(t.displacement, t.closing_shift, t.penetration) for t in trials])
    return Validation(
        reason=torch.tensor([int(trial.reason) for trial in trials]),
        displacement=numbers[:, 0],
        closing_shift=numbers[:, 1],
        penetration=numbers[:, 2],
        part_force=torch.tensor(np.array([_part_force(touch, parts) for touch in contacts]), dtype=torch.float32),
        label_force=_label_force(contacts, obj),
        contacts=points,
        contact_finger=finger,
        candidate_penetration=candidates.penetration.cpu(),
        self_penetration=candidates.self_penetration.cpu(),
        test_settings=test_settings,
        direction=torch.tensor([trial.direction for trial in trials]),
    )


def _cases(candidates: GraspCandidates) -> list[Case]:
    """Cases of all candidates: the object's pose in the wrist frame inverts the wrist's pose in the object frame."""
    turn = quaternion_inverse(candidates.quaternion)
    fields = quaternion_apply(turn, -candidates.position), turn, candidates.pregrasp, candidates.grasp
    return [Case(*row) for row in zip(*(field.cpu().numpy() for field in fields), strict=True)]


def _part_force(touch: HandContacts | None, parts: int) -> np.ndarray:
    return np.zeros(parts) if touch is None else touch.by_part(parts)


def _pressed(contacts: list[HandContacts | None]) -> tuple[Float[Tensor, "c k 3"], Int[Tensor, "c k"]]:
    """Contact points that carry force and their contact classes, padded to the largest number of them."""
    pressing = [np.zeros(0, np.int64) if touch is None else np.flatnonzero(touch.force > 0) for touch in contacts]
    most = max(map(len, pressing))
    points, finger = torch.zeros(len(contacts), most, 3), torch.zeros(len(contacts), most, dtype=torch.long)
    for row, (touch, index) in enumerate(zip(contacts, pressing, strict=True)):
        if touch is not None:
            points[row, : len(index)] = torch.tensor(touch.point[index], dtype=torch.float32)
            finger[row, : len(index)] = torch.tensor(1 + touch.part[index])
    return points, finger


def _label_force(contacts: list[HandContacts | None], obj: AffordanceObject) -> Float[Tensor, "c labels"]:
    """Force by region [N]; a contact point belongs to the region of the surface point nearest to it."""
    found = torch.zeros(len(contacts), len(obj.labels))
    known = [(row, touch) for row, touch in enumerate(contacts) if touch is not None and len(touch.part)]
    if known:
        points = torch.tensor(np.concatenate([touch.point for _, touch in known]), dtype=torch.float32)
        force = torch.tensor(np.concatenate([touch.force for _, touch in known]), dtype=torch.float32)
        row = torch.tensor(np.repeat([row for row, _ in known], [len(touch.part) for _, touch in known]))
        _, label = map_of(obj, "cpu").nearest(points, 1)
        found.index_put_((row, label[:, 0]), force, accumulate=True)
    return found
