"""Memory, stages side by side, guidance and bounds of a task on invented states, in numbers."""

from dataclasses import dataclass, replace

import pytest
import torch
from invented import invented, memory
from torch import Tensor

from dora.errors import InputError
from dora.tasks.mdp.config import TaskConfig
from dora.tasks.mdp.guidance_parts import PARTS, REGION, exists, guidance_in_force
from dora.tasks.mdp.mdp import BELOW_TABLE, KNOCKED_AWAY, Mdp, left_table
from dora.tasks.mdp.memory import EpisodeMemory, HandSizes
from dora.tasks.mdp.observations import Entry, columns_by_arm, observation_table
from dora.tasks.mdp.rewards import Term, Terms, tolerance
from dora.tasks.mdp.snapshot import Snapshot, derived, observed
from dora.tasks.mdp.stages import ParallelStages, Stage, make_stages


@dataclass(frozen=True)
class Two:
    """What two arms see: a number each."""

    left: Tensor
    right: Tensor

    def of(self, arm: str) -> Tensor:
        return getattr(self, arm)


LADDERS = {
    "left": [Stage[Tensor]("one", lambda x: x > 0), Stage[Tensor]("two", lambda x: x > 1)],
    "right": [Stage[Tensor]("three", lambda x: x > 0, hold=0.1), Stage[Tensor]("four", lambda x: x > 1)],
}


def test_arms_climb_side_by_side_and_all_is_done_when_both_are():
    stages = make_stages(LADDERS, 3, 0.05)
    assert isinstance(stages, ParallelStages)
    high, low = torch.full((3,), 2.0), torch.tensor([2.0, 0.5, -1.0])
    for _ in range(2):
        stages.advance(Two(low, high))
    assert {arm: index.tolist() for arm, index in stages.by_arm().items()} == {"left": [2, 1, 0], "right": [1, 1, 1]}
    assert stages.index.tolist() == [3, 2, 1]
    assert stages.finished.tolist() == [False] * 3
    stages.advance(Two(low, high))
    assert stages.index.tolist() == stages.furthest.tolist() == [4, 3, 2]
    assert stages.finished.tolist() == [True, False, False]
    report = {name: value.tolist() for name, value in stages.report().items()}
    assert report == {
        "finished": [True, False, False], "stage": [4, 3, 2], "stage/one": [True, True, False],
        "stage/two": [True, False, False], "stage/three": [True] * 3, "stage/four": [True] * 3,
    }  # fmt: skip
    assert len(stages) == 4
    ranges = {"stage": (0.0, 2.0), "furthest": (0.0, 2.0)}
    expected = {f"{arm}.{name}": value for arm in LADDERS for name, value in ranges.items()}
    assert stages.state_ranges() == expected | {"left.hold_count": (0.0, 1.0), "right.hold_count": (0.0, 2.0)}
    state = stages.get_state()
    stages.reset(torch.tensor([0]))
    assert stages.index.tolist() == [0, 3, 2]
    stages.set_state(state, slice(None))
    assert stages.index.tolist() == [4, 3, 2]


def test_names_of_stages_are_unique_over_the_arms():
    with pytest.raises(ValueError, match="repeat"):
        make_stages({"left": LADDERS["left"], "right": LADDERS["left"]}, 1, 0.05)


# ------------------------------------------------------------------------ memory


def test_the_memory_keeps_the_largest_and_the_last():
    kept = EpisodeMemory(2, 2, {"arm": HandSizes(3, 4)}, ("thing",), "cpu")
    for depth, rise, action in ((0.002, 0.1, 1.0), (0.005, 0.3, 2.0), (0.001, 0.2, 3.0)):
        kept.record_penetration(torch.tensor([depth, 0.0]))
        kept.record_rise("thing", torch.tensor([rise, -rise]))
        kept.record_action(torch.full((2, 2), action))
    assert kept.max_penetration.tolist() == pytest.approx([0.005, 0.0])
    assert kept.object.highest.tolist() == pytest.approx([0.3, 0.0])
    assert (kept.episode.action[0, 0], kept.episode.previous_action[0, 0]) == (3.0, 2.0)
    report = kept.report()
    assert report["penetration_mm"].tolist() == pytest.approx([1.0, 0.0])
    assert report["penetration_max_mm"].tolist() == pytest.approx([5.0, 0.0])
    state = kept.get_state()
    kept.begin(torch.tensor([0]), {"thing": torch.tensor([[1.0, 2.0, 3.0]])})
    assert kept.max_penetration.tolist() == [0.0, 0.0]
    assert kept.object.start_p.tolist() == [[1.0, 2.0, 3.0], [0.0] * 3]
    assert kept.episode.action.tolist() == [[0.0, 0.0], [3.0, 3.0]]
    kept.set_state(state, slice(None))
    assert kept.episode.action.tolist() == [[3.0, 3.0]] * 2
    assert kept.hands["arm"].contact_p.shape == (2, 4, 3)
    assert kept.hands["arm"].touch.shape == (2, 3)


# ------------------------------------------------------------------------ failure and success


@pytest.mark.parametrize(
    ("place", "gone"),
    [
        ((0.0, 0.0, BELOW_TABLE + 1e-3), False), ((0.0, 0.0, BELOW_TABLE - 1e-3), True),
        ((0.36 - 1e-3, 0.48, 0.0), False), ((0.36 + 1e-3, 0.48, 0.0), True), ((0.0, 0.0, 5.0), False),
    ],
)  # fmt: skip
def test_an_object_is_gone_below_the_table_or_beyond_reach(place: tuple[float, float, float], gone: bool):
    start = torch.tensor([[0.1, 0.2, 0.0]])
    s = invented(1, object_p=start + torch.tensor([place]), start_p=start)
    assert pytest.approx(0.6) == KNOCKED_AWAY
    assert left_table(s, memory(1)).tolist() == [gone]
    other = replace(s.object, p=start)
    assert left_table(replace(s, objects={"other": other, "thing": s.object}), memory(1)).tolist() == [gone]


