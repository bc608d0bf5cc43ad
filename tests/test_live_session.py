"""A live session does what it is asked: seeds, time, players, starts, candidates, pushes; and says how it stands."""

import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
import torch
from live import Watched

from dora.errors import InputError
from dora.geometry.rotations import quaternion_apply
from dora.live.orders import Choose, Play, Push, Randomise, Repeat, Reset, Run, Speed, Start, Step
from dora.live.players import ZERO, Player, zero_correction
from dora.live.session import Session

BUSY = "busy"
"""A player that moves the fingers."""


def busy(observation: torch.Tensor) -> torch.Tensor:
    return torch.full((1, 26), 0.8)


@pytest.fixture(scope="module")
def hammer() -> Iterator[Watched]:
    watched = Watched("DoraHammer-v1", preset="none")
    yield watched
    watched.session.stop()


@pytest.fixture(scope="module")
def cube() -> Iterator[Watched]:
    watched = Watched("DoraCube-v1", [zero_correction({}), Player(BUSY, {}, busy)], preset="none")
    yield watched
    watched.session.stop()


@pytest.fixture(autouse=True)
def _as_at_the_beginning(request: pytest.FixtureRequest) -> None:
    for name in ("hammer", "cube"):
        if name in request.fixturenames:
            watched = request.getfixturevalue(name)
            watched.back_to_zero()


def test_an_episode_walks_all_stages_succeeds_and_is_followed_by_the_next(cube: Watched):
    seen, setup = [], cube.state.setup
    for _ in range(setup.max_steps):
        state = cube.steps(1)
        seen.append(*state.episode.stages)
    (ladder,) = setup.ladders
    assert sorted(set(seen)) == list(range(len(ladder) + 1))
    assert state.episode.over
    assert state.episode.success
    assert state.episode.verdict.startswith("success: all stages done")
    history = state.episode.history
    assert history.time.tolist() == pytest.approx([(k + 1) * setup.dt for k in range(setup.max_steps)])
    assert history.terms.shape == (setup.max_steps, len(setup.terms))
    assert history.terms[-1].sum() == pytest.approx(state.episode.reward, abs=1e-4)
    assert history.overlap[-1, 1] == history.overlap[:, 0].max() <= setup.limit
    assert (state.episodes, state.successes) == (1, 1)
    assert cube.steps(1) is state  # it rests
    state = cube.rest()
    assert (state.episode.seed, state.episode.step) == (1, 0)
    assert len(state.episode.history.time) == 0


def test_a_control_step_is_shown_physics_step_by_physics_step(cube: Watched):
    before = cube.steps(8)
    state = cube.steps(1)
    assert len(state.passed) == round(cube.env.sim_freq / cube.env.control_freq) - 1 == 4
    step = state.setup.dt / (len(state.passed) + 1)
    times = state.at + step * (np.arange(7) + 0.5)
    indices, poses = zip(*(state.poses_at(time) for time in times), strict=True)
    assert indices == (0, 1, 2, 3, 4, 4, 4)
    assert poses[4] is state
    arm = next(iter(state.setup.robots))
    wrist = [moment.links[arm, state.setup.robots[arm].wrist_link] for moment in (before, *poses[:5])]
    ways = [float(np.linalg.norm(after[:3] - earlier[:3])) for earlier, after in itertools.pairwise(wrist)]
    assert min(ways) > 1e-4  # it moves in each
    assert np.linalg.norm(wrist[-1][:3] - wrist[0][:3]) == pytest.approx(sum(ways), rel=0.05)  # and does not jump
    cube.do(Speed(0.1))
    slow = cube.steps(1)
    assert slow.poses_at(slow.at + 10.5 * step)[0] == 1
    assert cube.do(Reset()).passed == ()  # nothing leads to a new start


def test_without_repetition_nothing_follows_an_episode(cube: Watched):
    cube.do(Repeat(False))
    over = cube.to_the_end()
    assert over.episode.over
    assert cube.rest() is over
    assert cube.do(Reset()).episode.step == 0


