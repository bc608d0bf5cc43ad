"""The live page shows what its session says and passes on what a person asks; with a browser, if there is one here."""

import contextlib
import io
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import trimesh
from browser import find_browser, open_page, until
from commands import call, load_command
from live import Watched, free_port
from pictures import drawn

pytest.importorskip("viser", reason="the page needs viser: pip install 'viser>=1.1'")

from dora.affordance.objects.catalogue import load_object
from dora.errors import InputError
from dora.live.orders import Choose, Randomise, Reset, Run, Start
from dora.live.page import UPDATES, Page
from dora.live.panel import NEAREST
from dora.live.players import zero_correction
from dora.live.scene_view import HIDDEN, LENGTH, LONGEST, ON_HAND, ON_OBJECT, SceneView, arrows
from dora.live.session import Session
from dora.live.state import Forces, Poses
from dora.live.status import status

EPISODE = 600.0
"""Longest time of an episode on a busy machine whose browser draws without a GPU [s]."""
SETTLED = 0.3
"""Time after which the widgets' callbacks have been called [s]."""


@pytest.fixture(scope="module")
def watched() -> Iterator[Watched]:
    watched = Watched("DoraHammer-v1", preset="none")
    yield watched
    watched.session.stop()


@pytest.fixture(scope="module")
def shown(watched: Watched) -> Iterator[Page]:
    page = Page(watched.session, free_port())
    yield page
    page.stop()


@pytest.fixture
def page(watched: Watched, shown: Page) -> Page:
    watched.back_to_zero()
    watched.do(Run(False))
    shown.update()
    return shown


def answered(watched: Watched, page: Page) -> None:
    """Waits until the widgets' callbacks, which run in threads of viser, have asked for something; carries it out."""
    until(lambda: not watched.session._orders.empty())
    watched.do()
    page.update()


def _assert_drawn(view: SceneView, poses: Poses) -> None:
    """Each body is drawn at its pose."""
    for key, pose in (
        *((("link", *name), pose) for name, pose in poses.links.items()),
        *((("object", name), pose) for name, pose in poses.objects.items()),
        *((("fixture", name), pose) for name, pose in poses.fixtures.items()),
    ):
        handle = view._bodies[key]
        assert [*handle.position, *handle.wxyz] == pytest.approx(pose.tolist(), abs=1e-6)


def test_everything_is_drawn_where_the_state_says(watched: Watched, page: Page):
    watched.do(Run(True))
    state = watched.steps(60)
    view = page.view
    for poses in (state.passed[0], state):  # the first physics step of the control step, and the last one
        assert page.update()
        assert not page.update()  # nothing new
        _assert_drawn(view, poses)
        watched.clock.now += state.setup.dt
    ghost = view._ghosts["arm"].frame
    assert [*ghost.position, *ghost.wxyz] == pytest.approx(state.goals["arm"].wrist.tolist(), abs=1e-6)
    assert len(state.forces.pairs) >= 2
    np.testing.assert_allclose(view.arrows.points[:, 0], state.forces.points, atol=1e-6)
    assert len(page.plots.terms.data) == 1 + len(state.setup.terms)
    assert len(page.plots.terms.data[0]) == 60
    assert page.plots.overlap.data[2].max() == pytest.approx(state.episode.history.overlap[:, 1].max())
    assert f"{state.episode.time:.2f} s" in page.text.content


def test_an_object_of_another_size_is_drawn_in_its_size(watched: Watched, page: Page):
    state = watched.do(Randomise("standard"))
    page.update()
    assert state.scales["hammer"] != 1.0
    assert page.view._maps["hammer"].scale == state.scales["hammer"]


def test_buttons_give_orders(watched: Watched, page: Page):
    panel: Any = page.panel
    assert panel.pause.label == "Run"
    panel.pause.value = True
    answered(watched, page)
    assert watched.state.running
    assert panel.pause.label == "Pause"
    panel.step.value = True
    answered(watched, page)
    assert watched.steps(5).episode.step == 1
    panel.seed.value = 11
    panel.reset.value = True
    answered(watched, page)
    assert (watched.state.episode.seed, watched.state.episode.step) == (11, 0)
    panel.impulse.value, panel.direction.value = 0.3, 0
    panel.push.value = True
    answered(watched, page)
    watched.do(Run(True))
    watched.steps(1)
    assert watched.env.snapshot.object.v[0, 0] > 0.2


def test_choices_give_orders(watched: Watched, page: Page):
    panel: Any = page.panel
    assert panel.candidate.options == (NEAREST, *watched.state.setup.candidates)
    panel.candidate.value = watched.state.setup.candidates[5]
    answered(watched, page)
    assert watched.state.candidate == 5
    panel.preset.value = "hard"
    answered(watched, page)
    assert watched.state.preset == "hard"
    panel.speed.value = 0.5
    answered(watched, page)
    assert watched.state.speed == 0.5


