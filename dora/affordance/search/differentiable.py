"""The grasp energy and its descent by automatic differentiation: torch functions, `backward()` and torch's Adam."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.signed_distance import SignedDistanceField
from dora.affordance.search.descent import ADAM_EPSILON, MEAN_DECAY, SQUARE_DECAY, Descent, Rows, Schedule, overlap
from dora.affordance.search.energies import TERMS, Evaluation, GraspEnergy, Table, Weights
from dora.affordance.search.grasp_state import GraspState
from dora.affordance.search.torch_energies import ENERGIES, ExtraEnergies
from dora.errors import InputError
from dora.parallel import one_thread


class DifferentiableEnergy(GraspEnergy):
    """`GraspEnergy` by automatic differentiation, and any further energies; it runs where its hand and field are.

    Args:
        hand: the hand; `ChainHand` has its kinematics by pytorch_kinematics.
        field: the object's distance field, with a region channel if a region is to be held.
        weights: weights of the terms; the defaults if None.
        table: the table on which the object rests; None if it is free.
        extra: energies of a user, added to the terms with constant weights.

    Raises:
        InputError: a further energy has the name of a term, or a weight that is not finite.
    """

    def __init__(
        self,
        hand: HandModel,
        field: SignedDistanceField,
        weights: Weights | None = None,
        table: Table | None = None,
        extra: ExtraEnergies | None = None,
    ) -> None:
        super().__init__(hand, field, weights, table)
        self.extra = dict(extra or {})
        for name, (weight, _) in self.extra.items():
            if name in TERMS:
                raise InputError(f"the energy {name!r} exists; give yours another name.")
            if not math.isfinite(weight):
                raise InputError(f"the weight of the energy {name!r} is {weight}; give a finite number.")
        self._functions = {name: ENERGIES[name] for name in self.names}
        self._functions |= {name: function for name, (_, function) in self.extra.items()}

    @one_thread()
    def __call__(
        self,
        wrist: Float[Tensor, "c 4 4"],
        joints: Float[Tensor, "c a"],
        contacts: Int[Tensor, "c k"],
        ramp: float = 1.0,
    ) -> Evaluation:
        """Evaluate the energy and its gradient, as `GraspEnergy.__call__`; `terms` has the further energies, too."""
        with torch.enable_grad():
            move = joints.new_zeros(len(joints), 6 + joints.shape[1], requires_grad=True)
            total, terms = self.value(_turned(wrist, move), joints + move[:, 6:], contacts, ramp)
            total.sum().backward()
        gradient = self.checked(move.grad)
        values = {name: value.detach() for name, value in terms.items()}
        return Evaluation(total.detach(), values, gradient[:, :6], gradient[:, 6:])

    def value(
        self,
        wrist: Float[Tensor, "c 4 4"],
        joints: Float[Tensor, "c a"],
        contacts: Int[Tensor, "c k"],
        ramp: float = 1.0,
    ) -> tuple[Float[Tensor, " c"], dict[str, Float[Tensor, " c"]]]:
        """Weighted sum and unweighted terms by name, both differentiable; arguments as for `GraspEnergy.__call__`.

        Raises:
            InputError: a further energy returns anything but one finite number per candidate.
        """
        state = GraspState(self, wrist, joints, contacts)
        terms = {name: function(state) for name, function in self._functions.items()}
        for name in self.extra:
            _check_value(name, terms[name], len(joints))
        factor = self.ramped_weights(ramp) | {name: weight for name, (weight, _) in self.extra.items()}
        return torch.stack([factor[name] * value for name, value in terms.items()]).sum(0), terms

    def checked(self, gradient: Tensor | None) -> Tensor:
        """A gradient (c, m) that is finite.

        Raises:
            InputError: it is not, by a further energy.
        """
        assert gradient is not None
        if self.extra and not torch.isfinite(gradient).all():
            names = ", ".join(self.extra)
            raise InputError(f"the gradient with the energies {names} is not finite; mind roots and norms at zero.")
        return gradient


class DifferentiableDescent(Descent):
    """`Descent` by `torch.optim.Adam`; its parameters are moves in units of the largest step, so its rate is the share.

    After each step the moves are carried out and set to zero, so that rotations move along their tangent. Moments are
    those of the gradient in that unit.
    """

    energy: DifferentiableEnergy

    @one_thread()
    def __call__(self, rows: Rows, schedule: Schedule) -> None:
        """Move rows in place, as `Descent.__call__`."""
        move = torch.zeros_like(rows.mean, requires_grad=True)
        adam = torch.optim.Adam([move], betas=(MEAN_DECAY, SQUARE_DECAY), eps=ADAM_EPSILON)
        taken = torch.tensor(float(schedule.before))
        adam.state[move] = {"step": taken, "exp_avg": rows.mean, "exp_avg_sq": rows.square}
        for ramp, size in zip(schedule.ramp, schedule.size, strict=True):
            adam.param_groups[0]["lr"] = size
            adam.zero_grad()
            with torch.enable_grad():
                step = self.largest * move
                wrist, joints = _turned(rows.wrist, step), rows.joints + step[:, 6:]
                total, terms = self.energy.value(wrist, joints, rows.contacts, ramp)
                total.sum().backward()
            self.energy.checked(move.grad)
            rows.total, rows.overlap = total.detach(), overlap(terms).detach()
            adam.step()
            with torch.no_grad():
                rows.move(self.largest * move)
                move.zero_()


def _check_value(name: str, value: object, count: int) -> None:
    """Refuse what an energy of a user returned for `count` candidates, unless it is one finite number for each."""
    if not isinstance(value, Tensor) or value.shape != (count,):
        found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise InputError(f"the energy {name!r} returned {found}, not a tensor of shape ({count},).")
    if not torch.isfinite(value).all():
        raise InputError(f"the energy {name!r} returned a value that is not finite.")


def _turned(wrist: Tensor, move: Tensor) -> Tensor:
    """Wrist poses after moves (c, m) that are zero; exact to first order, so the gradient is that on the tangent."""
    turn = move[:, 3:6, None].expand(-1, 3, 3)
    rotation = wrist[:, :3, :3] + torch.linalg.cross(turn, wrist[:, :3, :3], dim=1)
    upper = torch.cat((rotation, (wrist[:, :3, 3] + move[:, :3]).unsqueeze(2)), 2)
    return torch.cat((upper, wrist[:, 3:]), 1)
