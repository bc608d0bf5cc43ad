"""The controls of a live page: widgets that give orders to a session and follow it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from dora.arguments import LARGEST_SEED
from dora.live.orders import Choose, Order, Play, Push, Randomise, Repeat, Reset, Run, Speed, Start, Step
from dora.live.state import LiveState
from dora.tasks.mdp.randomisation import PRESETS

NEAREST = "the nearest"
"""Choice of no particular candidate."""
STRONGEST, MIDDLE = 0.5, 0.1
"""Largest impulse of a push, and the one at the beginning [N s]."""
SAME = 1e-6
"""Difference of a start's numbers, relative to their range, below which they are the same [1]."""
DIGITS = 3
"""Decimal places of a slider of the start [1]."""
SLIDER_STEPS = 200
"""Steps of a slider of the start [1]."""
SPEEDS = (0.1, 3.0, 0.1)
"""Lowest and highest speed and step of its slider [1]."""


class Panel:
    """The widgets; each gives an order when a person changes it, and follows the session when that changes.

    Args:
        gui: of viser's server.
        state: the present one.
        players: names of those who may act.
        order: takes the orders.
    """

    def __init__(self, gui: Any, state: LiveState, players: list[str], order: Callable[[Order], None]):
        self._gui, self._order, self._told = gui, order, state
        self.player = gui.add_dropdown("who acts", players, initial_value=state.player)
        with gui.add_folder("Time"):
            self.pause = gui.add_button("Pause")
            self.step = gui.add_button("Step")
            self.speed = gui.add_slider("speed", *SPEEDS, min(max(state.speed, SPEEDS[0]), SPEEDS[1]))
            self.repeat = gui.add_checkbox("next episode by itself", state.repeat)
        with gui.add_folder("Episode"):
            self.reset = gui.add_button("Reset")
            self.seed = gui.add_number("seed", state.episode.seed, min=0, max=LARGEST_SEED, step=1)
            self.preset = gui.add_dropdown("randomisation", tuple(PRESETS), initial_value=state.preset)
            self.candidate = gui.add_dropdown("candidate", (NEAREST,), initial_value=NEAREST)
        self._start_folder = gui.add_folder("Start")
        self.sliders: dict[int, Any] = {}
        with gui.add_folder("Push"):
            self.push = gui.add_button("Push the object")
            self.impulse = gui.add_slider("impulse [N s]", 0.0, STRONGEST, 0.01, MIDDLE)
            self.direction = gui.add_slider("direction [deg]", 0, 360, 15, 90)
        self._connect()
        self._rebuild(state)

    def _connect(self) -> None:
        """Gives an order for each widget that a person changes. What only follows the session gives none."""
        self.pause.on_click(lambda _: self._order(Run(not self._told.running)))
        self.step.on_click(lambda _: self._order(Step()))
        self.reset.on_click(lambda _: self._order(Reset(int(self.seed.value))))
        self.push.on_click(lambda _: self._order(Push(self.impulse.value, math.radians(self.direction.value))))
        self._asks(self.speed, Speed, lambda told: told.speed)
        self._asks(self.repeat, Repeat, lambda told: told.repeat)
        self._asks(self.player, Play, lambda told: told.player)
        self._asks(self.preset, Randomise, lambda told: told.preset)
        self.candidate.on_update(lambda _: self._choose())

    def _asks(self, widget: Any, order: Callable[[Any], Order], told: Callable[[LiveState], Any]) -> None:
        def ask(_: Any) -> None:
            if widget.value != told(self._told):
                self._order(order(widget.value))

        widget.on_update(ask)

    def _choose(self) -> None:
        if self.candidate.value != _candidate_words(self._told):
            word = self.candidate.value
            self._order(Choose(None if word == NEAREST else self._told.setup.candidates.index(word)))

    def _place(self, k: int) -> None:
        """Asks for the start with the number of slider k, if a person has moved it."""
        n, value = self._told.setup.numbers[k], self.sliders[k].value
        if abs(value - _value(self._told, k)) > SAME * (n.high - n.low):
            self._wanted[k] = min(max(n.share_of(value), 0.0), 1.0)
            shares = tuple(self._wanted)
            self._asked.add(shares)
            self._order(Start(shares))

    def _rebuild(self, state: LiveState) -> None:
        """Sliders and choices of another environment."""
        self._told = state
        for slider in self.sliders.values():
            slider.remove()
        self.sliders = {}
        free = [(k, n) for k, n in enumerate(state.setup.numbers) if n.free]
        with self._start_folder:
            for k, n in free:
                step = (n.high - n.low) / SLIDER_STEPS
                slider = self._gui.add_slider(f"{n.name} [{n.unit}]", n.low, n.high, step, _value(state, k))
                slider.on_update(lambda _, k=k: self._place(k))
                self.sliders[k] = slider
        self._wanted, self._asked = list(state.episode.shares), set[tuple[float, ...]]()
        self._start_folder.visible = bool(free)
        self.candidate.options = (NEAREST, *state.setup.candidates)
        self.candidate.visible = bool(state.setup.candidates)

    def update(self, state: LiveState) -> None:
        """Follows the session where values changed, or were refused."""
        told, self._told = self._told, state
        if state.setup is not told.setup:
            self._rebuild(state)
        refused = state.message != told.message
        for widget, value in (
            (self.speed, lambda s: min(max(s.speed, SPEEDS[0]), SPEEDS[1])),
            (self.repeat, lambda s: s.repeat),
            (self.player, lambda s: s.player),
            (self.preset, lambda s: s.preset),
            (self.candidate, _candidate_words),
            (self.seed, lambda s: s.episode.seed),
        ):
            if refused or value(state) != value(told):
                widget.value = value(state)
        moved = state.episode.shares != told.episode.shares and state.episode.shares not in self._asked
        if refused or moved:  # a slider that a person is moving stays where it is
            self._wanted, self._asked = list(state.episode.shares), set()
            for k, slider in self.sliders.items():
                slider.value = _value(state, k)
        label = "Pause" if state.running else "Run"
        if self.pause.label != label:
            self.pause.label = label


def _candidate_words(state: LiveState) -> str:
    return NEAREST if state.candidate is None else state.setup.candidates[state.candidate]


def _value(state: LiveState, k: int) -> float:
    """Number k of the present start, in its unit, as its slider shows it."""
    n = state.setup.numbers[k]
    return min(max(round(n.low + state.episode.shares[k] * (n.high - n.low), DIGITS), n.low), n.high)
