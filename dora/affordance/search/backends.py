"""Which code evaluates and descends the grasp energy: compiled loops, or torch functions on pytorch_kinematics."""

from __future__ import annotations

from typing import Any, Literal, get_args

from dora.affordance.objects.affordance_object import AffordanceObject
from dora.affordance.search.cache import chain_hand_of, field_of, hand_of
from dora.affordance.search.compiled import CompiledDescent, CompiledEnergy
from dora.affordance.search.descent import Descent
from dora.affordance.search.differentiable import DifferentiableDescent, DifferentiableEnergy
from dora.affordance.search.energies import GraspEnergy, Table, Weights
from dora.affordance.search.torch_energies import ExtraEnergies
from dora.errors import InputError
from dora.robot import RobotDescription

Kinematics = Literal["compiled", "pytorch_kinematics"]
"""Where link poses and gradients come from: loops compiled by Numba with gradients by hand, or pytorch_kinematics with
automatic differentiation."""


def check_kinematics(kinematics: str, extra: ExtraEnergies | None) -> None:
    """Refuse a choice that there is not.

    Raises:
        InputError: unknown kinematics, or energies of a user in compiled loops.
    """
    if kinematics not in get_args(Kinematics):
        raise InputError(f"unknown kinematics {kinematics!r}; choose one of: {', '.join(get_args(Kinematics))}.")
    if extra and kinematics == "compiled":
        raise InputError(
            f'the compiled energy takes no energies of yours ({", ".join(extra)}): add kinematics="pytorch_kinematics".'
        )


def energy_of(
    kinematics: str,
    obj: AffordanceObject,
    robot: RobotDescription,
    region: str | None,
    device: str,
    weights: Weights,
    table: Table | None,
    extra: ExtraEnergies | None = None,
) -> GraspEnergy:
    """The grasp energy of an object by one of `Kinematics`, with `region` to be held unless None.

    Compiled loops are for a CPU; on another device their gradients by hand are evaluated in torch.
    """
    field = field_of(obj, region, device)
    if kinematics == "pytorch_kinematics":
        return DifferentiableEnergy(chain_hand_of(robot, device), field, weights, table, extra)
    hand = hand_of(robot, device)
    return (CompiledEnergy if hand.device.type == "cpu" else GraspEnergy)(hand, field, weights, table)


def closing_model_of(
    energy: GraspEnergy, obj: AffordanceObject, robot: RobotDescription, region: str | None
) -> CompiledEnergy:
    """What the quasi-static closing, which is compiled, takes hand, object and table of an energy from."""
    if isinstance(energy, CompiledEnergy):
        return energy
    return CompiledEnergy(hand_of(robot, "cpu"), field_of(obj, region, "cpu"), energy.weights, energy.table)


def descent_of(energy: GraspEnergy) -> type[Descent]:
    """The descent that suits an energy."""
    if isinstance(energy, CompiledEnergy):
        return CompiledDescent
    return DifferentiableDescent if isinstance(energy, DifferentiableEnergy) else Descent


def _name_of(function: Any) -> str:
    """Module and name of a function, or of the class of what is called like one."""
    named = function if hasattr(function, "__qualname__") else type(function)
    return f"{named.__module__}.{named.__qualname__}"


def described(kinematics: str, extra: ExtraEnergies | None) -> str:
    """What follows the settings in the text that goes with candidates; nothing for compiled loops."""
    if kinematics == "compiled":
        return ""
    energies = [f", {name}={weight!r}*{_name_of(function)}" for name, (weight, function) in (extra or {}).items()]
    return f" kinematics={kinematics!r}{''.join(energies)}"