def test_in_the_end_every_arm_has_to_pass_its_last_test():
    terms = Terms({"height": Term[Snapshot](lambda s: s.time, 1.0)})
    ends = {"arm": [Stage[Snapshot]("up", lambda s: s.object.p[:, 2] > 0.1)],
            "other": [Stage[Snapshot]("late", lambda s: s.time > 0.5)]}  # fmt: skip
    mdp = Mdp[Snapshot](ends, terms, terms, 0.003)
    p = torch.tensor([[0.0, 0.0, 0.2], [0.0, 0.0, 0.2], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    s = invented(4, object_p=p, time=torch.tensor([0.9, 0.1, 0.9, 0.1]))
    yes, no = torch.ones(4, dtype=torch.bool), torch.zeros(4, dtype=torch.bool)
    verdict = mdp.verdict(yes, no, s, memory(4))
    assert verdict["success"].tolist() == [True] * 4
    assert verdict["success_at_end"].tolist() == [True, False, False, False]


@pytest.mark.parametrize(("x", "value"), [(-0.5, 0.1), (0.0, 1.0), (0.5, 1.0), (1.0, 1.0), (1.5, 0.1)])
def test_tolerance_falls_on_both_sides(x: float, value: float):
    assert tolerance(torch.tensor([x]), (0.0, 1.0), 0.5).tolist() == pytest.approx([value])
    assert tolerance(torch.tensor([x]), (0.0, 1.0)).tolist() == [float(value == 1)]
    unit = 0.0, 1.0
    for bounds, margin, at_margin in ((unit, 0.5, 0.0), (unit, 0.5, 1.0), (unit, -0.1, 0.1), ((1.0, 0.9), 0.5, 0.1)):
        with pytest.raises(ValueError, match="need"):
            tolerance(torch.tensor([x]), bounds, margin, at_margin)


# ------------------------------------------------------------------------ guidance


def test_parts_of_guidance():
    assert guidance_in_force("none", None) == frozenset()
    assert guidance_in_force("grasps", None) == frozenset(PARTS)
    assert guidance_in_force("affordance", None) == frozenset({*PARTS, REGION})
    assert guidance_in_force("affordance", "prior") == {"prior", REGION}
    assert guidance_in_force("grasps", ["reward", "filter"]) == {"reward", "filter"}
    for wrong in (("all", None), ("none", ["prior"]), ("grasps", 3), ("grasps", ["priors"])):
        with pytest.raises(InputError):
            guidance_in_force(*wrong)


@pytest.mark.parametrize(
    ("part", "region", "parts", "expected"),
    [
        (None, False, (), True), ("reward", False, (), False), ("reward", False, ("reward",), True),
        ("reward", True, ("reward",), False), ("reward", True, ("reward", REGION), True), (None, True, (), False),
        (None, True, (REGION,), True), ("reward", True, (REGION,), False),
    ],
)  # fmt: skip
def test_what_belongs_to_a_part_exists_with_it(part: str | None, region: bool, parts: tuple[str, ...], expected: bool):
    assert exists(part, region, frozenset(parts)) == expected


def test_a_table_of_two_arms_has_the_entries_of_each_and_the_shared_ones():
    own = Entry(lambda s: s.time[:, None], "1", "", arm="left")
    guided = Entry(lambda s: s.time[:, None], "1", "", True)
    table = observation_table(("left", "right"), {"own": own, "guided": guided}, frozenset(), TaskConfig())
    assert "left/own" in table
    assert "right/own" not in table
    assert not [name for name in table if "guided" in name or "goal" in name or "phase" in name]
    assert list(table)[-3:] == ["max_penetration", "stage", "time"]
    one = observation_table(("left",), {"guided": guided}, frozenset({"observation"}), TaskConfig())
    assert {"guided", "goal", "time"} <= set(one)
    assert "phase" not in one
    assert "phase" in observation_table(("left",), {}, frozenset({"prior"}), TaskConfig())
    sizes = {"left/a": 2, "right/b": 1, "c": 3}
    assert columns_by_arm(("left", "right"), sizes) == {"left": [0, 1, 3, 4, 5], "right": [2, 3, 4, 5]}


@pytest.mark.parametrize("arms", [("left",), ("left", "right")])
def test_the_candidate_on_the_object_is_observed_where_it_is_wanted_and_observation_is_guided(arms: tuple[str, ...]):
    def names(parts: set[str], wanted: bool) -> set[str]:
        table = observation_table(arms, {}, frozenset(parts), TaskConfig(observe_candidate=wanted))
        return {name for name in table if "candidate" in name}

    both = {"candidate"} if len(arms) == 1 else {f"{arm}/candidate" for arm in arms}
    assert names({"observation", "prior"}, True) == both
    assert not names({"observation", "prior"}, False)
    assert not names({"reward", "prior"}, True)


def test_what_noise_changes_is_computed_anew():
    calls = []

    @derived
    def height(s: Snapshot) -> Tensor:
        calls.append(1)
        return s.object.p[:, 2]

    s = invented(1)
    height(s)
    moved = {"thing": replace(s.object, p=torch.ones(1, 3))}
    noisy = observed(s, s.hands, moved, s.goals, lambda pose: pose)
    assert height(noisy).tolist() == [1.0]
    assert height(s).tolist() == [0.0]
    assert len(calls) == 2
