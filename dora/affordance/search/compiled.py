"""The grasp energy and its descent compiled for a CPU; `GraspEnergy` and `Descent` define what they compute."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.objects.signed_distance import CULL, SignedDistanceField
from dora.affordance.search.descent import ADAM_EPSILON, MEAN_DECAY, SQUARE_DECAY, Descent, Rows, Schedule
from dora.affordance.search.energies import RAMPED, TERMS, Evaluation, GraspEnergy
from dora.affordance.search.native.energy import Adam, descend, evaluate
from dora.affordance.search.native.field import FieldArrays
from dora.affordance.search.native.hand import HandArrays


class CompiledEnergy(GraspEnergy):
    """`GraspEnergy` in compiled loops on a CPU; arguments and results are the same."""

    def __call__(
        self,
        wrist: Float[Tensor, "c 4 4"],
        joints: Float[Tensor, "c a"],
        contacts: Int[Tensor, "c k"],
        ramp: float = 1.0,
    ) -> Evaluation:
        """Evaluate the energy and its gradient, as `GraspEnergy.__call__`."""
        weights = self.factors(ramp)
        terms, gradient = evaluate(
            self.arrays, self.field_arrays, weights, self.plane(), wrist.numpy(), joints.numpy(), contacts.numpy()
        )
        value = torch.from_numpy(terms).to(joints)
        gradients = torch.from_numpy(gradient).to(joints)
        total = value @ value.new_tensor(weights)
        return Evaluation(
            total, {name: value[:, TERMS.index(name)] for name in self.names}, gradients[:, :6], gradients[:, 6:]
        )

    def factors(self, ramp: float) -> np.ndarray:
        """Weights (terms,) of all terms, those in `RAMPED` multiplied by `ramp`."""
        return np.array(list(self.ramped_weights(ramp).values()))

    def plane(self) -> np.ndarray:
        """(4,) normal and offset [m] of the table in the object frame; an infinite offset if there is no table."""
        normal, offset = ((0.0, 0.0, 0.0), math.inf) if self.table is None else (self.table.normal, self.table.offset)
        return np.array([*normal, offset])

    @cached_property
    def field_arrays(self) -> FieldArrays:
        """The object's distance field as arrays for compiled functions."""
        return _field_arrays(self.field)

    @cached_property
    def arrays(self) -> HandArrays:
        """The hand as arrays for compiled functions."""
        hand, numbers = self.hand, {}
        leader = hand.joint_gain.abs().argmax(1)
        tensors = {
            "constant": hand.constant.flatten(0, 1),
            "cosine": hand.cosine.flatten(0, 1),
            "sine": hand.sine.flatten(0, 1),
            "axes": hand.axes,
            "gain": hand.joint_gain.gather(1, leader[:, None])[:, 0],
            "offset": hand.joint_offset,
            "lower": hand.joint_lower,
            "upper": hand.joint_upper,
            "close": self.close,
            "contact_local": hand.contacts.local,
            "sphere_local": hand.spheres.local,
            "sphere_radius": hand.sphere_radius,
            "sphere_reach": self.skin,
            "ends": hand.ends.local,
            "radius": hand.radius,
            "bound": self._bound[hand.pairs[:, 0], hand.pairs[:, 1]],
        }
        indices = {
            "leader": leader,
            "contact_body": hand.contacts.body,
            "sphere_body": hand.spheres.body,
            "capsule_body": self._capsule_body,
            "pairs": hand.pairs,
        }
        numbers |= {name: np.ascontiguousarray(tensor.double().numpy()) for name, tensor in tensors.items()}
        numbers |= {name: np.ascontiguousarray(tensor.long().numpy()) for name, tensor in indices.items()}
        return HandArrays(depth=hand.depth, **numbers)


class CompiledDescent(Descent):
    """`Descent` in compiled loops: each row takes all its steps before the next row begins."""

    energy: CompiledEnergy

    def __call__(self, rows: Rows, schedule: Schedule) -> None:
        """Move rows in place, as `Descent.__call__`."""
        energy = self.energy
        factors = np.array([energy.factors(ramp) for ramp in schedule.ramp])
        adam = self.adam(schedule.size, schedule.before)
        arrays = (part.numpy() for part in (rows.wrist, rows.joints, rows.contacts, rows.mean, rows.square))
        terms = descend(energy.arrays, energy.field_arrays, factors, energy.plane(), adam, *arrays)
        ramped = [TERMS.index(name) for name in RAMPED]
        rows.total = torch.from_numpy(terms @ factors[-1]).to(rows.joints)
        rows.overlap = torch.from_numpy(terms[:, ramped].sum(1)).to(rows.joints)

    def adam(self, size: list[float], before: int = 0) -> Adam:
        """Settings of Adam for compiled functions; `size` has the share of the largest step for each step."""
        return Adam(self.largest.double().numpy(), np.array(size), before, MEAN_DECAY, SQUARE_DECAY, ADAM_EPSILON)


def _field_arrays(field: SignedDistanceField) -> FieldArrays:
    table = np.ascontiguousarray(field.table.numpy())
    x, y, z = field.shape
    return FieldArrays(
        table=table,
        distance=np.ascontiguousarray(table[:, 0]),
        shape=(x, y, z),
        lower=tuple(field.lower.tolist()),
        inverse=1 / field.spacing,
        cull=CULL * field.spacing,
    )
