"""Every term of the grasp energy as a differentiable torch function of a `GraspState`.

`dora.affordance.search.energies` says what the terms are and has their gradients by hand; here automatic
differentiation finds the same ones. Energies of users are functions of this kind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.nn.functional import relu

from dora.affordance.search.energies import CLEARANCE, LENGTH, PALM_IMPORTANCE, PRESS, net_wrench
from dora.affordance.search.grasp_state import GraspState, sample

EnergyFunction = Callable[[GraspState], Tensor]
"""An energy: the value (c,) of every candidate, differentiable with respect to `GraspState.wrist` and `joints`."""
ExtraEnergies = Mapping[str, tuple[float, EnergyFunction]]
"""Energies of a user: weight, per unit of the energy, and function, by name."""


def closure(state: GraspState) -> Tensor:
    """E_DFC = ||G c||^2 [1]; psi in units of `LENGTH`."""
    force, torque = net_wrench(state.points / LENGTH, state.normals)
    return force.square().sum(-1) + torque.square().sum(-1)


def distance(state: GraspState) -> Tensor:
    """Sum over contact points of |d(psi)|, `PALM_IMPORTANCE` times on the palm [m]."""
    importance = torch.where(state.on_palm, PALM_IMPORTANCE, 1.0).to(state.joints)
    return (importance * state.distance.abs()).sum(1)


def region(state: GraspState) -> Tensor:
    """Sum over contact points of the distance to the region to be held [m]."""
    return state.region_distance.sum(1)


def closing(state: GraspState) -> Tensor:
    """Sum over finger points of (d(psi') + `PRESS`)+, psi' those of the hand that closes a little [m]."""
    miss = state.signed_distance(state.closed_points) + PRESS
    return (relu(miss) * ~state.on_palm).sum(1)


def penetration(state: GraspState) -> Tensor:
    """Sum over spheres of (r + `SKIN` - d)+ [m]; those far from the object are left out."""
    skin = state.energy.skin
    near = state.field.may_touch(state.centers.detach(), skin)
    depth = skin[near % len(skin)] - sample(state.field, state.centers.reshape(-1, 3)[near], 1)[:, 0]
    return depth.new_zeros(len(state.joints)).index_add(0, near // len(skin), relu(depth))


def table(state: GraspState) -> Tensor:
    """Sum over spheres of (r + `CLEARANCE` - height above the table)+ [m]; 0 without a table."""
    if state.table is None:
        return torch.zeros_like(state.joints[:, 0])
    height = state.centers @ state.centers.new_tensor(state.table.normal) + state.table.offset
    return relu(state.hand.sphere_radius + CLEARANCE - height).sum(1)


def limits(state: GraspState) -> Tensor:
    """Sum over all joints, coupled ones included, of the angle beyond a limit [rad]."""
    above, below = state.angles - state.hand.joint_upper, state.hand.joint_lower - state.angles
    return (relu(above) + relu(below)).sum(1)


def self_penetration(state: GraspState) -> Tensor:
    """Sum over capsule pairs that may collide of (r_a + r_b - distance of their axes)+ [m]."""
    row, _, _, _, gap = state.energy.close_pairs(state.poses)
    return gap.new_zeros(len(state.joints)).index_add(0, row, relu(-gap))


ENERGIES: dict[str, EnergyFunction] = {
    "closure": closure,
    "distance": distance,
    "region": region,
    "closing": closing,
    "penetration": penetration,
    "table": table,
    "limits": limits,
    "self_penetration": self_penetration,
}
"""The functions of `dora.affordance.search.energies.TERMS`; `Weights` has their weights."""