def test_a_seed_repeats_an_episode_and_another_one_does_not(cube: Watched):
    cube.do(Randomise("standard"))

    def played(seed: int) -> tuple[np.ndarray, float]:
        cube.do(Reset(seed))
        state = cube.steps(15)
        return np.concatenate([*state.links.values(), state.objects["cube"]]), state.scales["cube"]

    first, again, other = played(3), played(3), played(4)
    assert np.array_equal(first[0], again[0])
    assert first[1] == again[1] != 1.0
    assert not np.allclose(first[0], other[0])
    assert cube.do(Reset(-1)).message == "The seed is -1, and has to be from 0 to 2147483647."
    assert cube.state.episode.seed == 4


def test_time_stops_goes_on_and_goes_step_by_step(cube: Watched):
    assert cube.steps(3).episode.step == 3
    assert not cube.do(Run(False)).running
    assert cube.steps(5).episode.step == 3
    cube.do(Step(2))
    assert cube.steps(5).episode.step == 5
    cube.do(Run(True))
    assert cube.steps(2).episode.step == 7


@pytest.mark.parametrize("speed", [0.5, 1.0, 2.0])
def test_a_step_is_due_after_its_share_of_real_time(cube: Watched, speed: float):
    cube.do(Speed(speed))
    session, clock, dt = cube.session, cube.clock, cube.state.setup.dt
    cube.steps(1)
    clock.now += 0.99 * dt / speed
    assert not session.turn()
    clock.now += 0.02 * dt / speed
    assert session.turn()
    for _ in range(60):
        clock.now += dt / speed
        session.turn()
    assert cube.state.rate == pytest.approx(speed, rel=0.02)


def test_a_slow_machine_does_not_catch_up_in_a_burst(cube: Watched):
    cube.steps(1)
    cube.clock.now += 10.0
    done = 0
    while cube.session.turn():
        done += 1
    assert 1 <= done <= 4


def test_a_push_gives_a_falling_hammer_the_speed_of_its_impulse(hammer: Watched):
    mass = float(hammer.env.memory.object.mass[0])
    free = hammer.steps(1) and hammer.env.snapshot.object.v[0].clone()
    hammer.do(Reset(0), Push(0.2, math.pi / 2))
    hammer.steps(1)
    pushed = hammer.env.snapshot.object.v[0]
    assert (pushed - free).tolist() == pytest.approx([0.0, 0.2 / mass, 0.0], abs=2e-3)


def test_a_hammer_that_is_pushed_away_falls_and_the_cause_is_said(hammer: Watched):
    hammer.do(Push(0.5, math.pi / 2))
    state = hammer.to_the_end()
    assert state.episode.over
    assert not state.episode.success
    assert state.episode.verdict == "failed: the hammer has fallen"
    assert (state.episodes - state.successes) >= 1


def test_a_start_is_where_the_sliders_say(hammer: Watched, cube: Watched):
    shares = (0.25, 1.0, 0.5)
    state = cube.do(Start(shares))
    values = [n.low + s * (n.high - n.low) for n, s in zip(state.setup.numbers, shares, strict=True)]
    p, q = np.split(state.objects["cube"], [3])
    assert p[:2].tolist() == pytest.approx(values[:2], abs=1e-4)
    assert 2 * math.atan2(q[3], q[0]) % (2 * math.pi) == pytest.approx(values[2], abs=1e-4)
    assert state.episode.shares == shares
    assert cube.do(Reset(0)).episode.shares != shares

    released = hammer.state.episode.shares
    chosen = (0.9, 0.1, 0.0, *released[3:])
    state = hammer.do(Start(chosen))
    x, y, fall, *_ = state.setup.numbers
    p = state.objects["hammer"][:3]
    assert p[:2].tolist() == pytest.approx([x.low + 0.9 * (x.high - x.low), y.low + 0.1 * (y.high - y.low)], abs=1e-4)
    higher = hammer.do(Start((0.9, 0.1, 1.0, *released[3:]))).objects["hammer"][2]
    assert higher - p[2] == pytest.approx(fall.high - fall.low, abs=1e-4)


