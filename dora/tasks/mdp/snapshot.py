"""What a task reads from the simulator: one frozen record per control step, world frame, SI units.

A scene has hands (each with its arm), objects, and for each arm a goal: what the chosen grasp candidate asks for.
With one arm, `s.hand`, `s.object` and `s.goal` are the only ones. With several, `s.of("left")` is the same snapshot as
one arm sees it: its hand, the object it handles, its goal. So functions of a snapshot serve both.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import wraps
from typing import Any, TypeVar

from jaxtyping import Bool, Float, Int
from torch import Tensor

from dora.geometry.poses import Pose

FINGERS = ("thumb", "index", "middle", "ring", "pinky")
"""Finger order of every tensor with a finger axis; a robot's fingers are in this order."""
CONTACT_CLASSES = ("none", "palm", *FINGERS)
"""Names of the values of `HandState.contact_finger`."""
DERIVED, FROM_CONTACTS = "_derived", "_from_contacts"
"""Where a snapshot keeps what `derived` and `derived_from_contacts` functions have computed."""
VIEWS, FORMER = "_views", "_former_views"
"""Where it keeps what its arms see, and what they saw in the snapshot from which it was made, with what is shared."""


@dataclass(frozen=True)
class HandState:
    """One hand, its arm, and its contacts with the object that it handles.

    Poses are (position [m], quaternion wxyz) in the world.

    Attributes:
        arm_q: arm joints [rad].
        q, v: measured hand joints [rad], [rad/s].
        target: commanded hand joints [rad].
        wrist_p, wrist_q, wrist_v, wrist_w: pose, linear [m/s] and angular velocity [rad/s] of the hand's base.
        tip_p, tip_q: fingertip poses.
        tip_radius: radius of the fingertips [m].
        touch: contact of each finger, then the palm, with the object during the last physics step, or during all of
            the control step where the task asks for that (the hammer's).
        force: magnitude of those contacts' forces, their mean over that time [N].
        contact_p: contact points of the hand on the object in the last physics step, object frame [m].
        contact_finger: what touches there: 0 nothing (an empty row), 1 palm, 2 thumb, ... 6 pinky.
    """

    arm_q: Float[Tensor, "n arm"]
    q: Float[Tensor, "n hand"]
    v: Float[Tensor, "n hand"]
    target: Float[Tensor, "n hand"]
    wrist_p: Float[Tensor, "n 3"]
    wrist_q: Float[Tensor, "n 4"]
    wrist_v: Float[Tensor, "n 3"]
    wrist_w: Float[Tensor, "n 3"]
    tip_p: Float[Tensor, "n fingers 3"]
    tip_q: Float[Tensor, "n fingers 4"]
    tip_radius: float
    touch: Bool[Tensor, "n parts"]
    force: Float[Tensor, "n parts"]
    contact_p: Float[Tensor, "n points 3"]
    contact_finger: Int[Tensor, "n points"]


@dataclass(frozen=True)
class ObjectState:
    """One object.

    Attributes:
        p, q, v, w: pose in the world, linear [m/s] and angular velocity [rad/s].
        half: half extents of the object's box, or of its bounding box [m].
        start_p: position at the start of the episode [m].
        supported: the object touches the world (table, stand).
    """

    p: Float[Tensor, "n 3"]
    q: Float[Tensor, "n 4"]
    v: Float[Tensor, "n 3"]
    w: Float[Tensor, "n 3"]
    half: Float[Tensor, "n 3"]
    start_p: Float[Tensor, "n 3"]
    supported: Bool[Tensor, " n"]


@dataclass(frozen=True)
class GoalState:
    """What the grasp candidates of one arm ask for now (they follow the object), and what the arm's reference does.

    Attributes:
        p, q: wrist pose that the chosen candidate asks for, world frame.
        approach: unit direction of the wrist's last motion towards it, world frame.
        pregrasp, grasp: hand joints of that candidate [rad].
        nearest_p, nearest_q: the same wrist poses for the nearest reachable candidates, the chosen one first.
        phase: the reference's phase, one-hot.
        residual: low-passed residual action, in units of its bounds.
        correction: the residual that undoes the error of the chosen candidate, in units of its bounds; None unless it
            is observed.
    """

    p: Float[Tensor, "n 3"]
    q: Float[Tensor, "n 4"]
    approach: Float[Tensor, "n 3"]
    pregrasp: Float[Tensor, "n hand"]
    grasp: Float[Tensor, "n hand"]
    nearest_p: Float[Tensor, "n k 3"]
    nearest_q: Float[Tensor, "n k 4"]
    phase: Float[Tensor, "n phases"]
    residual: Float[Tensor, "n a"]
    correction: Float[Tensor, "n a"] | None = None


Record = TypeVar("Record")


