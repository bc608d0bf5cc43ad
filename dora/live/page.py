"""The web page of a session, served by viser: its scene, its controls and its plots, kept up to date by a thread."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from dora.affordance.views.server import address, legend_html, start_server
from dora.live.panel import Panel
from dora.live.plots import Plots
from dora.live.scene_view import LENGTH, ON_HAND, ON_OBJECT, SceneView
from dora.live.session import Session
from dora.live.status import status

UPDATES = 30.0
"""Updates that are sent in a second while something moves [Hz]; each shows the poses after another physics step."""
WORDS, CURVES = 0.1, 0.25
"""Time between updates of words and widgets, and of plots [s]."""
NEARER = 0.75
"""Distance of the first view from its target, as a share of that of films [1]."""
WIDTH = 340
"""Width of the panel with words and plots [pixels]."""
PATIENCE = 5.0
"""Longest wait for the thread to end [s]."""


class Page:
    """A running page of a session.

    Args:
        session: what is shown; it is started and stopped by others.
        port: of the page; a port in use is refused.
        host: address to listen on; with the default the page is reachable from this machine only.

    Attributes:
        server: viser's server.
        sent: updates that were sent so far.

    Raises:
        InputError: viser is not installed, or the port is in use.
    """

    def __init__(self, session: Session, port: int = 8080, host: str = "127.0.0.1"):
        self.session, self.sent = session, 0
        state = session.state
        self.server = start_server(host, port, f"Dora: {state.setup.env_id}")
        eye, target = (np.array(point) for point in state.setup.camera)
        camera = self.server.initial_camera
        camera.position, camera.look_at = target + NEARER * (eye - target), target
        self.view = SceneView(self.server.scene, state.setup)
        gui = self.server.gui
        self.panel = Panel(gui, state, list(session.players), session.order)
        self._add_switches(gui)
        side = gui.add_panel()
        self._side = side.add_tab("Episode")
        with self._side:
            self.text = gui.add_html(status(state))
        self._plot(state.setup)
        gui.main_panel.dock_right()
        side.dock_left()
        side.set_width(WIDTH)
        self._shown, self._words_due, self._curves_due = (-1, 0), 0.0, 0.0
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self.error: BaseException | None = None
        self.update()

    def _add_switches(self, gui: Any) -> None:
        with gui.add_folder("Shown"):
            self.maps = gui.add_checkbox("affordance map", True)
            self.ghosts = gui.add_checkbox("ghost of the candidate", True)
            self.forces = gui.add_checkbox("contact forces", True)
            gui.add_html(
                legend_html(
                    f"{100 * LENGTH:g} cm for each newton", {"on the hand": ON_HAND, "on the object": ON_OBJECT}
                )
            )
        for box in (self.maps, self.ghosts, self.forces):
            box.on_update(lambda _: self._switch())

    def _switch(self) -> None:
        self.view.show(maps=self.maps.value, ghosts=self.ghosts.value, forces=self.forces.value)

    def _plot(self, setup: Any) -> None:
        with self._side:
            self.plots = Plots(self.server.gui, setup)
        self._setup = setup

    @property
    def url(self) -> str:
        """Address of the page."""
        return address(self.server)

    def update(self) -> bool:
        """Shows the newest state, on the way to it its physics steps, unless that is shown already; whether it was."""
        state, now = self.session.state, time.monotonic()
        index, poses = state.poses_at(self.session.clock())
        if (state.count, index) == self._shown:
            return False
        with self.server.atomic():
            self.view.update(state, poses)
        if state.setup is not self._setup:
            self.plots.remove()
            self._plot(state.setup)
        fresh = state.episode.step == 0 or state.episode.over or not state.running
        if fresh or now >= self._words_due:
            self.text.content = status(state)
            self.panel.update(state)
            self._words_due = now + WORDS
        if fresh or now >= self._curves_due:
            self.plots.update(state.episode)
            self._curves_due = now + CURVES
        self._shown, self.sent = (state.count, index), self.sent + 1
        return True

    def start(self) -> None:
        """Begin to keep the page up to date."""
        self._thread = threading.Thread(target=self._work, name="page", daemon=True)
        self._thread.start()

    def _work(self) -> None:
        due = time.monotonic()
        try:
            while not self._ending.wait(max(due - time.monotonic(), 0.0)):
                self.update()
                due = max(due + 1 / UPDATES, time.monotonic() - 1 / UPDATES)
        except BaseException as error:
            self.error = error

    def stop(self) -> None:
        """End the thread and the server."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(PATIENCE)
        self.server.stop()
