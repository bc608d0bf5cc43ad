"""A session turn by turn with a task that only counts: when steps are due, rests, orders and what is refused."""

import math
import queue
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from invented_live import DT, LAST, CountingTask, poses
from live import Clock

from dora.arguments import LARGEST_SEED
from dora.live.orders import Choose, Order, Play, Push, Randomise, Repeat, Reset, Run, Speed, Start, Step
from dora.live.players import Player, recorded
from dora.live.recordings import Recording
from dora.live.session import FASTEST, IDLE, MOST_STEPS, REST, SLOWEST, Session
from dora.live.state import LiveState

PLAYERS = (Player("one"), Player("two"), recorded(Recording(Path("a.h5"), "Invented-v1", {}, (("traj_0", 0),))))
"""Who may act."""


class Counted:
    """A session whose task only counts, with a clock that stands still."""

    def __init__(self, **options: Any):
        self.clock = Clock()
        self.session = Session("Invented-v1", PLAYERS, clock=self.clock, **options)
        self.task: Any = self.session._task

    def do(self, *orders: Order) -> LiveState:
        for order in orders:
            self.session.order(order)
        self.session.turn()
        return self.session.state

    def steps(self, seconds: float = 0.0) -> int:
        """Steps that are done when some time has passed."""
        self.clock.now += seconds
        done = 0
        while self.session.turn():
            done += 1
        return done

    def to_the_end(self) -> LiveState:
        while not self.session.state.episode.over:
            self.steps(DT)
        return self.session.state


@pytest.fixture(autouse=True)
def _counting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dora.live.session.LiveTask", CountingTask)


def test_steps_are_due_by_the_clock_and_a_backlog_is_given_up():
    counted = Counted()
    assert counted.steps() == 1
    assert counted.steps(0.99 * DT) == 0
    assert counted.steps(0.01 * DT) == 1
    counted.do(Reset())
    assert counted.steps(10.0) == 3  # due at once, at 9.9 and at 9.9625 s


def test_the_rate_follows_slowly_and_is_zero_while_nothing_moves():
    counted = Counted()
    rates = []
    for k in range(LAST):
        counted.steps(DT if k else 0.0)
        rates.append(counted.session.state.rate)
    assert rates == pytest.approx([0.0, 0.1, 0.19, 0.0])  # it is over
    counted.clock.now += 5.0
    assert counted.do(Reset()).rate == pytest.approx(0.271)
    assert counted.do(Run(False)).rate == 0.0
    counted.do(Step())
    counted.do(Step())  # at the same time
    assert counted.do(Run(True), Reset()).rate == pytest.approx(0.271)


def test_an_episode_is_followed_by_the_next_seed_after_a_rest():
    counted = Counted(seed=LARGEST_SEED - 1)
    counted.do(Start((0.1, 0.2)), Choose(2))
    over = counted.to_the_end()
    assert (over.episodes, over.successes, over.passed[0].objects["cube"][0]) == (1, 1, LAST - 0.5)
    counted.clock.now += REST - 1e-3
    assert not counted.session.turn()
    assert counted.session.state is over
    counted.clock.now += 2e-3
    assert not counted.session.turn()
    assert counted.session.state.episode.seed == LARGEST_SEED
    assert (counted.task.beginning.shares, counted.task.beginning.candidate) == ((0.1, 0.2), 2)
    counted.to_the_end()
    counted.clock.now += REST
    counted.session.turn()
    assert (counted.session.state.episode.seed, counted.session.state.episodes) == (0, 2)


@pytest.mark.parametrize("order", [Repeat(False), Run(False)])
def test_nothing_follows_without_repetition_or_while_time_stands(order: Order):
    counted = Counted()
    counted.to_the_end()
    over = counted.do(order)
    counted.clock.now += 2 * REST
    assert not counted.session.turn()
    assert counted.session.state is over


def test_whoever_lets_time_go_on_need_not_wait_for_the_rest():
    counted = Counted()
    counted.to_the_end()
    counted.do(Run(False))
    assert counted.do(Run(True)).episode.seed == 1
    assert counted.clock.now < REST


