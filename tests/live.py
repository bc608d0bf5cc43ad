"""A session whose time is the test's: each control step is due when the test says so."""

import socket
from collections.abc import Sequence
from typing import Any

from dora.live.orders import Order, Play, Randomise, Repeat, Reset, Run, Speed
from dora.live.players import ZERO, Player, zero_correction
from dora.live.session import REST, Session
from dora.live.state import LiveState


def free_port() -> int:
    """A TCP port that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Clock:
    """A clock that stands still until it is moved."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Watched:
    """A session with a clock; it is driven without a thread."""

    def __init__(self, env_id: str, players: Sequence[Player] = (), **options: Any):
        self.clock = Clock()
        self.session = Session(env_id, players or [zero_correction({})], clock=self.clock, **options)

    @property
    def state(self) -> LiveState:
        return self.session.state

    @property
    def env(self) -> Any:
        return self.session._task.env

    def do(self, *orders: Order) -> LiveState:
        """The state after some orders, before time goes on."""
        for order in orders:
            self.session.order(order)
        self.session._obey(0.0)
        return self.state

    def back_to_zero(self) -> None:
        """Zero correction, nothing random, at the start of the episode with seed 0, which runs."""
        state = self.state
        orders: list[Order] = [Speed(1.0), Repeat(True), Run(True), Reset(0)]
        if state.player != ZERO or state.candidate is not None:
            orders.insert(0, Play(ZERO))
        if state.preset != "none":
            orders.insert(0, Randomise("none"))
        self.do(*orders)

    def steps(self, count: int) -> LiveState:
        """The state after so many control steps, fewer if the episode ends."""
        for _ in range(count):
            self.clock.now = max(self.clock.now, self.session._due)
            if not self.session.turn():
                break
        return self.state

    def to_the_end(self) -> LiveState:
        return self.steps(100_000)

    def rest(self) -> LiveState:
        """The state after the pause that follows an episode."""
        self.clock.now += REST
        self.session.turn()
        return self.state
