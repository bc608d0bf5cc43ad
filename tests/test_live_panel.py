"""The controls of a live page, without a browser: what they ask for, and how they follow their session."""

import math
from dataclasses import replace
from typing import Any

import pytest
from invented_live import SETUP, Gui, state

from dora.arguments import LARGEST_SEED
from dora.live.orders import Choose, Order, Play, Push, Randomise, Repeat, Reset, Run, Speed, Start, Step
from dora.live.panel import NEAREST, Panel
from dora.live.state import LiveState
from dora.tasks.env.starts import StartNumber


class Shown:
    """A panel, what is on it by its words, and what it has asked for."""

    def __init__(self, first: LiveState):
        self.gui, self.orders = Gui(), list[Order]()
        self.panel = Panel(self.gui, first, ["one", "two"], self.orders.append)
        self.found = self.gui.found

    def asked(self, word: str, value: object = None) -> list[Order]:
        """What is asked for when a person uses a widget."""
        self.orders.clear()
        self.found[word].use(value)
        return self.orders


def test_widgets_begin_as_the_session_stands():
    found = Shown(state(seed=7, speed=5.0, repeat=False, player="two", preset="hard")).found
    values = {word: found[word].value for word in ("who acts", "speed", "next episode by itself", "seed", "candidate")}
    assert values == {"who acts": "two", "speed": 3.0, "next episode by itself": False, "seed": 7, "candidate": NEAREST}
    assert found["randomisation"].value == "hard"
    assert Shown(state(speed=0.05)).found["speed"].value == 0.1
    seed, impulse, direction, x = (found[word] for word in ("seed", "impulse [N s]", "direction [deg]", "x [m]"))
    assert (seed.min, seed.max, seed.step) == (0, LARGEST_SEED, 1)
    assert (impulse.low, impulse.high, impulse.step, impulse.value) == (0.0, 0.5, 0.01, 0.1)
    assert (direction.low, direction.high, direction.step, direction.value) == (0, 360, 15, 90)
    assert (x.low, x.high, x.value) == (-1.0, 3.0, 0.0)
    assert x.step == pytest.approx(0.02)
    assert found["candidate"].options == (NEAREST, *SETUP.candidates)
    assert found["candidate"].visible
    assert found["Start"].visible


def test_each_widget_asks_for_what_is_written_on_it():
    shown = Shown(state(seed=7))
    assert shown.asked("Pause") == [Run(False)]
    assert shown.asked("Step") == [Step(1)]
    assert shown.asked("Reset") == [Reset(7)]
    assert shown.asked("Push the object") == [Push(0.1, math.pi / 2)]
    choices: Any = (
        ("speed", 1.0, 0.5, Speed), ("next episode by itself", True, False, Repeat), ("who acts", "one", "two", Play),
        ("randomisation", "standard", "hard", Randomise),
    )  # fmt: skip
    for word, same, other, order in choices:
        assert shown.asked(word, same) == []
        assert shown.asked(word, other) == [order(other)]
    shown.panel.update(state(seed=7, running=False, candidate=1))
    assert shown.asked("Pause") == [Run(True)]
    assert shown.asked("candidate", "1: body") == []
    assert shown.asked("candidate", "0: handle") == [Choose(0)]
    assert shown.asked("candidate", NEAREST) == [Choose(None)]


@pytest.mark.parametrize(("value", "share"), [(2.0, 0.75), (4.0, 1.0), (-2.0, 0.0), (1e-4, 0.250025)])
def test_a_slider_asks_for_its_share_of_the_range(value: float, share: float):
    shown = Shown(state())
    assert shown.asked("x [m]", 0.0) == []
    assert shown.asked("x [m]", 3e-6) == []
    assert shown.asked("turn [rad]", 0.25) == []
    for word, moved, expected in (("x [m]", value, (share, 0.5)), ("turn [rad]", 0.5, (share, 1.0))):
        (order,) = shown.asked(word, moved)
        assert isinstance(order, Start)
        assert order.shares == pytest.approx(expected)