def test_steps_that_are_asked_for_stop_time_and_end_with_the_episode():
    counted = Counted()
    counted.do(Step(2))
    assert 1 + counted.steps(DT) + counted.steps(DT) + counted.steps(DT) == 2
    assert not counted.session.state.running
    for count in (0, -3):
        counted.do(Step(count))
        assert counted.steps(DT) == 0
    counted.do(Step(5))
    assert counted.do(Run(False)).episode.step == 3
    assert counted.steps(DT) == 0
    counted.do(Step(MOST_STEPS + 1))
    counted.steps(DT)
    assert counted.session.state.episode.over
    counted.do(Reset())
    assert counted.steps(DT) == 0


def test_an_action_that_is_refused_stops_time():
    counted = Counted()
    counted.do(Step(3))
    counted.task.broken = "the action is NaN."
    before = counted.session.state.episode.step
    counted.steps(DT)
    found = counted.session.state
    assert (found.message, found.running, found.episode.step) == ("the action is NaN.", False, before)
    counted.task.broken = ""
    assert counted.steps(DT) == 0
    assert counted.do(Run(True)).message == ""


def test_a_next_episode_that_is_refused_stops_time():
    counted = Counted()
    counted.to_the_end()
    counted.task.refused = lambda beginning: "it is damaged."
    counted.clock.now += REST
    assert not counted.session.turn()
    assert (counted.session.state.message, counted.session.state.running) == ("it is damaged.", False)


def test_a_player_that_is_refused_leaves_all_as_it_was():
    counted = Counted()
    counted.to_the_end()
    before = counted.task.beginning
    counted.task.refused = lambda beginning: "not two." if beginning.player.name == "two" else ""
    found = counted.do(Play("two"))
    assert (found.message, found.player, found.episodes, found.successes) == ("not two.", "one", 1, 1)
    assert counted.task.beginning == before
    counted.task.refused = lambda beginning: ""
    counted.do(Start((0.5, 0.5)), Choose(1))
    found = counted.do(Play("two"))
    assert (found.message, found.player, found.episodes, found.successes) == ("", "two", 0, 0)
    assert counted.task.beginning == replace(before, player=PLAYERS[1])
    assert "There is no 'three'; choose one of one, two, recording a.h5." in counted.do(Play("three")).message


@pytest.mark.parametrize(("seed", "taken"), [(0, True), (LARGEST_SEED, True), (-1, False), (LARGEST_SEED + 1, False)])
def test_seeds_have_bounds(seed: int, taken: bool):
    counted = Counted(seed=7)
    counted.do(Start((0.5, 0.5)))
    found = counted.do(Reset(seed))
    assert found.episode.seed == (seed if taken else 7)
    assert (found.message == "") is taken
    counted.do(Start((0.5, 0.5)))
    assert counted.do(Reset()).episode.seed == (seed if taken else 7)
    assert counted.task.beginning.shares is None


@pytest.mark.parametrize(
    ("shares", "taken"),
    [((0.0, 1.0), True), ((1.01, 0.5), False), ((0.5, -0.01), False), ((0.5,), False), ((0.5, 0.5, 0.5), False)],
)
def test_starts_are_shares_of_each_number(shares: tuple[float, ...], taken: bool):
    counted = Counted()
    found = counted.do(Start(shares))
    assert counted.task.beginning.shares == (shares if taken else None)
    assert found.message == ("" if taken else "A start of this task has 2 numbers, each a share from 0 to 1.")


def test_a_task_without_numbers_has_no_start_to_choose():
    counted = Counted()
    counted.task.setup = replace(counted.task.setup, numbers=())
    assert counted.do(Start(())).message == "A start of this task has 0 numbers, each a share from 0 to 1."


@pytest.mark.parametrize(("candidate", "taken"), [(0, True), (2, True), (None, True), (3, False), (-1, False)])
def test_candidates_are_counted_from_zero(candidate: int | None, taken: bool):
    counted = Counted()
    counted.do(Choose(1))
    found = counted.do(Choose(candidate))
    assert found.candidate == (candidate if taken else 1)
    assert found.message == ("" if taken else f"There is no candidate {candidate}; this task has 3 that can be chosen.")


def test_of_several_starts_the_last_counts_and_other_orders_keep_their_places():
    counted = Counted()
    counted.do(Start((0.1, 0.1)), Reset(3), Start((0.2, 0.2)), Start((0.3, 0.3)), Reset(4))
    assert [(each.seed, each.shares) for each in counted.task.begun] == [
        (0, None), (3, None), (3, (0.3, 0.3)), (4, None),
    ]  # fmt: skip


