"""How often a live page sends a state to one client, and how fast its session runs meanwhile."""

import contextlib
import importlib
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

from dora.errors import InputError, shown
from dora.live.page import Page
from dora.live.players import Player
from dora.live.session import Session

SHORTEST, LONGEST = 0.1, 86_400.0
"""Range of the length of a measurement [s]."""
OPENING = 30.0
"""Longest time until the client is connected, and until its first message [s]."""
LOOK = 0.01
"""Time between looks at the session [s]."""


@dataclass(frozen=True)
class PageRate:
    """Result of `measure`: states sent per second with the rests between episodes, and while an episode runs.

    ``kilobytes_per_second`` is what the client got; ``real_time`` how many seconds of an episode passed in a second
    while it ran; ``running_share`` the share of the time in which an episode ran.
    """

    env: str
    seconds: float
    states_per_second: float
    states_per_second_running: float
    running_share: float
    real_time: float
    kilobytes_per_second: float


class Client:
    """A browser's place: a websocket that takes all messages of a page, in a thread of its own.

    Args:
        port: of the page, on this machine.

    Attributes:
        bytes: what has come so far.

    Raises:
        InputError: viser is not installed, with which the library of websockets comes.
    """

    def __init__(self, port: int):
        try:
            viser, websockets = (importlib.import_module(name) for name in ("viser", "websockets.sync.client"))
        except ImportError as error:
            raise InputError("The page needs viser, which is not installed: pip install 'viser>=1.1'.") from error
        protocol = importlib.import_module("websockets").Subprotocol(f"viser-v{viser.__version__}")
        self.bytes = 0
        self._socket = websockets.connect(
            f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, open_timeout=OPENING
        )
        self._thread = threading.Thread(target=self._take, name="client", daemon=True)
        self._thread.start()

    def _take(self) -> None:
        with contextlib.suppress(Exception):  # the page ends
            for message in self._socket:
                self.bytes += len(message)

    def close(self) -> None:
        """End the connection."""
        self._socket.close()


def measure(env_id: str, players: Sequence[Player], seconds: float, preset: str = "standard") -> PageRate:
    """Serve a page to one client for some seconds, from its first message on.

    Args:
        env_id: id of the task.
        players: who may act; the first one does.
        seconds: length of the measurement [s].
        preset: how much episodes are randomised.

    Raises:
        InputError: a number is out of range, or viser is not installed.
        RuntimeError: session or page broke down.
    """
    if not SHORTEST <= seconds <= LONGEST:
        raise InputError(f"--seconds is {shown(seconds)} and has to be from {SHORTEST:g} to {LONGEST:g}.")
    with contextlib.ExitStack() as ending:
        session = Session(env_id, players, preset=preset)
        ending.callback(session.stop)
        page = Page(session, port := free_port())
        ending.callback(page.stop)
        client = Client(port)
        ending.callback(client.close)
        session.start()
        page.start()
        _wait(client)
        return _measured(session, page, client, seconds)


def free_port() -> int:
    """A TCP port of this machine that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _wait(client: Client) -> None:
    end = time.monotonic() + OPENING
    while client.bytes == 0:
        if time.monotonic() > end:
            raise RuntimeError(f"the page has sent nothing for {OPENING:g} s")
        time.sleep(LOOK)


def _measured(session: Session, page: Page, client: Client, seconds: float) -> PageRate:
    begun = last = time.monotonic()
    first, got = page.sent, client.bytes
    running = shown = passed = 0.0
    sent, state = first, session.state
    while last < begun + seconds:
        time.sleep(LOOK)
        now, new = time.monotonic(), session.state
        if (error := session.error or page.error) is not None:
            raise RuntimeError(f"the page has ended: {error}") from error
        if not state.episode.over:
            running, shown = running + now - last, shown + page.sent - sent
            if new.episode.seed == state.episode.seed:
                passed += new.episode.time - state.episode.time
        last, sent, state = now, page.sent, new
    whole = last - begun
    return PageRate(
        env=state.setup.env_id, seconds=whole, states_per_second=(sent - first) / whole,
        states_per_second_running=shown / max(running, LOOK), running_share=running / whole,
        real_time=passed / max(running, LOOK), kilobytes_per_second=(client.bytes - got) / whole / 1000,
    )  # fmt: skip
