"""What a state may hold, and what several arms are together, on invented environments without a simulator."""

from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from invented import invented, memory
from test_guidance import CPU, along_x
from torch import Tensor

from dora.errors import InputError
from dora.tasks.env.arm import Arm, ArmSpec
from dora.tasks.env.arm_group import ArmGroup
from dora.tasks.env.state import checked_state, saved_state, unflattened
from dora.tasks.guidance.candidate_choice import CandidateChoice
from dora.tasks.guidance.grasp_and_lift import GraspReference
from dora.tasks.guidance.guide import Guide
from dora.tasks.guidance.residual_action import ResidualAction
from dora.tasks.mdp.buffers import Buffers
from dora.tasks.mdp.config import ResidualBounds
from dora.tasks.mdp.randomisation import Randomisation
from dora.tasks.mdp.stages import Stage, StageMachine

# ------------------------------------------------------------------------ states


def environment() -> Any:
    """Two environments with a body, at the beginning of their episodes, and their state."""
    stages = [Stage[Any]("one", lambda s: s > 0), Stage[Any]("two", lambda s: s > 0)]
    env = SimpleNamespace(
        num_envs=2, device=CPU, arms={}, memory=memory(2, mass=torch.ones(2), friction=torch.ones(2)),
        machine=StageMachine(stages, 2, 0.05), task=SimpleNamespace(stateful=dict), past=SimpleNamespace(steps=0),
        perturbations=SimpleNamespace(buffers=Buffers(2, CPU, key=(), waiting=(1, 3))),
        _elapsed_steps=torch.zeros(2, dtype=torch.long), scale=torch.ones(2, 1),
    )  # fmt: skip
    pose = torch.zeros(2, 13)
    pose[:, 3] = 1.0
    env._init_raw_state = saved_state(env, {"actors": {"cube": pose}, "articulations": {}})
    return env


CHANGES: list[tuple[str, str, float, bool]] = [
    ("memory", "object.thing.mass", 1e-9, True), ("memory", "object.thing.mass", 0.0, False),
    ("memory", "object.thing.mass", 1.1e9, False), ("memory", "object.thing.friction", 0.0, True),
    ("memory", "object.thing.friction", -0.1, False), ("task", "scale", 1e-3, True), ("task", "scale", 9e-4, False),
    ("task", "scale", 1001.0, False), ("task", "elapsed", -1.0, False), ("task", "elapsed", 5.0, True),
    ("machine", "stage", 2.0, True), ("machine", "stage", 3.0, False), ("machine", "stage", -1.0, False),
    ("machine", "hold_count", 1.0, True), ("machine", "hold_count", 2.0, False),
    ("memory", "episode.penetration", float("nan"), True), ("memory", "episode.max_penetration", float("nan"), True),
    ("memory", "episode.action", float("nan"), False), ("perturbations", "key", -7.0, True),
    ("perturbations", "key", float("inf"), False),
]  # fmt: skip


@pytest.mark.parametrize(("part", "name", "value", "sound"), CHANGES)
def test_numbers_of_a_state_are_within_their_ranges(part: str, name: str, value: float, sound: bool):
    env = environment()
    state = deepcopy(env._init_raw_state)
    state[part][name].reshape(2, -1)[1, 0] = value
    rows = torch.arange(2)
    if sound:
        checked_state(env, state, rows)
    else:
        with pytest.raises(InputError, match=f"{part}.*{name}"):
            checked_state(env, state, rows)


