"""The stage machine and the reward terms on invented states, without a simulator."""

from dataclasses import dataclass

import pytest
import torch
from invented import invented, memory
from torch import Tensor

from dora.errors import InputError
from dora.tasks.mdp.mdp import Mdp
from dora.tasks.mdp.rewards import Term, Terms, tolerance
from dora.tasks.mdp.snapshot import Snapshot
from dora.tasks.mdp.stages import Stage, StageMachine


@dataclass(frozen=True)
class State:
    distance: Tensor
    height: Tensor


DT = 0.05
"""Duration of a control step [s]."""
STAGES: list[Stage[State]] = [
    Stage("reach", lambda s: s.distance < 0.03),
    Stage(
        "lift",
        lambda s: s.height > 0.1,
        hold=3 * DT,
        lost=lambda s: s.distance > 0.08,
        back_to="reach",
    ),
]


def state(distance: list[float], height: list[float]) -> State:
    return State(torch.tensor(distance), torch.tensor(height))


def test_each_environment_walks_alone():
    m = StageMachine(STAGES, 4, DT)
    m.advance(state([0.5, 0.01, 0.01, 0.5], [0.0] * 4))
    assert m.index.tolist() == [0, 1, 1, 0]
    for _ in range(2):
        m.advance(state([0.5, 0.01, 0.2, 0.01], [0.0, 0.2, 0.2, 0.2]))
    assert m.index.tolist() == [0, 1, 0, 1]  # 1 has held two of three steps; 2 lost it
    m.advance(state([0.5, 0.01, 0.2, 0.01], [0.0, 0.2, 0.2, 0.2]))
    assert m.index.tolist() == [0, 2, 0, 1]
    assert m.finished.tolist() == [False, True, False, False]
    m.advance(state([0.5] * 4, [0.0] * 4))
    assert m.index[1] == 2  # finished is never left
    assert m.furthest.tolist() == [0, 2, 1, 1]


def test_an_interrupted_hold_starts_again():
    m = StageMachine(STAGES, 1, DT)
    m.advance(state([0.01], [0.2]))
    for height in (0.2, 0.2, 0.0, 0.2, 0.2):
        m.advance(state([0.01], [height]))
    assert m.index.item() == 1
    assert m.hold_count.item() == 2


def test_partial_reset_touches_only_its_rows():
    m = StageMachine(STAGES, 5, DT)
    m.index[:], m.hold_count[:], m.furthest[:] = 1, 2, 1
    m.reset(torch.tensor([1, 3]))
    assert m.index.tolist() == [1, 0, 1, 0, 1]
    assert m.hold_count.tolist() == [2, 0, 2, 0, 2]
    assert m.index.shape == (5,)


def test_state_round_trip_by_rows():
    m, other = StageMachine(STAGES, 3, DT), StageMachine(STAGES, 3, DT)
    m.index[:], m.hold_count[:], m.furthest[:] = torch.tensor([0, 1, 2]), 2, 2
    rows = torch.tensor([2, 1])
    other.set_state({k: v[rows] for k, v in m.get_state().items()}, rows)
    assert other.index.tolist() == [0, 1, 2]
    assert other.hold_count.tolist() == [0, 2, 2]


def test_batch_equals_singles():
    torch.manual_seed(0)
    steps, n = 40, 64
    d, z = torch.rand(steps, n) * 0.1, torch.rand(steps, n) * 0.2
    big, singles = StageMachine(STAGES, n, DT), [StageMachine(STAGES, 1, DT) for _ in range(n)]
    for t in range(steps):
        big.advance(State(d[t], z[t]))
        for i, m in enumerate(singles):
            m.advance(State(d[t, i : i + 1], z[t, i : i + 1]))
    assert big.index.tolist() == [m.index.item() for m in singles]
    assert len(set(big.index.tolist())) == 3


def test_terms_add_up_and_know_their_bounds():
    terms: Terms[State] = Terms(
        {
            "near": Term(lambda s: tolerance(s.distance, margin=0.1), 2.0),
            "high": Term(lambda s: s.height, -1.0, "penalty"),
        }
    )
    total, parts = terms(state([0.0, 9.0], [0.5, 1.0]))
    assert torch.equal(total, torch.stack(list(parts.values())).sum(0))
    assert total[0] == 1.5
    assert (terms.lower, terms.upper) == (-1.0, 2.0)


