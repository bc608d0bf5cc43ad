"""What a task remembers during an episode, one row per environment."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dora.sim.contacts import Contacts

OBJECT, WORLD = 6, 7
"""Places of object and world among the contact groups, after five fingers and the palm."""


class Episode:
    """Buffers (n, ...) allocated once and written by rows.

    `start_p` [m]; `highest` rise of the object so far [m]; `touch`, `supported` (0 or 1); `force` [N]; `penetration`,
    `deepest` [m]; `mass` [kg]; `friction`;
    `contact_p` [m] and `contact_finger` of up to `points` contact points, in the object frame; the last two actions.
    """

    def __init__(self, num_envs: int, action_size: int, points: int, device: torch.device):
        def zeros(*shape: int) -> Tensor:
            return torch.zeros(num_envs, *shape, device=device)

        self.start_p, self.highest = zeros(3), zeros()
        self.touch, self.force, self.supported = zeros(6), zeros(6), zeros()
        self.penetration, self.max_penetration = zeros(), zeros()
        self.mass, self.friction = zeros(), zeros()
        self.contact_p, self.contact_finger = zeros(points, 3), zeros(points)
        self.action, self.previous_action = zeros(action_size), zeros(action_size)

    def begin(self, rows: Int[Tensor, " b"], start_p: Float[Tensor, "b 3"]) -> None:
        """Clears the rows of environments that start anew at the object position `start_p` [m]."""
        for name, buffer in vars(self).items():
            if name not in ("mass", "friction"):
                buffer[rows] = 0.0
        self.start_p[rows] = start_p

    def record_contacts(self, contacts: Contacts, frequency: int) -> None:
        """Takes over the contacts of the last physics step, which lasted 1 / `frequency` [Hz]."""
        force = contacts.impulse[:, :OBJECT, OBJECT].norm(dim=-1) * frequency
        depth = (-contacts.separation).clamp(min=0)
        hand = depth[:, :OBJECT, OBJECT:].flatten(1).amax(-1)
        self.force.copy_(force)
        self.touch.copy_(force > 0)
        self.supported.copy_(contacts.impulse[:, OBJECT, WORLD].square().sum(-1) > 0)
        self.penetration.copy_(torch.maximum(hand, depth[:, OBJECT, WORLD]))
        torch.maximum(self.max_penetration, self.penetration, out=self.max_penetration)

    def record_points(self, position: Float[Tensor, "n m 3"], finger: Int[Tensor, "n m"]) -> None:
        """Takes over the contact points of the last physics step, object frame [m]; finger 0 marks an empty row."""
        self.contact_p.copy_(position)
        self.contact_finger.copy_(finger)

    def record_rise(self, rise: Float[Tensor, " n"]) -> None:
        """Takes note of the object's present height above its start [m]."""
        torch.maximum(self.highest, rise, out=self.highest)

    def record_action(self, action: Float[Tensor, "n a"]) -> None:
        """Shifts the action history by one."""
        self.previous_action.copy_(self.action)
        self.action.copy_(action)

    def get_state(self) -> dict[str, Tensor]:
        """Copies of all buffers by name."""
        return {name: buffer.clone() for name, buffer in vars(self).items()}

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows."""
        for name, buffer in vars(self).items():
            buffer[rows] = state[name].reshape(buffer[rows].shape)