@dataclass(frozen=True)
class Snapshot:
    """State of n environments after a control step.

    Attributes:
        hands, goals: by the name of the arm.
        objects: by their names.
        handles: name of the object that each arm handles.
        penetration: largest overlap of robots and objects with each other, with themselves and with the world, in any
            physics step of the last control step [m].
        max_penetration: the same, maximum over the episode [m].
        stage: index of the active stage; the number of stages when all are done. Where arms have stages of their own,
            the number of those that are done, of all arms.
        stages: index of the active stage of each arm that has stages of its own, by its name.
        time: share of the episode that is over, 0 to 1.
        action, previous_action: last two actions, as given.
    """

    hands: Mapping[str, HandState]
    objects: Mapping[str, ObjectState]
    goals: Mapping[str, GoalState]
    handles: Mapping[str, str]
    penetration: Float[Tensor, " n"]
    max_penetration: Float[Tensor, " n"]
    stage: Int[Tensor, " n"]
    stages: Mapping[str, Int[Tensor, " n"]]
    time: Float[Tensor, " n"]
    action: Float[Tensor, "n a"]
    previous_action: Float[Tensor, "n a"]

    @property
    def hand(self) -> HandState:
        """The only hand; ValueError if there are several."""
        return _only(self.hands, "hands")

    @property
    def object(self) -> ObjectState:
        """The only object; ValueError if there are several."""
        return _only(self.objects, "objects")

    @property
    def goal(self) -> GoalState:
        """The goal of the only arm; ValueError if there are several."""
        return _only(self.goals, "goals")

    def of(self: "S", arm: str) -> "S":
        """The same state as one arm sees it: its hand, the object that it handles, its goal, its stage; made once."""
        if len(self.hands) == len(self.objects) == 1:
            return self
        views = self.__dict__.setdefault(VIEWS, {})
        if arm not in views:
            name = self.handles[arm]
            view = replace(
                self,
                hands={arm: self.hands[arm]},
                objects={name: self.objects[name]},
                goals={arm: self.goals[arm]},
                handles={arm: name},
                stage=self.stages.get(arm, self.stage),
            )
            former, shared = self.__dict__.get(FORMER, ({}, ()))
            views[arm] = _sharing(former[arm], view, *shared) if arm in former else view
        return views[arm]

    def reobserved(self: "S", located: Callable[[Pose], Pose]) -> "S":
        """The same with what a task added in `extended`, after noise was added to hands and objects; itself here.

        Args:
            located: pose of a body that stands still -> the same as it is observed, with one error in all steps of an
                episode.
        """
        return self


def _only(records: Mapping[str, Record], what: str) -> Record:
    if len(records) != 1:
        raise ValueError(f"there are the {what} {', '.join(records)}: name one, or look through `snapshot.of(arm)`")
    return next(iter(records.values()))


S = TypeVar("S", bound=Snapshot)
"""A snapshot, perhaps one that a task has extended."""
Derived = Callable[..., Any]


def derived(function: Derived) -> Derived:
    """Computes a quantity of a snapshot once, however many terms, stages and observations ask for it.

    Further arguments must be hashable (a task's configuration); the quantity is kept for each set of them. It must not
    depend on `stage`, `phase` or `time`, which alone change when the machines advance.
    """
    return _once(function, DERIVED)


def derived_from_contacts(function: Derived) -> Derived:
    """The same for a quantity of contacts and the object's size alone, which the noise of sensors leaves as it is."""
    return _once(function, FROM_CONTACTS)


def _once(function: Derived, place: str) -> Derived:
    @wraps(function)
    def once(s: Snapshot, *settings: Any) -> Any:
        known = s.__dict__.setdefault(place, {})
        key = (function, *settings)
        if key not in known:
            known[key] = function(s, *settings)
        return known[key]

    return once


def extended(s: Snapshot, kind: type[S], **more: Any) -> S:
    """The snapshot as one of a subclass, with the fields that it adds."""
    own: dict[str, Any] = {f.name: getattr(s, f.name) for f in fields(s)}
    return kind(**own, **more)


def advanced(s: S, stage: Tensor, stages: Mapping[str, Tensor], phases: Mapping[str, Tensor]) -> S:
    """The snapshot with other stages and other phases of the references (by arm); what was derived stays."""
    goals = {arm: replace(goal, phase=phases[arm]) for arm, goal in s.goals.items()}
    return _sharing(s, replace(s, stage=stage, stages=stages, goals=goals), DERIVED, FROM_CONTACTS)


def corrected(s: S, corrections: Mapping[str, Tensor]) -> S:
    """The snapshot with the exact correction of each arm's candidate, (n, a) by arm; what was derived stays."""
    goals = {arm: replace(goal, correction=corrections[arm]) for arm, goal in s.goals.items()}
    return _sharing(s, replace(s, goals=goals), DERIVED, FROM_CONTACTS)


def observed(
    s: S,
    hands: Mapping[str, HandState],
    objects: Mapping[str, ObjectState],
    goals: Mapping[str, GoalState],
    located: Callable[[Pose], Pose],
) -> S:
    """The snapshot with noise in poses and joints; what was derived from contacts alone stays. `located` is that of
    `Snapshot.reobserved`."""
    noisy = replace(s, hands=hands, objects=objects, goals=goals).reobserved(located)
    return _sharing(s, noisy, FROM_CONTACTS)


def _sharing(old: S, new: S, *places: str) -> S:
    for place in places:
        new.__dict__[place] = old.__dict__.setdefault(place, {})
    new.__dict__[FORMER] = old.__dict__.get(VIEWS, {}), places
    return new
