"""When a live page shows what, without a browser: words and curves by their times, poses at once, plots, the scene."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from invented_live import DT, SETUP, CountingTask, Gui, Scene, Server, episode, poses, state
from live import Clock

from dora.live.orders import Order, Push, Repeat, Run
from dora.live.page import NEARER, UPDATES, Page
from dora.live.players import Player
from dora.live.plots import Plots
from dora.live.scene_view import HIDDEN, SceneView
from dora.live.session import Session


class View:
    """In place of a scene: keeps what it is to show."""

    def __init__(self, scene: Any, setup: Any):
        self.x, self.shown = list[float](), dict[str, bool]()

    def update(self, state: Any, poses: Any) -> None:
        self.x.append(poses.objects["cube"][0])

    def show(self, **switches: bool) -> None:
        self.shown = switches


class Shown:
    """A page of a session whose task counts; both have clocks that stand still."""

    def __init__(self) -> None:
        self.clock, self.server = Clock(), Server()
        self.session = Session("Invented-v1", [Player("one")], clock=Clock())
        self.time: Any = self.session.clock
        self.task: Any = self.session._task
        self.page: Any = Page(self.session)

    def at(self, now: float, *orders: Order) -> bool:
        """Whether something new is shown at a time, after some orders."""
        for order in orders:
            self.session.order(order)
        self.session._obey(0.0)
        self.clock.now = now
        return self.page.update()

    def step(self) -> None:
        self.time.now = max(self.time.now, self.session._due)
        assert self.session.turn()

    @property
    def told(self) -> float:
        """The time that is told in words [s]."""
        return float(self.page.text.content.split(" s of ")[0].split(">")[-1])

    @property
    def drawn(self) -> int:
        """Points of the curves."""
        return len(self.page.plots.terms.data[0])


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Shown:
    monkeypatch.setattr("dora.live.session.LiveTask", CountingTask)
    monkeypatch.setattr("dora.live.page.SceneView", View)
    monkeypatch.setattr("dora.live.page.start_server", lambda host, port, label: found.server)
    monkeypatch.setattr("dora.live.page.time", SimpleNamespace(monotonic=lambda: found.clock()))
    found = object.__new__(Shown)
    found.__init__()
    return found


def test_the_first_view_is_nearer_than_that_of_films(shown: Shown):
    camera = shown.server.initial_camera
    assert camera.look_at.tolist() == [0.0, 0.0, 1.0]
    assert camera.position.tolist() == [4 * NEARER, 0.0, 1 + NEARER]
    assert shown.page.url == "http://127.0.0.1:8080"


def test_words_and_curves_come_seldom_while_time_goes_on(shown: Shown):
    assert (shown.page.sent, shown.told) == (1, 0.0)
    assert not shown.at(0.01)
    shown.step()
    assert shown.at(0.05)
    assert (shown.told, shown.drawn) == (0.0, 2)
    assert shown.at(0.1, Repeat(True))
    assert shown.told == 0.06
    shown.step()
    assert shown.at(0.19)
    assert shown.told == 0.06
    shown.step()
    assert shown.at(0.25)
    assert (shown.told, shown.drawn) == (0.19, 3)
    assert shown.page.sent == 5


@pytest.mark.parametrize(("steps", "order"), [(3, Run(False)), (4, Repeat(True)), (1, Push(0.0, 0.0))])
def test_words_and_curves_come_at_once_when_time_stands_or_the_episode_is_over(shown: Shown, steps: int, order: Order):
    for _ in range(steps):
        shown.step()
    assert shown.at(0.01, order)
    assert (shown.told, shown.drawn) == ((0.0, 2) if steps == 1 else (round(steps * DT, 2), steps))


def test_each_physics_step_is_shown_at_its_time(shown: Shown):
    shown.step()
    assert shown.at(0.01)
    assert not shown.at(0.02)
    shown.time.now += 0.5 * DT
    assert shown.at(0.03)
    assert shown.page.view.x == [0.0, 0.5, 1.0]


def test_plots_are_made_anew_for_other_terms(shown: Shown):
    first = shown.page.plots
    shown.step()
    shown.at(0.01)
    assert shown.page.plots is first
    shown.task.setup = replace(SETUP, terms=("near",))
    shown.at(0.02, Run(False))
    assert first.terms.removed
    assert [line["label"] for line in shown.page.plots.terms.series] == ["time [s]", "near"]
    assert shown.at(0.03, Run(True))
    assert not shown.page.plots.terms.removed


@pytest.mark.parametrize("off", ["affordance map", "ghost of the candidate", "contact forces"])
def test_each_switch_hides_one_thing(shown: Shown, off: str):
    names = {"affordance map": "maps", "ghost of the candidate": "ghosts", "contact forces": "forces"}
    found = shown.server.gui.found
    assert all(found[word].value for word in names)
    found[off].use(False)
    assert shown.page.view.shown == {name: word != off for word, name in names.items()}


class Waits:
    """In place of an event: the times that are waited for, which pass at once; the third one takes 10 s more."""

    def __init__(self, clock: Clock):
        self.clock, self.times, self.is_set = clock, list[float](), False

    def wait(self, seconds: float) -> bool:
        self.times.append(seconds)
        self.clock.now += seconds + 10.0 * (len(self.times) == 3)
        return len(self.times) == 6

    def set(self) -> None:
        self.is_set = True


def test_updates_come_at_their_rate_without_a_burst_after_a_pause(shown: Shown):
    waits = Waits(shown.clock)
    shown.page._ending = waits
    shown.page.start()
    shown.page.stop()
    assert waits.times == pytest.approx([0.0, 1 / UPDATES, 1 / UPDATES, 0.0, 0.0, 1 / UPDATES])
    assert waits.is_set
    assert shown.server.stopped
    assert shown.page.error is None


def test_what_ends_the_thread_of_a_page_is_kept(shown: Shown, monkeypatch: pytest.MonkeyPatch):
    def broken() -> bool:
        raise ZeroDivisionError("broken")

    monkeypatch.setattr(shown.page, "update", broken)
    shown.page.start()
    shown.page._thread.join(10)
    assert not shown.page._thread.is_alive()
    assert isinstance(shown.page.error, ZeroDivisionError)


@pytest.mark.parametrize(
    ("steps", "time", "terms", "overlap"),
    [
        (0, [0.0, DT], [[0.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]),
        (1, [0.0, DT], [[0.0, 0.0], [0.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]),
        (2, [DT, 2 * DT], [[1.0, 2.0], [10.0, 20.0]], [[0.5, 1.0], [1.0, 2.0]]),
    ],
)
def test_curves_are_those_of_the_episode_from_its_second_step_on(steps: int, time: Any, terms: Any, overlap: Any):
    gui = Gui()
    plots = Plots(gui, SETUP)
    plots.update(episode(steps))
    assert [column.tolist() for column in plots.terms.data] == [time, *terms]
    assert [column.tolist() for column in plots.overlap.data] == [time, *overlap, [5.0, 5.0]]
    plots.remove()
    assert all(plot.removed for plot in gui.plots)


def test_plots_begin_empty_with_a_line_for_each_name():
    gui, names = Gui(), tuple(f"term {k}" for k in range(12))
    Plots(gui, replace(SETUP, terms=names))
    overlap, terms = gui.plots
    assert [line["label"] for line in overlap.series] == ["time [s]", "now", "largest so far", "limit"]
    assert [line["label"] for line in terms.series] == ["time [s]", *names]
    assert terms.series[1]["stroke"] == terms.series[11]["stroke"] != terms.series[2]["stroke"]
    assert not any(line["points"]["show"] for line in terms.series[1:])
    assert [column.tolist() for column in terms.data] == [[0.0, 1.0]] + [[0.0, 0.0]] * 12
    assert (terms.scales, terms.legend) == ({"x": {"time": False}}, {"show": True})


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The scene of a cube, which is at 0.3 m and has twice its size."""
    scene = Scene()
    view = SceneView(scene, replace(SETUP, objects=("cube",)))
    view.show(maps=False, ghosts=True, forces=False)
    view.update(state(scales={"cube": 2.0}), replace(poses(0.3), links={("arm", "none"): np.zeros(7)}))
    return scene


def test_an_object_without_its_map_is_grey_and_both_have_its_size(scene: Scene):
    plain, map = (scene.found[f"/objects/cube/{name}"] for name in ("plain", "map"))
    assert (plain.visible, map.visible) == (True, False)
    assert (plain.scale, map.scale) == (2.0, 2.0)
    assert not scene.found["/objects/cube"].show_axes
    assert len(np.unique(plain.mesh.visual.vertex_colors, axis=0)) == 1


def test_bodies_are_moved_and_no_force_is_an_arrow_below_the_floor(scene: Scene):
    frame, arrows = scene.found["/objects/cube"], scene.found["/forces"]
    assert (frame.position.tolist(), frame.wxyz.tolist()) == ([0.3, 0, 0], [1, 0, 0, 0])
    np.testing.assert_array_equal(arrows.points, HIDDEN)
    assert not arrows.visible
    assert HIDDEN[..., 2].max() < -1


def test_the_map_is_shown_at_first():
    scene = Scene()
    SceneView(scene, replace(SETUP, objects=("cube",)))
    assert scene.found["/objects/cube/map"].visible
    assert not scene.found["/objects/cube/plain"].visible
