"""The guide of one arm: its candidates, the reference that follows them, and the residual action."""

from collections.abc import Callable, Iterable

from jaxtyping import Float, Int
from torch import Tensor

from dora.errors import InputError
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.guidance.reference import Reference
from dora.tasks.guidance.residual_action import ResidualAction, Target
from dora.tasks.mdp.snapshot import Snapshot


class Guide:
    """The parts of guidance that an arm has in force, and what they work with.

    Args:
        parts: which of `dora.tasks.mdp.guidance_parts.PARTS`.
        choice: the candidates in use.
        reference: leads the hand.
        residual: what the action does to the reference.
    """

    def __init__(self, parts: Iterable[str], choice: CandidateChoice, reference: Reference, residual: ResidualAction):
        self.parts = frozenset(parts)
        self.choice, self.reference, self.residual = choice, reference, residual

    def begin(self, rows: Int[Tensor, " b"], wrist_p: Float[Tensor, "b 3"], wrist_q: Float[Tensor, "b 4"]) -> None:
        """Starts reference and residual anew in the environments `rows`, whose candidates have been chosen."""
        self.reference.begin(rows, wrist_p, wrist_q)
        self.residual.begin(rows)

    def target(self, s: Snapshot, action: Float[Tensor, "n a"], expand: Callable[[Tensor], Tensor]) -> Target:
        """Where the hand goes in the next control step; `expand` maps the action's hand part to all hand joints."""
        reference = self.reference
        target = self.residual.apply(reference.target(s), action.clamp(-1, 1), expand, reference.freedom())
        reference.aim(target)
        return target

    def anneal(self, bounds: float | None = None, error: float | None = None) -> None:
        """Sets the shares of the residual's bounds and of the candidates' error that are in force from now on.

        Raises:
            InputError: for a share outside [0, 1].
        """
        if bounds is not None:
            self.residual.set_scale(bounds)
        if error is not None:
            if not 0 <= error <= 1:
                raise InputError(f"the share of the candidates' error is {error}; it has to be between 0 and 1")
            self.choice.error_scale = error

    def get_state(self) -> dict[str, Tensor]:
        """Everything that changes during an episode, each (n, ...), for state dicts."""
        return self.choice.buffers.get_state() | self.reference.get_state() | self.residual.buffers.get_state()

    def state_ranges(self) -> dict[str, tuple[float, float]]:
        """Smallest and largest value of some of what `get_state` returns."""
        return self.reference.phase.state_ranges() | {"chosen": (0.0, float(len(self.choice.candidates) - 1))}

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows."""
        self.choice.buffers.set_state(state, rows)
        self.reference.set_state(state, rows)
        self.residual.buffers.set_state(state, rows)