def test_sliders_move_the_start_and_keep_each_other(watched: Watched, page: Page):
    sliders: Any = page.panel.sliders
    numbers, before = watched.state.setup.numbers, watched.state.episode.shares
    assert [slider.value for slider in sliders.values()] == pytest.approx(
        [n.low + share * (n.high - n.low) for n, share in zip(numbers, before, strict=True)], abs=6e-4
    )
    for count, (k, share) in enumerate(((0, 0.25), (2, 1.0)), 1):  # the second one before the first is answered
        sliders[k].value = numbers[k].low + share * (numbers[k].high - numbers[k].low)
        until(lambda count=count: watched.session._orders.qsize() == count)
    answered(watched, page)
    assert watched.state.episode.shares == pytest.approx((0.25, before[1], 1.0, *before[3:]), abs=1e-6)


def test_widgets_follow_the_session_without_giving_orders(watched: Watched, page: Page):
    panel: Any = page.panel
    state = watched.do(Reset(5), Randomise("hard"), Choose(3), Start((0.5,) * 9))
    page.update()
    assert (panel.seed.value, panel.preset.value) == (5, "hard")
    assert panel.candidate.value == state.setup.candidates[3]
    assert panel.sliders[2].value == pytest.approx(sum((state.setup.numbers[2].low, state.setup.numbers[2].high)) / 2)
    time.sleep(SETTLED)
    assert watched.session._orders.empty()
    watched.do(Reset(6))
    page.update()
    time.sleep(SETTLED)
    assert watched.session._orders.empty()
    assert watched.state.episode.seed == 6


def test_a_refused_choice_is_taken_back_and_explained(watched: Watched, page: Page):
    watched.session.order(Reset(2**31))
    page.panel.seed.value = 2**31 - 1
    watched.do()
    page.update()
    assert "The seed is 2147483648" in page.text.content
    assert page.panel.seed.value == watched.state.episode.seed == 0


def test_switches_hide_parts_of_the_scene(page: Page):
    view: Any = page.view
    page.maps.value = page.ghosts.value = page.forces.value = False
    until(lambda: not (view._maps["hammer"].visible or view._ghosts["arm"].frame.visible or view.arrows.visible))
    assert view._plain["hammer"].visible
    page.maps.value = page.ghosts.value = page.forces.value = True
    until(lambda: view._maps["hammer"].visible and view._ghosts["arm"].frame.visible and view.arrows.visible)


def test_arrows_are_as_long_as_the_forces_are_large():
    forces = Forces(
        pairs=(("arm.thumb", "cube"), ("cube", "world")),
        points=np.zeros((2, 3), np.float32),
        forces=np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 1e4]], np.float32),
    )
    points, colours = arrows(forces, ("cube",))
    assert points[0, 1].tolist() == pytest.approx([LENGTH * 3, 0.0, LENGTH * 4])
    assert points[1, 1].tolist() == pytest.approx([0.0, 0.0, LONGEST])
    assert colours.tolist() == [list(ON_HAND), list(ON_OBJECT)]
    nothing = Forces(pairs=(), points=np.zeros((0, 3), np.float32), forces=np.zeros((0, 3), np.float32))
    assert np.array_equal(arrows(nothing, ("cube",))[0], HIDDEN)


def test_words_of_others_are_escaped(watched: Watched, page: Page):
    state = replace(watched.state, message="<script>alert(1)</script>")
    assert "<script>" not in status(state)
    assert "&lt;script&gt;" in status(state)


def test_the_map_of_the_object_has_a_colour_for_each_region(page: Page):
    def colours(handle: Any) -> int:
        scene = trimesh.load_scene(io.BytesIO(handle.glb_data), "glb")
        return sum(len(np.unique(np.asarray(g.visual.vertex_colors), axis=0)) for g in scene.geometry.values())

    assert colours(page.view._maps["hammer"]) == len(load_object("hammer").labels) > 1
    assert colours(page.view._plain["hammer"]) == 1


def test_a_busy_port_is_refused(watched: Watched, page: Page):
    with pytest.raises(InputError, match=f"Port {page.server.get_port()} is in use"):
        Page(watched.session, page.server.get_port())