def test_a_recording_keeps_its_own_start_candidate_and_randomisation():
    counted = Counted()
    counted.do(Play("recording a.h5"))
    count = len(counted.task.begun)
    for order, what in ((Start((0.5, 0.5)), "start"), (Choose(0), "candidate"), (Randomise("none"), "randomisation")):
        assert counted.do(order).message == f"A recording has its own {what}: choose another player first."
    assert len(counted.task.begun) == count
    counted.do(Play("one"), Randomise("none"))
    assert (counted.task.beginning.preset, counted.session.state.preset) == ("none", "none")


@pytest.mark.parametrize(("asked", "kept"), [(0.001, SLOWEST), (0.5, 0.5), (100.0, FASTEST)])
def test_the_speed_has_bounds_and_holds_from_now_on(asked: float, kept: float):
    counted = Counted()
    counted.do(Run(True))
    counted.clock.now += 0.5 * DT
    assert counted.do(Speed(asked)).speed == kept  # a step is due at once
    assert counted.session.state.episode.step == 2
    counted.clock.now += 0.99 * DT / kept
    assert not counted.session.turn()
    counted.clock.now += 0.02 * DT / kept
    assert counted.session.turn()


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_orders_with_numbers_that_are_not_finite_change_nothing(number: float):
    """A page's client may send any number."""
    counted = Counted()
    speed = counted.session.state.speed
    for order, words in (
        (Speed(number), "The speed is"),
        (Push(number, 0.0), "The push is"),
        (Push(1.0, number), "The push is"),
    ):
        assert words in (counted.do(order).message or "")
    assert counted.session.state.speed == speed
    assert counted.task.pushes == []


def test_a_push_has_its_direction():
    counted = Counted()
    counted.do(Push(2.0, math.pi / 6))
    assert counted.task.pushes == [pytest.approx((math.sqrt(3), 1.0))]


def test_states_are_counted_and_orders_pass_through_no_poses():
    counted = Counted()
    first = counted.session.state
    assert (first.count, first.at, first.passed) == (1, 0.0, ())
    counted.clock.now = 0.5 * DT
    assert counted.session.turn()
    found = counted.session.state
    assert (found.count, found.at) == (2, 0.5 * DT)
    assert found.passed[0].objects["cube"].tolist() == poses(0.5).objects["cube"].tolist()
    assert counted.do(Repeat(True)).passed == ()


class Waiting:
    """A queue that keeps for how long it was waited for orders [s], 0 where it was not."""

    def __init__(self) -> None:
        self.orders: list[Any] = []
        self.waits: list[float] = []
        self.put = self.orders.append

    def get(self, timeout: float) -> Any:
        self.waits.append(timeout)
        raise queue.Empty

    def get_nowait(self) -> Any:
        self.waits.append(0.0)
        if not self.orders:
            raise queue.Empty
        return self.orders.pop(0)

    def empty(self) -> bool:
        return not self.orders


def test_a_turn_waits_for_orders_until_the_next_step_is_due(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("dora.live.session.queue", SimpleNamespace(SimpleQueue=Waiting, Empty=queue.Empty))
    counted = Counted()
    waiting: Any = counted.session._orders
    assert counted.session.turn(wait=True)  # due already
    counted.clock.now += 0.25 * DT
    assert not counted.session.turn(wait=True)
    assert not counted.session.turn()
    assert waiting.waits == pytest.approx([0.0, 0.75 * DT, 0.0])
    waiting.waits.clear()
    counted.do(Speed(SLOWEST))  # the next one is due in 1.25 s
    counted.session.turn(wait=True)
    counted.do(Run(False))
    counted.session.turn(wait=True)
    assert [wait for wait in waiting.waits if wait] == [IDLE, IDLE]


@pytest.mark.parametrize("alive", [None, False, True])
def test_the_environment_is_closed_unless_the_thread_still_uses_it(alive: bool | None):
    counted, joined = Counted(), []
    thread: Any = SimpleNamespace(join=joined.append, is_alive=lambda: alive)
    counted.session._thread = None if alive is None else thread
    counted.session.stop()
    assert counted.task.closed is (alive is not True)
    assert len(joined) == (alive is not None)