def test_a_state_is_whole_and_nothing_else():
    env, rows = environment(), torch.arange(2)
    state = env._init_raw_state
    simulator = {name: state[name] for name in ("actors", "articulations")}
    assert set(checked_state(env, simulator, rows)) == set(simulator)
    for wrong, words in (
        (state | {"machines": {}}, "'machines', which this task has not: did you mean 'machine'"),
        ({name: state[name] for name in state if name != "memory"}, "lacks 'memory'"),
        (state | {"memory": {}}, "is missing"), (state | {"memory": torch.zeros(2)}, "must be a dictionary"),
        (state | {"actors": {"cub": state["actors"]["cube"]}}, "'cub', which is not known here"),
        (3, "must be a dictionary as of get_state_dict, not int"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            checked_state(env, wrong, rows)


def test_a_row_of_numbers_is_the_whole_state_or_that_of_the_simulator():
    """Numbers are counted through; a single row stands for all environments."""
    env = environment()

    def leaves(state: dict[str, Any]) -> list[Tensor]:
        parts = [leaves(v) if isinstance(v, dict) else [v] for v in state.values()]
        return [leaf for part in parts for leaf in part]

    width = sum(int(np.prod(leaf.shape[1:])) for leaf in leaves(env._init_raw_state))
    whole = unflattened(env, torch.arange(2.0 * width).reshape(2, width), None)
    assert list(whole) == list(env._init_raw_state)
    joined = torch.cat([leaf.reshape(2, -1) for leaf in leaves(whole)], 1)
    assert joined.tolist() == torch.arange(2.0 * width).reshape(2, width).tolist()
    short = unflattened(env, list(range(13)), [1])
    assert list(short) == ["actors", "articulations"]
    assert short["actors"]["cube"].tolist() == [list(range(13))]
    with pytest.raises(InputError, match="shape"):
        unflattened(env, torch.zeros(2, 14), None)


# ------------------------------------------------------------------------ arms


def guide(*parts: str, ranking_steps: int | None = None) -> Guide:
    """Candidates 10, 20 and 30 cm ahead."""
    told = "" if ranking_steps is None else f'{{"ranking_steps": {ranking_steps}}}'
    choice = CandidateChoice(replace(along_x(0.1, 0.2, 0.3), settings=told), 2, CPU)
    choice.buffers.update(reachable=torch.ones(2))
    return Guide(parts, choice, GraspReference(2, 0.05, CPU), ResidualAction(2, 26, ResidualBounds(), CPU))


def arm(*parts: str, wrist: bool = True, name: str = "arm", size: int = 26, steps: int | None = None) -> Arm:
    """An arm whose wrist begins at the origin."""
    made = Arm.__new__(Arm)
    made.name, made.spec, made.guide = name, ArmSpec("cube"), guide(*parts, ranking_steps=steps)
    space = Box(-1.0, 1.0, (size,), np.float32)
    agent: Any = SimpleNamespace(commands_wrist=wrist, uid="robot", control_mode="wrist", single_action_space=space)
    made.agent = agent
    made.home = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    return made


@pytest.mark.parametrize(
    ("parts", "wrist", "expected"), [(("prior",), True, True), (("prior",), False, False), (("reward",), True, False)]
)
def test_actions_are_residuals_with_that_part_of_guidance_where_they_command_the_wrist(
    parts: tuple[str, ...], wrist: bool, expected: bool
):
    assert arm(*parts, wrist=wrist).takes_residual is expected
    assert arm(size=7).action_size == 7


@pytest.mark.parametrize(("parts", "chosen"), [(("filter",), 1), ((), 1), (("prior", "reward"), 0)])
def test_candidates_that_cannot_be_reached_are_left_out_where_they_are_filtered_or_scripted(
    parts: tuple[str, ...], chosen: int
):
    """The nearest cannot be reached in the second environment, and nothing in the first."""
    made = arm(*parts)
    reachable = torch.tensor([[False] * 3, [False, True, True]])
    p, q = torch.zeros(2, 3), torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1)
    error = torch.zeros(2, made.guide.choice.error_draws)
    made.choose(torch.arange(2), p, q, reachable, error, Randomisation())
    assert made.guide.choice.buffers.chosen.tolist() == [0.0, float(chosen)]
    assert made.guide.choice.buffers.reachable.tolist() == [0.0, 1.0]
    made.choose(
        torch.arange(2), p, q, reachable, error, Randomisation(), lambda wanted: wanted & False | (torch.arange(3) == 2)
    )
    assert made.guide.choice.buffers.chosen.tolist() == [2.0, 2.0]


def group(**arms: Arm) -> ArmGroup:
    return ArmGroup(arms)


def test_several_arms_are_out_of_reach_when_one_is_and_know_the_longest_ranking():
    both = group(left=arm(steps=100), right=arm(steps=300))
    both["right"].guide.choice.buffers.update(reachable=torch.tensor([1.0, 0.0]))
    assert both.out_of_reach.tolist() == [False, True]
    assert both.ranking_steps == 300
    assert group(left=arm(), right=arm(steps=5)).ranking_steps == 5
    assert group(left=arm(), right=arm()).ranking_steps is None
    assert both.action_size == 52
    with pytest.raises(ValueError, match="unpack"):
        _ = both.only
    both.anneal(bounds=0.5, error=0.25)
    assert [(a.guide.residual.scale, a.guide.choice.error_scale) for a in both.values()] == [(0.5, 0.25)] * 2


def test_an_action_of_one_arm_may_say_its_control_mode():
    one = group(arm=arm(size=2))
    assert one.joined({"control_mode": "wrist", "action": [1, 2]}, 1) == [1, 2]
    assert one.joined(None, 1) is None
    for wrong, words in (
        ({"control_mode": "joints", "action": [1]}, "for control_mode 'joints'"),
        ({"control_mode": "wrist"}, "no 'action'"), ({"robot-0": [1, 2]}, "one robot only"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            one.joined(wrong, 1)


@pytest.mark.parametrize("names", [("left", "right"), ("robot-0", "robot-1")])
def test_actions_of_several_arms_are_joined_in_their_order(names: tuple[str, str]):
    both = group(left=arm(size=2), right=arm(size=1))
    parts = {names[1]: [[5.0], [6.0]], names[0]: [[1.0, 2.0], [3.0, 4.0]]}
    assert both.joined(parts, 2).tolist() == [[1.0, 2.0, 5.0], [3.0, 4.0, 6.0]]
    with pytest.raises(InputError, match="has shape"):
        both.joined(parts | {names[1]: [[5.0]]}, 2)
    with pytest.raises(InputError, match="has keys"):
        both.joined({names[0]: parts[names[0]]}, 2)


def test_what_no_reference_changes_is_commanded_as_it_is():
    both = group(left=arm(size=2, name="left"), right=arm(size=1, name="right"))
    s, action = invented(2), torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    found = both.commands(s, action)
    assert {name: part.tolist() for name, part in found.items()} == {
        "robot-0": [[1.0, 2.0], [4.0, 5.0]], "robot-1": [[3.0], [6.0]],
    }  # fmt: skip
    assert group(arm=arm(size=3)).commands(s, action).tolist() == action.tolist()
    assert group(arm=arm("prior", size=3)).scripted_action(s).tolist() == [[0.0] * 3] * 2
