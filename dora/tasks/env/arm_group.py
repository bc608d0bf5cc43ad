"""All arms of a task: the parts of an action, the commands of their controllers, and their references step by step."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from jaxtyping import Bool, Float
from torch import Tensor

from dora.arguments import as_tensor
from dora.errors import InputError
from dora.geometry.poses import relative
from dora.sim.batch.actions import check_array
from dora.tasks.env.arm import Arm
from dora.tasks.env.perturbations import Perturbations
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.mdp.observations import Entry, columns_by_arm
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

    def action_spaces(self, num_envs: int) -> tuple[Box, Box]:
        """The space of one action for all arms, and that of a batch of them, which for one environment is the same."""
        bound = np.ones((num_envs, self.action_size), np.float32)
        single = Box(-bound[0], bound[0])
        return single, Box(-bound, bound) if num_envs > 1 else single

    def columns(self, entries: Mapping[str, Entry], observed: Snapshot) -> dict[str, tuple[list[int], list[int]]]:
        """Columns of the observation that each arm sees, and columns of the action that it commands.

        Args:
            entries: the table of the observation.
            observed: a state, whose entries have the sizes of all.
        """
        seen = columns_by_arm(list(self), {name: entry.value(observed).shape[-1] for name, entry in entries.items()})
        parts = torch.arange(self.action_size).split([arm.action_size for arm in self.values()])
        return {name: (seen[name], part.tolist()) for name, part in zip(self, parts, strict=True)}

    @property
    def out_of_reach(self) -> Bool[Tensor, " n"]:
        """No candidate of some arm could be reached when the episode began."""
        return torch.stack([choice.buffers.reachable == 0 for choice in self.choices.values()]).any(0)

    @property
    def ranking_steps(self) -> int | None:
        """Control steps that ranking the candidates took, those of all arms being ranked in the same episodes; None if
        those of no arm say."""
        known = [choice.candidates.ranking_steps for choice in self.choices.values()]
        return max((steps for steps in known if steps is not None), default=None)

    def anneal(self, **shares: float) -> None:
        """As `Guide.anneal`, for every arm."""
        for arm in self.values():
            arm.guide.anneal(**shares)

    def joined(self, action: Any, num_envs: int) -> Any:
        """One action of a dictionary: of its `action` beside a `control_mode`, or of the parts by robot, one after the
        other; everything else as it is.

        Args:
            action: as `DoraEnv.step` takes it.
            num_envs: number of rows of a part; one environment may leave the batch axis out.

        Raises:
            InputError: the control mode is not the present one, the robots are others, or a part does not fit.
        """
        if not isinstance(action, Mapping):
            return action
        agents = [arm.agent for arm in self.values()]
        if "control_mode" in action:
            if (mode := action["control_mode"]) != agents[0].control_mode:
                raise InputError(
                    f"The action is for control_mode {mode!r} but the environment was made with "
                    f"{agents[0].control_mode!r}, which it keeps: make another one with control_mode={mode!r}."
                )
            if action.get("action") is None:
                raise InputError("The action has no 'action': a dictionary needs numbers for each of its parts.")
            return action["action"]
        names = [f"{agent.uid}-{k}" for k, agent in enumerate(agents)]
        if len(names) == 1:
            raise InputError("The action is a dictionary but there is one robot only: pass an array.")
        for known in (names, list(self)):
            if action.keys() == set(known):
                parts = [as_tensor(action[name], f"The action of {name}") for name in known]
                for name, part, arm in zip(known, parts, self.values(), strict=True):
                    check_array(part, arm.agent.single_action_space, num_envs, f" of {name}")
                return torch.cat([part.reshape(num_envs, -1) for part in parts], -1)
        raise InputError(f"The action has keys {sorted(action, key=str)} but the robots are {names}.")

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

    def exact_corrections(self, s: Snapshot, perturbations: Perturbations) -> dict[str, Float[Tensor, "n a"]]:
        """Of each arm the residual action that undoes the error of its candidate and of its object's measured pose.

        Args:
            s: the true state.
            perturbations: of the episodes, which know the error of the pose.
        """
        found = {}
        for name, arm in self.items():
            body = s.objects[s.handles[name]]
            pose = body.p, body.q
            found[name] = arm.exact_correction(relative(perturbations.biased(name, pose), pose))
        return found

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
