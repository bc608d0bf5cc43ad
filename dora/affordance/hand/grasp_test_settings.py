"""Numbers of the grasp test: what a candidate has to withstand in simulation, fixed before anything was tuned.

A candidate is a posture in contact. The hand starts with slightly opened fingers, closes beyond the posture so that
its drives squeeze, and must then hold the object under gravity from six directions. docs/validation.md describes the
whole test; `dora.affordance.hand.postures` has the postures, `dora.sim.grasp_tests.shake_test` the simulation.
"""

from dataclasses import dataclass, fields

from dora.errors import InputError

DIRECTIONS = ((0.0, 0.0, -1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0))
"""Directions of gravity in the object frame at the candidate, one after the other, as unit vectors."""


@dataclass(frozen=True)
class GraspTestSettings:
    """Numbers of the grasp test, the same for every object.

    Attributes:
        opening: angle by which the flexing joints are opened before closing [rad].
        squeeze: command of the flexing joints beyond contact [rad]. It is the same for all joints: the stiffness of
            the drives falls towards the fingertip as the lever arm does, so equal angles give about equal forces.
        closing_time: time from the open hand to the first gravity [s]; the object is weightless in it.
        closing_damping: rate at which the object's velocity decays while the hand closes [1/s]. It stands for the
            friction of the support on which the object rests, so that the first contact does not throw the object.
        ramp: share of the closing time in which the command moves, linearly; then it stays constant [1].
        friction: Coulomb coefficient between hand and object, set on both materials [1].
        gravity: acceleration along each of `DIRECTIONS` [m/s^2].
        duration: time under each direction [s].
        displacement: largest distance of the object's centre of mass from its place after closing [m].
        penetration: largest penetration depth of hand and object at the candidate, by geometry alone [m].
        strict_self_penetration: largest penetration depth between links of the hand at a strictly valid candidate [m].
        strict_shift: largest displacement of the centre of mass by closing, for a strictly valid candidate [m].

    Raises:
        InputError: a number is not positive, or `ramp` is above 1.
    """

    opening: float = 0.2
    squeeze: float = 0.3
    closing_time: float = 0.5
    closing_damping: float = 20.0
    ramp: float = 0.7
    friction: float = 0.7
    gravity: float = 9.81
    duration: float = 1.0
    displacement: float = 0.02
    penetration: float = 0.002
    strict_self_penetration: float = 0.002
    strict_shift: float = 0.02

    def __post_init__(self) -> None:
        for field in fields(self):
            if not getattr(self, field.name) > 0:
                raise InputError(f"{field.name} of the grasp test must be a positive number; correct it.")
        if self.ramp > 1:
            raise InputError(f"ramp of the grasp test is a share of the closing time, not {self.ramp}; use at most 1.")


STANDARD = GraspTestSettings()
"""The settings behind every number in the docs."""