def test_sliders_follow_a_start_unless_a_person_has_asked_for_it():
    shown = Shown(state())
    x, turn = shown.panel.sliders.values()
    shown.asked("x [m]", 1.0)
    shown.asked("x [m]", 2.0)
    shown.panel.update(state(shares=(0.5, 0.5)))  # the answer to the first one
    assert x.value == 2.0
    shown.panel.update(state(shares=(0.1, 0.2)))  # another episode
    assert (x.value, turn.value) == pytest.approx((-0.6, 0.1))
    shown.panel.update(state(shares=(0.5, 0.5)))
    assert (x.value, turn.value) == pytest.approx((1.0, 0.25))
    assert shown.asked("turn [rad]", 0.0) == [Start((0.5, 0.0))]
    x.value = 0.7
    shown.panel.update(state(shares=(0.5, 0.0)))
    shown.panel.update(state(shares=(0.5, 0.0)))
    assert x.value == 0.7


def test_widgets_follow_what_has_changed_and_keep_what_a_person_types():
    shown = Shown(state())
    shown.found["seed"].value = 99
    shown.panel.update(state(speed=7.0, repeat=False, player="two", preset="hard", candidate=2))
    values = [shown.found[word].value for word in ("speed", "next episode by itself", "who acts", "randomisation")]
    assert values == [3.0, False, "two", "hard"]
    assert (shown.found["candidate"].value, shown.found["seed"].value) == ("2: rim", 99)
    shown.panel.update(state(speed=0.01, seed=4))
    assert (shown.found["speed"].value, shown.found["seed"].value) == (0.1, 4)
    assert shown.orders == []


def test_what_was_refused_is_taken_back():
    shown = Shown(state())
    for word, value in (("seed", 99), ("x [m]", 2.0), ("speed", 2.0)):
        shown.found[word].value = value
    shown.panel.update(state(message="no."))
    assert [shown.found[word].value for word in ("seed", "x [m]", "speed")] == [0, 0.0, 1.0]


def test_the_button_says_what_it_would_do():
    shown = Shown(state())
    pause = shown.panel.pause
    shown.panel.update(state(running=False))
    assert pause.label == "Run"
    shown.panel.update(state())
    assert pause.label == "Pause"


def test_another_environment_has_other_sliders_and_candidates():
    shown = Shown(state())
    old = list(shown.panel.sliders.values())
    numbers = (StartNumber("height", "m", 0.1234, 0.5678), StartNumber("far", "m", 0.0, 3.0))
    setup = replace(SETUP, numbers=numbers, candidates=())
    shown.panel.update(state(setup=setup, shares=(0.0, 0.33333333)))
    assert all(slider.removed for slider in old)
    assert [slider.value for slider in shown.panel.sliders.values()] == [0.1234, 1.0]
    assert shown.found["candidate"].options == (NEAREST,)
    assert not shown.found["candidate"].visible
    shown.panel.update(state(setup=setup, shares=(1.0, 0.12345678)))
    assert [slider.value for slider in shown.panel.sliders.values()] == [0.5678, 0.37]
    shown.panel.update(state(setup=replace(setup, numbers=()), shares=()))
    assert shown.panel.sliders == {}
    assert not shown.found["Start"].visible


def test_a_number_with_a_single_value_has_no_slider():
    """Such as the place of a cube that always stands in the same one."""
    numbers = (StartNumber("x", "m", 0.5, 0.5), StartNumber("yaw", "rad", 0.0, 4.0))
    shown = Shown(state(setup=replace(SETUP, numbers=numbers), shares=(0.0, 0.25)))
    assert list(shown.panel.sliders) == [1]
    assert shown.asked("yaw [rad]", 3.0) == [Start((0.0, 0.75))]
    shown.panel.update(state(setup=replace(SETUP, numbers=numbers), shares=(0.0, 0.5)))
    assert shown.panel.sliders[1].value == 2.0
    shown.panel.update(state(setup=replace(SETUP, numbers=numbers[:1]), shares=(0.0,)))
    assert not shown.found["Start"].visible
