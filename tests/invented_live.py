"""Parts of a live page without simulator and browser: a setup, a task that only counts, widgets that keep values."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from dora.errors import InputError
from dora.live.live_task import Beginning
from dora.live.state import Episode, Forces, History, LiveState, Poses, Setup
from dora.tasks.env.starts import StartNumber

DT = 1 / 16
"""Duration of a control step [s]."""
LAST = 4
"""Control steps of an episode."""
SETUP = Setup(
    env_id="Invented-v1", robots={}, handles={}, objects=(), fixtures={}, ladders=(("reach", "lift"),),
    terms=("near", "high"), limit=5.0, dt=DT, max_steps=LAST, camera=((4.0, 0.0, 2.0), (0.0, 0.0, 1.0)),
    numbers=(StartNumber("x", "m", -1.0, 3.0), StartNumber("turn", "rad", 0.0, 0.5)),
    candidates=("0: handle", "1: body", "2: rim"),
)  # fmt: skip
"""What stays the same in an invented environment."""
NO_FORCES = Forces(pairs=(), points=np.zeros((0, 3), np.float32), forces=np.zeros((0, 3), np.float32))
"""Nothing touches anything."""


def poses(x: float = 0.0) -> Poses:
    """Where the only object is; nothing else is there."""
    return Poses(links={}, objects={"cube": np.array([x, 0, 0, 1, 0, 0, 0.0])}, fixtures={})


def history(steps: int) -> History:
    """Terms k and 10 k, overlap k / 2 and k in step k."""
    k = np.arange(1.0, steps + 1)
    return History(time=k * DT, terms=np.stack([k, 10 * k], 1), overlap=np.stack([k / 2, k], 1))


def episode(step: int = 0, **changes: Any) -> Episode:
    """An episode after some steps."""
    found = Episode(
        seed=0, step=step, time=step * DT, stages=(0,), reward=0.0, verdict="under way", success=False, over=False,
        chosen={"arm": 1}, reachable=(0, 2), shares=(0.25, 0.5), history=history(step),
    )  # fmt: skip
    return replace(found, **changes)


def state(step: int = 0, **changes: Any) -> LiveState:
    """A state of a session; what the episode has, too, is changed there."""
    own = {name: changes.pop(name) for name in list(changes) if name in Episode.__dataclass_fields__}
    found = LiveState(
        count=1, at=0.0, passed=(), setup=SETUP, links={}, objects=poses().objects, fixtures={}, scales={"cube": 1.0},
        goals={}, forces=NO_FORCES, episode=episode(step, **own), player="one", preset="standard", candidate=None,
        running=True, speed=1.0, rate=0.5, repeat=True, episodes=3, successes=2, message="",
    )  # fmt: skip
    return replace(found, **changes)


class CountingTask:
    """In place of a `LiveTask`: its steps only count, and after `LAST` of them the episode is a success.

    Attributes:
        begun: beginnings of all episodes so far.
        refused: says of a beginning why it is refused, or nothing.
        broken: what is wrong with the action, if anything.
    """

    def __init__(self, env_id: str, beginning: Beginning):
        self.setup, self.reader, self.passed, self.scales = SETUP, self, (), {"cube": 1.0}
        self.begun: list[Beginning] = []
        self.pushes: list[tuple[float, float]] = []
        self.refused: Callable[[Beginning], str] = lambda beginning: ""
        self.broken, self.closed = "", False
        self.begin(beginning)

    def begin(self, beginning: Beginning) -> None:
        if words := self.refused(beginning):
            raise InputError(words)
        self.beginning, self.count, self.over = beginning, 0, False
        self.begun.append(beginning)

    def step(self) -> None:
        if self.broken:
            raise InputError(self.broken)
        self.count += 1
        self.passed = (poses(self.count - 0.5),)
        self.over = self.count == LAST

    def push(self, x: float, y: float) -> None:
        self.pushes.append((x, y))

    def poses(self) -> dict[str, Any]:
        return vars(poses(self.count))

    def goals(self) -> dict[str, Any]:
        return {}

    def forces(self) -> Forces:
        return NO_FORCES

    def episode(self) -> Episode:
        return episode(self.count, seed=self.beginning.seed, success=self.over, over=self.over)

    def close(self) -> None:
        self.closed = True


class Widget:
    """A part of a page; what it was made with, and what is set, are its attributes."""

    value: Any

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(name)

    def __init__(self, **made: Any):
        self.__dict__.update({"visible": True, "removed": False, **made})
        self._called: list[Callable[[Any], None]] = []

    def on_update(self, call: Callable[[Any], None]) -> None:
        self._called.append(call)

    on_click = on_update

    def use(self, value: Any = None) -> None:
        """A person sets a value, or clicks."""
        if value is not None:
            self.value = value
        for call in self._called:
            call(None)

    def remove(self) -> None:
        self.removed = True

    def __enter__(self) -> "Widget":
        return self

    def __exit__(self, *error: object) -> None:
        pass


class Gui:
    """In place of viser's `server.gui`: makes widgets, and keeps them by what is written on them."""

    def __init__(self) -> None:
        self.found: dict[str, Widget] = {}
        self.plots: list[Widget] = []
        self.main_panel = self.side = Widget(add_tab=self.add_folder, dock_left=lambda: 0, set_width=lambda width: 0,
                                             dock_right=lambda: 0)  # fmt: skip

    def _made(self, label: str, **made: Any) -> Widget:
        self.found[label] = Widget(label=label, **made)
        return self.found[label]

    def add_folder(self, label: str) -> Widget:
        return self._made(label)

    add_button = add_folder

    def add_dropdown(self, label: str, options: Any, initial_value: Any) -> Widget:
        return self._made(label, options=options, value=initial_value)

    def add_slider(self, label: str, min: float, max: float, step: float, initial_value: float) -> Widget:
        return self._made(label, low=min, high=max, step=step, value=initial_value)

    def add_checkbox(self, label: str, initial_value: bool) -> Widget:
        return self._made(label, value=initial_value)

    def add_number(self, label: str, initial_value: float, **limits: Any) -> Widget:
        return self._made(label, value=initial_value, **limits)

    def add_html(self, content: str) -> Widget:
        return Widget(content=content)

    def add_panel(self) -> Widget:
        return self.side

    def add_uplot(self, data: Any, series: Any, **made: Any) -> Widget:
        self.plots.append(Widget(data=data, series=series, **made))
        return self.plots[-1]


class Scene:
    """In place of viser's `server.scene`: what was added, by its name."""

    def __init__(self) -> None:
        self.found: dict[str, Widget] = {}

    def add_mesh_trimesh(self, name: str, mesh: Any, **made: Any) -> Widget:
        self.found[name] = Widget(mesh=mesh, scale=1.0, **made)
        return self.found[name]

    def add_frame(self, name: str, **made: Any) -> Widget:
        self.found[name] = Widget(**made)
        return self.found[name]

    def add_arrows(self, name: str, points: Any, colors: Any, **made: Any) -> Widget:
        self.found[name] = Widget(points=points, colors=colors, **made)
        return self.found[name]


class Server:
    """In place of a server of viser."""

    def __init__(self) -> None:
        self.gui, self.scene, self.initial_camera, self.stopped = Gui(), Scene(), Widget(), False

    @contextmanager
    def atomic(self) -> Iterator[None]:
        yield

    def get_host(self) -> str:
        return "127.0.0.1"

    def get_port(self) -> int:
        return 8080

    def stop(self) -> None:
        self.stopped = True