def test_a_random_start_is_shown_as_the_shares_that_give_it_again(hammer: Watched, cube: Watched):
    for watched, name in ((hammer, "hammer"), (cube, "cube")):
        random = watched.do(Reset(7))
        again = watched.do(Start(random.episode.shares))
        np.testing.assert_allclose(again.objects[name], random.objects[name], atol=1e-4)


def test_of_a_moving_slider_only_the_last_place_counts(cube: Watched):
    before = cube.state.count
    state = cube.do(*(Start((k / 10, 0.5, 0.5)) for k in range(10)))
    assert state.count == before + 1
    assert state.episode.shares[0] == 0.9


@pytest.mark.parametrize("shares", [(0.5,), (0.5, 0.5, 1.5), ()])
def test_a_start_with_other_numbers_is_refused(cube: Watched, shares: tuple[float, ...]):
    before = cube.state.objects["cube"]
    state = cube.do(Start(shares))
    assert state.message == "A start of this task has 3 numbers, each a share from 0 to 1."
    assert np.array_equal(state.objects["cube"], before)


def test_the_chosen_candidate_is_the_one_that_is_followed(hammer: Watched):
    nearest = hammer.state.episode.chosen["arm"]
    other = next(k for k in hammer.state.episode.reachable if k != nearest)
    state = hammer.do(Choose(other))
    assert (state.candidate, state.episode.chosen["arm"]) == (other, other)
    candidates = hammer.env.guide.choice.candidates
    p, q = (torch.from_numpy(x) for x in np.split(state.objects["hammer"], [3]))
    wrist = p + quaternion_apply(q, candidates.position[other])
    assert state.goals["arm"].wrist[:3].tolist() == pytest.approx(wrist.tolist(), abs=1e-4)
    assert hammer.do(Choose(99)).message.startswith("There is no candidate 99")
    assert hammer.state.candidate == other
    assert hammer.do(Choose(None)).episode.chosen["arm"] == nearest


def test_a_policy_acts_otherwise_than_zero_correction(cube: Watched):
    zero = cube.steps(20)
    state = cube.do(Play(BUSY))
    assert (state.player, state.episode.step, state.episodes) == (BUSY, 0, 0)
    acted = cube.steps(20)
    tips = [("arm", link.name) for link in cube.env.arm.agent.distals]
    assert max(np.abs(acted.links[tip] - zero.links[tip]).max() for tip in tips) > 0.01
    state = cube.do(Play("nobody"))
    assert state.message == f"There is no 'nobody'; choose one of {ZERO}, {BUSY}."
    assert state.player == BUSY


def test_a_preset_is_in_force_from_the_next_episode_on(cube: Watched):
    assert cube.state.scales["cube"] == 1.0
    state = cube.do(Randomise("hard"))
    assert (state.preset, state.episode.step) == ("hard", 0)
    assert cube.env.config.randomisation.push > 0
    assert state.scales["cube"] != 1.0
    assert "unknown preset 'harder': did you mean 'hard'?" in cube.do(Randomise("harder")).message


def test_forces_are_those_that_the_task_reads(hammer: Watched):
    state = hammer.steps(45)
    assert state.episode.stages[0] >= 2
    hand = hammer.env.snapshot.hand
    parts = ("thumb", "index", "middle", "ring", "pinky", "palm")
    shown = dict(zip(state.forces.pairs, np.linalg.norm(state.forces.forces, axis=1).tolist(), strict=True))
    for part, force in zip(parts, hand.force[0].tolist(), strict=True):
        assert shown.get((f"arm.{part}", "hammer"), 0.0) == pytest.approx(force, rel=1e-4, abs=2e-3)
    held = [k for k, (_, other) in enumerate(state.forces.pairs) if other == "hammer"]
    assert len(held) >= 2
    away = np.linalg.norm(state.forces.points[held] - state.objects["hammer"][:3], axis=1)
    assert away.max() < 0.25  # on the hammer, which is 30 cm long


