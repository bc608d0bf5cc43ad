"""How often a page is updated is measured rightly, with invented sessions, pages and clients."""

import importlib
import socket
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from invented_live import state

from dora.errors import InputError
from dora.live import page_rate
from dora.live.page import Page
from dora.live.page_rate import LONGEST, OPENING, SHORTEST, Client, free_port, measure
from dora.live.players import Player
from dora.live.session import Session
from dora.live.state import LiveState

TICK = 1 / 64
"""Time that passes in each look [s]."""


class World:
    """A session, a page and its client, which change from look to look as a test says; time passes in looks alone.

    Attributes:
        states: number of looks since the client's first message -> state then.
        sends: whether the client gets anything.
        ended: who was stopped, in order.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, states: Callable[[int], LiveState]):
        self.now, self.looks, self.states, self.sends, self.ended = 0.0, -1, states, True, list[str]()
        world = self

        class Counted(Session):
            def __init__(self, env_id: str, players: Any, *, preset: str):
                self.state, self.error = states(0), None
                self.start = lambda: None
                self.stop = lambda: world.ended.append("session")

        class Sent(Page):
            def __init__(self, session: Any, port: int):
                self.sent, self.error = 100, None
                self.start = lambda: None
                self.stop = lambda: world.ended.append("page")

        class Taking(Client):
            def __init__(self, port: int):
                self.bytes = 0
                self.close = lambda: world.ended.append("client")

        def made(kind: str, cls: Any) -> Callable[..., Any]:
            def make(*words: Any, **options: Any) -> Any:
                setattr(world, kind, cls(*words, **options))
                return getattr(world, kind)

            return make

        for kind, cls in (("Session", Counted), ("Page", Sent), ("Client", Taking)):
            monkeypatch.setattr(page_rate, kind, made(kind.lower(), cls))
        self.session: Any = None
        self.page: Any = None
        self.client: Any = None
        monkeypatch.setattr(page_rate, "time", SimpleNamespace(monotonic=lambda: self.now, sleep=self.sleep))

    def sleep(self, seconds: float) -> None:
        self.now += TICK
        if self.sends:
            self.looks += 1
            self.client.bytes += 500
            self.page.sent += 1 if self.session.state.episode.over else 2
            self.session.state = self.states(self.looks)


def played(look: int) -> LiveState:
    """At half of real time: 33 looks of seed 0, a rest of 16, 8 looks of seed 1, which is reset to seed 2."""
    if look < 49:
        return state(seed=0, time=min(look, 33) / 128, over=look >= 33)
    seed, first = (1, 49) if look < 57 else (2, 57)
    return state(seed=seed, time=(look - first) / 128)


def test_rates_count_what_passed_while_an_episode_ran(monkeypatch: pytest.MonkeyPatch):
    world = World(monkeypatch, played)
    found = measure("Invented-v1", [Player("one")], 1.0)
    assert (found.env, found.seconds, found.running_share) == ("Invented-v1", 1.0, 0.75)
    assert found.states_per_second == 2 * 48 + 16
    assert found.states_per_second_running == 2 * 48 / 0.75
    assert found.real_time == pytest.approx(47 / 128 / 0.75)
    assert found.kilobytes_per_second == pytest.approx(64 * 500 / 1000)
    assert sorted(world.ended) == ["client", "page", "session"]


def test_rates_of_a_session_that_rests_are_zero(monkeypatch: pytest.MonkeyPatch):
    World(monkeypatch, lambda look: state(over=True))
    found = measure("Invented-v1", [Player("one")], 0.5)
    assert (found.states_per_second_running, found.real_time, found.running_share) == (0.0, 0.0, 0.0)
    assert found.states_per_second == 64


def test_a_page_that_sends_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch):
    world = World(monkeypatch, played)
    world.sends = False
    with pytest.raises(RuntimeError, match="has sent nothing for 30 s"):
        measure("Invented-v1", [Player("one")], 1.0)
    assert OPENING < world.now < OPENING + 1
    assert sorted(world.ended) == ["client", "page", "session"]


@pytest.mark.parametrize("who", ["session", "page"])
def test_what_breaks_down_ends_the_measurement(monkeypatch: pytest.MonkeyPatch, who: str):
    def broken(look: int) -> LiveState:
        if look == 5:
            getattr(world, who).error = ZeroDivisionError("broken")
        return played(look)

    world = World(monkeypatch, broken)
    with pytest.raises(RuntimeError, match="the page has ended: broken"):
        measure("Invented-v1", [Player("one")], 1.0)
    assert world.looks == 5


@pytest.mark.parametrize("seconds", [0.99 * SHORTEST, 1.01 * LONGEST, float("nan")])
def test_lengths_have_bounds(seconds: float):
    with pytest.raises(InputError, match=r"--seconds is .* and has to be from 0.1 to 86400"):
        measure("Invented-v1", [], seconds)


def test_a_client_counts_what_comes(monkeypatch: pytest.MonkeyPatch):
    asked = []

    def connect(address: str, subprotocols: list[str], **options: Any) -> list[bytes]:
        asked.append((address, subprotocols))
        return [b"abc", b"defgh"]

    modules = {
        "viser": SimpleNamespace(__version__="1.2.3"), "websockets.sync.client": SimpleNamespace(connect=connect),
        "websockets": SimpleNamespace(Subprotocol=str),
    }  # fmt: skip
    monkeypatch.setattr(page_rate, "importlib", SimpleNamespace(import_module=modules.__getitem__))
    client = Client(8123)
    client._thread.join(10)
    assert client.bytes == 8
    assert asked == [("ws://127.0.0.1:8123", ["viser-v1.2.3"])]


def test_without_viser_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    def missing(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr(page_rate, "importlib", SimpleNamespace(**{**vars(importlib), "import_module": missing}))
    with pytest.raises(InputError, match="pip install 'viser>="):
        Client(8123)


def test_a_free_port_can_be_taken():
    port = free_port()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        assert taken.getsockname() == ("127.0.0.1", port)
    assert port > 0