# ------------------------------------------------------------------ the command


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("DoraHamer-v1",), "did you mean 'DoraHammer-v1'"),
        (("DoraCube-v1", "--port", "0"), "--port is 0"),
        (("DoraCube-v1", "--seed", "-1"), "--seed is -1"),
        (("DoraCube-v1", "--checkpoint", "none.safetensors"), "There is no checkpoint none.safetensors"),
        (("DoraCube-v1", "--recording", "none.h5"), "There is no trajectory file none.h5"),
        (("DoraCube-v1", "--host", "nowhere.invalid"), "--host is 'nowhere.invalid'"),
    ],
)
def test_bad_options_end_with_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], said: str
):
    assert call(load_command("play"), monkeypatch, *words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


def test_a_film_without_a_driver_is_refused_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    command = load_command("play")
    monkeypatch.setattr(command, "can_render", lambda: False)
    path = tmp_path / "film.mp4"
    assert call(command, monkeypatch, "DoraCube-v1", "--video", str(path)) == 2
    assert capsys.readouterr().err == (
        "No film: SAPIEN finds no Vulkan driver here (docs/rendering.md in the project); the page needs none.\n"
    )
    assert not path.exists()


def test_the_page_ends_with_ctrl_c_which_the_command_reports(monkeypatch: pytest.MonkeyPatch):
    play, ended = load_command("play"), []

    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    @contextlib.contextmanager
    def served(session: Any, port: int, host: str) -> Iterator[Any]:
        try:
            yield SimpleNamespace(url="http://127.0.0.1:8080", error=None)
        finally:
            ended.append(True)

    monkeypatch.setattr(play, "served", served)
    monkeypatch.setattr(play, "time", SimpleNamespace(sleep=interrupted))
    with pytest.raises(KeyboardInterrupt):
        play.serve(Session("DoraCube-v1", [zero_correction({})], preset="none"), 8080, "127.0.0.1")
    assert ended == [True]


@drawn
@pytest.mark.slow
def test_a_film_of_the_policy_is_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    path = tmp_path / "films" / "film.mp4"
    assert call(load_command("play"), monkeypatch, "DoraCube-v1", "--video", str(path)) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(path)
    with imageio.get_reader(path) as reader:
        frames: Any = [np.asarray(frame) for frame in reader]  # pyright: ignore[reportGeneralTypeIssues]
    assert len(frames) > 20
    assert all(frame.std() > 5 for frame in frames)
    assert any((frame != frames[0]).any() for frame in frames)


@pytest.mark.slow
def test_the_rate_of_the_page_is_measured(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    bench = load_command("bench")
    assert call(bench, monkeypatch, "page", "DoraCube-v1", "--zero-correction", "--seconds", "6", "--json") == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["seconds"] == pytest.approx(6, abs=1)
    assert 10 < found["states_per_second_running"] < 1.2 * UPDATES
    assert found["states_per_second"] <= found["states_per_second_running"]
    assert 0.1 < found["real_time"] < 1.2
    assert found["kilobytes_per_second"] > 1


@pytest.mark.slow
def test_the_command_serves_the_page_until_it_is_interrupted():
    port = free_port()
    words = [sys.executable, "-m", "dora", "play", "DoraCube-v1", "--zero-correction", "--port", str(port)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        lines = process.stdout
        assert lines is not None
        address = until(lambda: next((line for line in lines if line.startswith("http")), None))
        assert address.strip() == f"http://127.0.0.1:{port}"
        with socket.create_connection(("127.0.0.1", port)) as client:  # a client that goes away brings no traceback
            client.sendall(b"no request\r\n\r\n")
        time.sleep(0.5)
        process.send_signal(2)
        messages = process.communicate(timeout=60)[1]
        assert messages.splitlines()[-1] == "Interrupted."
        assert "Traceback" not in messages
        assert process.returncode == 130
    finally:
        process.kill()


@pytest.mark.slow
def test_a_browser_presses_buttons_and_sees_an_episode_succeed(tmp_path: Path):
    browser = find_browser()
    if browser is None:
        pytest.skip("no Chromium is installed: apt-get install chromium")
    play = load_command("play")
    players = play.find_players(play.Args(env="DoraCube-v1"))
    session = Session("DoraCube-v1", players, preset="none", running=False)
    with play.served(session, free_port(), "127.0.0.1") as page, open_page(browser, page.url, tmp_path) as tab:
        tab.wait_for("under way")
        assert until(lambda: tab.evaluate("document.querySelectorAll('canvas').length")) >= 1
        tab.press("Step")
        tab.wait_for("0.05 s of 5 s")
        assert session.state.episode.step == 1
        tab.press("Push the object")
        tab.press("Reset")
        tab.wait_for("0.00 s of 5 s")
        tab.press("Run")
        tab.wait_for("success: all stages done", EPISODE)
        assert session.state.episode.success
        assert page.sent > 10
        tab.press("Pause")
        until(lambda: not session.state.running)
        tab.wait_for("stands still")
    assert session.error is None
    assert page.error is None