def test_guided_terms_can_be_taken_away():
    terms: Terms[State] = Terms(
        {"a": Term(lambda s: s.height, 1.0, "affordance", True), "b": Term(lambda s: s.height, 1.0)}
    )
    assert list(terms.in_force(frozenset()).terms) == ["b"]


def test_tolerance_hits_its_anchors_on_both_sides():
    x = torch.tensor([0.0, 0.02, 0.12, -0.1, 9.0])
    shaped = tolerance(x, (0.0, 0.02), 0.1)
    torch.testing.assert_close(shaped[:4], torch.tensor([1.0, 1.0, 0.1, 0.1]))
    assert shaped[4] < 1e-6
    torch.testing.assert_close(tolerance(x, (0.0, 0.02), 0.1, value_at_margin=0.5)[2], torch.tensor(0.5))
    assert tolerance(x, (0.0, 0.02)).tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("bounds", "margin", "value"), [((0.1, 0.0), 1.0, 0.1), ((0.0, 0.0), -1.0, 0.1), ((0.0, 0.0), 1.0, 1.0)]
)
def test_tolerance_refuses_bad_anchors(bounds: tuple[float, float], margin: float, value: float):
    with pytest.raises(ValueError, match="lower <= upper"):
        tolerance(torch.zeros(1), bounds, margin, value)


@pytest.mark.parametrize("dt", [0.05, 0.025, 0.01])
def test_a_hold_lasts_equally_long_at_every_control_rate(dt: float):
    held: Stage[State] = Stage("hold", lambda s: s.height > 0.1, hold=0.15)
    m = StageMachine([held], 1, dt)
    steps = 0
    while not m.finished.item():
        m.advance(state([0.0], [0.2]))
        steps += 1
    assert steps * dt == pytest.approx(0.15)


def test_bad_tables_are_refused():
    def value(s: State) -> Tensor:
        return s.height

    with pytest.raises(ValueError, match="repeat"):
        StageMachine([Stage("a", value), Stage("a", value)], 1, DT)
    with pytest.raises(ValueError, match="not an earlier stage"):
        StageMachine([Stage("a", value, lost=value, back_to="b"), Stage("b", value)], 1, DT)
    with pytest.raises(ValueError, match="both lost and back_to"):
        StageMachine([Stage("a", value, lost=value)], 1, DT)
    with pytest.raises(ValueError, match="at least one term"):
        Terms({})
    with pytest.raises(InputError, match=r"penalty term 'a' is 1.0; it cannot be above 0"):
        Terms({"a": Term(value, 1.0, "penalty")})
    with pytest.raises(ValueError, match="task"):
        Terms({"a": Term(value, -1.0)})
    without = Terms({"a": Term(value, 0.0, "penalty"), "b": Term(value, 2.0)})
    assert (without.lower, without.upper) == (0.0, 2.0)


def test_an_episode_is_judged_with_and_without_overlap_and_at_its_end():
    """Rows: not finished, finished, with overlap, dropped at the end, failed, unreachable."""
    stage = Stage[Snapshot]("lift", lambda s: s.object.p[:, 2] > 0.1)
    terms = Terms({"height": Term[Snapshot](lambda s: s.object.p[:, 2], 1.0)})
    lost = torch.arange(6) == 4
    mdp = Mdp[Snapshot]([stage], terms, terms, 0.003, failed=lambda s, memory: lost)
    heights = torch.tensor([0.2, 0.2, 0.2, 0.0, 0.2, 0.2])
    state = invented(6, object_p=torch.stack([0 * heights, 0 * heights, heights], 1))
    overlap = memory(6, max_penetration=torch.tensor([0.0, 0.003, 0.004, 0.0, 0.0, 0.0]))
    verdict = mdp.verdict(torch.arange(6) > 0, torch.arange(6) == 5, state, overlap)
    assert {name: value.nonzero()[:, 0].tolist() for name, value in verdict.items()} == {
        "success": [1, 3], "raw_success": [1, 2, 3], "success_at_end": [1], "fail": [4, 5],
    }  # fmt: skip
