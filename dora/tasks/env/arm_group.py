"""All arms of a task: the parts of an action, the commands of their controllers, and their references step by step."""

from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from dora.tasks.env.arm import Arm
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.mdp.snapshot import Snapshot


class ArmGroup(dict[str, Arm]):
    """The arms by name, in the order of their parts of an action."""

    @property
    def only(self) -> Arm:
        """The only arm; ValueError if there are several."""
        (arm,) = self.values()
        return arm

    @property
    def choices(self) -> dict[str, CandidateChoice]:
        """Candidates of each arm."""
        return {name: arm.guide.choice for name, arm in self.items()}

    @property
    def action_size(self) -> int:
        """Number of action components."""
        return sum(arm.action_size for arm in self.values())

    @property
    def out_of_reach(self) -> Bool[Tensor, " n"]:
        """No candidate of some arm could be reached when the episode began."""
        return torch.stack([choice.buffers.reachable == 0 for choice in self.choices.values()]).any(0)

    def anneal(self, **shares: float) -> None:
        """As `Guide.anneal`, for every arm."""
        for arm in self.values():
            arm.guide.anneal(**shares)

    def commands(self, observed: Snapshot, action: Float[Tensor, "n a"]) -> Any:
        """What ManiSkill's controllers are asked.

        Args:
            observed: the state as it is observed.
            action: the parts of all arms, one after the other.

        Returns:
            A tensor for one arm; a dict of them by ManiSkill's names of the robots for several.
        """
        parts = action.split([arm.action_size for arm in self.values()], -1)
        commands = [arm.command(observed.of(arm.name), part) for arm, part in zip(self.values(), parts, strict=True)]
        if len(commands) == 1:
            return commands[0]
        return {
            f"{arm.agent.uid}-{k}": command
            for k, (arm, command) in enumerate(zip(self.values(), commands, strict=True))
        }

    def scripted_action(self, observed: Snapshot) -> Float[Tensor, "n a"]:
        """Action that executes the chosen candidates from the present state."""
        return torch.cat([arm.scripted_action(observed.of(name)) for name, arm in self.items()], -1)

    def hold(self) -> None:
        """Leaves all commanded joints where they are."""
        for arm in self.values():
            if arm.agent.commands_wrist:
                arm.agent.wrist_controller.hold()

    def advance(self, observed: Snapshot) -> dict[str, Float[Tensor, "n p"]]:
        """Moves the references on by a control step; the phase of each, one-hot."""
        for name, arm in self.items():
            arm.guide.reference.advance(observed.of(name))
        return {name: arm.guide.reference.one_hot() for name, arm in self.items()}