def test_a_cube_that_stands_is_carried_by_the_table_from_below(cube: Watched):
    state = cube.steps(3)
    carried = state.forces.pairs.index(("cube", "world"))
    weight = 9.81 * float(cube.env.memory.object.mass[0])
    assert state.forces.forces[carried].tolist() == pytest.approx([0.0, 0.0, weight], abs=0.05 * weight)
    assert state.forces.points[carried][2] == pytest.approx(0.0, abs=2e-3)
    assert state.forces.points[carried][:2].tolist() == pytest.approx(state.objects["cube"][:2].tolist(), abs=5e-3)


def test_bodies_are_where_the_simulator_has_them(hammer: Watched):
    state = hammer.steps(40)
    s = hammer.env.snapshot
    assert state.objects["hammer"].tolist() == pytest.approx([*s.object.p[0].tolist(), *s.object.q[0].tolist()])
    wrist = state.links["arm", hammer.env.arm.agent.wrist.name]
    assert wrist[:3].tolist() == pytest.approx(s.hand.wrist_p[0].tolist())
    assert set(state.fixtures) == {"table", "post", "nail"} == set(state.setup.fixtures)


def test_a_state_is_frozen_and_its_history_does_not_grow(cube: Watched):
    state: Any = cube.steps(2)
    with pytest.raises(FrozenInstanceError):
        state.running = False
    cube.steps(3)
    assert len(state.episode.history.time) == 2
    assert len(cube.state.episode.history.time) == 5


def wait_for(found: Any, patience: float = 60.0) -> None:
    end = time.monotonic() + patience
    while not found():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_thread_steps_by_itself_obeys_and_ends():
    session = Session("DoraCube-v1", [zero_correction({})], preset="none")
    session.start()
    wait_for(lambda: session.state.episode.step >= 3)
    session.order(Run(False))
    wait_for(lambda: not session.state.running)
    step = session.state.episode.step
    time.sleep(0.3)
    assert session.state.episode.step == step
    session.stop()
    assert session.error is None


def test_what_ends_the_thread_is_kept():
    def broken(observation: torch.Tensor) -> torch.Tensor:
        raise ZeroDivisionError("a policy that breaks")

    session = Session("DoraCube-v1", [Player("broken", {}, broken)], preset="none")
    session.start()
    wait_for(lambda: session.error is not None)
    assert isinstance(session.error, ZeroDivisionError)
    session.stop()


def test_an_action_that_is_not_finite_stops_time_and_is_explained():
    watched = Watched("DoraCube-v1", [Player("broken", {}, lambda o: torch.full((1, 26), torch.nan))], preset="none")
    state = watched.steps(1)
    assert (state.running, state.episode.step) == (False, 0)
    assert "NaN" in state.message
    watched.session.stop()


@pytest.mark.slow
def test_two_arms_are_shown_without_candidates_and_starts_to_choose():
    watched = Watched("DoraMicrowave-v1", preset="none", seed=3)
    setup = watched.state.setup
    assert (setup.candidates, setup.numbers) == ((), ())
    assert set(watched.state.objects) == {"microwave", "cube"}
    assert set(watched.state.goals) == set(watched.state.episode.chosen) == {"left", "right"}
    assert {"body", "door", "handle"} <= set(watched.state.fixtures)
    for order, words in ((Choose(0), "has 0 that can be chosen"), (Start((0.5,)), "has 0 numbers")):
        assert words in watched.do(order).message
    state = watched.to_the_end()
    assert state.episode.over
    assert state.episode.stages[0] > setup.ladders[0].index("open")
    assert state.episode.history.terms.shape == (state.episode.step, len(setup.terms))
    watched.session.stop()


def test_nobody_who_acts_and_unknown_names_are_refused():
    with pytest.raises(InputError, match="Somebody has to act"):
        Session("DoraCube-v1", [])
    with pytest.raises(InputError, match="did you mean 'standard'"):
        Session("DoraCube-v1", [zero_correction({})], preset="standart")
    with pytest.raises(InputError, match="did you mean 'DoraCube-v1'"):
        Session("DoraCub-v1", [zero_correction({})])
