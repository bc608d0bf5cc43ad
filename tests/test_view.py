"""The page shows the grasps that pass its filters, in a browser if there is one here, else over its websocket."""

import contextlib
import sys
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from browser import PATIENCE, find_browser, open_page, until
from commands import call, load_command
from invented_grasps import COUNT, judged_grasps
from live import free_port
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand.hand_mesh import HandMesh
from dora.affordance.hand.hand_model import HandModel
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.palette import PALETTE
from dora.affordance.views import page as viewing
from dora.affordance.views.page import CONTACTS, VALID, Filter, GraspPage, describe
from dora.affordance.views.pictures import PARTS
from dora.affordance.views.server import start_server
from dora.affordance.views.surface import EDGE, Surface
from dora.errors import InputError
from dora.geometry.rotations import matrix_from_quaternion
from dora.robot import load_robot

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of data compressed by zstd."""


@pytest.fixture(scope="module")
def candidates() -> GraspCandidates:
    return judged_grasps()


@pytest.fixture(scope="module")
def page(candidates: GraspCandidates) -> Iterator[GraspPage]:
    page = GraspPage(load_object("cube"), candidates, load_robot("diana7_hit"), free_port())
    yield page
    page.server.stop()


def test_filters(candidates: GraspCandidates):
    both = frozenset({"BodyGrasp", "RimGrasp"})
    assert Filter(both).rows(candidates).tolist() == list(range(COUNT))
    assert Filter(frozenset({"RimGrasp"})).rows(candidates).tolist() == [1, 3, 5, 7, 9, 11]
    assert Filter(both, VALID).rows(candidates).tolist() == [0, 1, 3, 4, 6, 7, 9, 10]
    assert Filter(both, viewing.INVALID).rows(candidates).tolist() == [2, 5, 8, 11]
    assert Filter(both, term="closure", share=0.25).rows(candidates).tolist() == [0, 1, 2]
    assert Filter(frozenset()).rows(candidates).tolist() == []
    lacking = candidates.energy["closure"].clone()
    lacking[:6] = torch.nan
    some = replace(candidates, energy={"closure": lacking})
    assert len(Filter(both, term="closure").rows(some)) == COUNT
    assert Filter(both, term="closure", share=0.5).rows(some).tolist() == [6, 7, 8]
    assert Filter(frozenset({"BodyGrasp"}), VALID, "closure", 0.5).rows(candidates).tolist() == [0, 4]


def test_description(candidates: GraspCandidates):
    text = describe(candidates, 2)
    assert "**BodyGrasp** (candidate 2)" in text
    assert "not valid" in text
    assert "succeeded in 82 %" in text
    assert "closure: 2" in text
    points = torch.bincount(candidates.contact_map[2].long(), minlength=len(PARTS))[1:].tolist()
    shown = ", ".join(f"{part} {count}" for part, count in zip(list(PARTS)[1:], points, strict=True) if count)
    assert f"contact map: {shown}" in text
    none = replace(candidates, contact_map=torch.zeros(COUNT, 0, dtype=torch.uint8))
    assert "contact map: none" in describe(none, 2)


def test_the_page_makes_maps_that_candidates_lack(page: GraspPage, candidates: GraspCandidates):
    """As `page`, but of a file without maps; the text has what the map votes for."""
    plain = replace(candidates, contact_map=torch.zeros(COUNT, 0, dtype=torch.uint8))
    other = GraspPage(load_object("cube"), plain, load_robot("diana7_hit"), free_port())
    try:
        assert other.candidates is not None
        assert torch.equal(other.candidates.contact_map, candidates.contact_map)
        assert other.text.content.endswith("the map votes for body")
    finally:
        other.server.stop()


def test_surface_colours(candidates: GraspCandidates):
    obj = load_object("jug")
    surface = Surface(obj)
    edges = surface.mesh.edges_unique_length
    assert edges.max() <= EDGE
    colours = surface.regions()
    for index, label in enumerate(obj.labels):
        here = (colours[:, :3] == PALETTE[index]).all(1)
        area = surface.mesh.area_faces[here].sum()
        assert area == pytest.approx(obj.region(label).area, rel=1e-6)
    cube = Surface(load_object("cube"))
    painted = cube.contacts(candidates.contact_map[0])[:, :3]
    touching = candidates.contact_map[0].unique().tolist()
    seen = {tuple(row) for row in np.unique(painted, axis=0)}
    assert {tuple(PARTS[list(PARTS)[f]]) for f in touching} == seen


def test_faces_show_the_points_of_the_map_on_their_side_of_a_wall():
    """The outside of the jug's body touched all over, its inside nowhere; and one point alone."""
    surface = Surface(load_object("jug"))
    axis = surface.map.points[surface.map.labels == 0].mean(0)
    middle = (surface.map.points[:, 2] - axis[2]).abs() < 0.03
    away = (surface.map.normals[:, :2] * (surface.map.points - axis)[:, :2]).sum(1)
    outside = middle & (away > 0) & (surface.map.labels == 0)
    shown = surface.parts((4 * outside).byte())
    centres, normals = surface.mesh.triangles_center - axis.numpy(), surface.mesh.face_normals
    inner = (surface.labels == 0) & (np.abs(centres[:, 2]) < 0.02) & ((normals * centres)[:, :2].sum(1) < 0)
    outer = (surface.labels == 0) & (np.abs(centres[:, 2]) < 0.02) & ((normals * centres)[:, :2].sum(1) > 0)
    assert (shown[inner] == 0).mean() > 0.97
    assert (shown[outer] == 4).mean() > 0.97
    alone = torch.zeros(len(surface.map), dtype=torch.uint8)
    alone[100] = 6
    (spot,) = np.nonzero(surface.parts(alone))
    assert len(spot)
    distance = np.linalg.norm(surface.mesh.triangles_center[spot] - surface.map.points[100].numpy(), axis=1)
    assert distance.max() < 2 * surface.map.spacing


def test_the_hand_is_where_the_model_says(candidates: GraspCandidates):
    """The drawn links agree with the optimiser's kinematics (coupled joints are coupled in `joints`)."""
    robot = load_robot("diana7_hit")
    model, mesh = HandModel(robot, dtype=torch.float64), HandMesh(robot)
    wrist = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    wrist[:, :3, :3] = matrix_from_quaternion(candidates.quaternion.double())
    wrist[:, :3, 3] = candidates.position
    expected = model.forward(wrist, robot.reduce_hand(candidates.joints.double()))
    drawn = mesh.world_poses(candidates.position, candidates.quaternion, candidates.joints)
    assert set(drawn) == set(model.links)
    for body, link in enumerate(model.links):
        torch.testing.assert_close(drawn[link], expected[:, body], rtol=0, atol=1e-6)


def test_widgets_change_the_scene(page: GraspPage, candidates: GraspCandidates):
    assert f"grasp 1 of {COUNT}" in page.text.content
    page.validity.value = VALID
    until(lambda: "grasp 1 of 8" in page.text.content)
    page.chosen.value = 4
    until(lambda: "(candidate 4)" in page.text.content)
    page.count.value = 3
    palms = next(handle for names, handle in page.hands._batches if page.hands.mesh._wrist in names)
    until(lambda: palms.batched_scales.sum() == 3)
    np.testing.assert_allclose(palms.batched_positions[:3], candidates.position[[4, 6, 7]], atol=1e-6)
    page.colouring.value = CONTACTS
    until(lambda: page._painted == page.surface.contacts(candidates.contact_map[4]).tobytes())
    for box in page.classes.values():
        box.value = False
    until(lambda: page.text.content == "No grasp passes the filter.")
    until(lambda: palms.batched_scales.sum() == 0)
    for box in page.classes.values():
        box.value = True
    page.validity.value = viewing.ANY_VALIDITY
    page.chosen.value = 1
    until(lambda: f"grasp 1 of {COUNT}" in page.text.content)


def test_the_page_arrives(page: GraspPage, tmp_path: Path):
    with urllib.request.urlopen(page.url) as answer:
        assert "<html" in answer.read().decode()
    browser = find_browser()
    if browser is None:
        text = websocket_text(page.url)
    else:
        with open_page(browser, page.url, tmp_path / "profile") as tab:
            tab.wait_for("(candidate 0)")
            text = tab.text()
            assert until(lambda: tab.evaluate("document.querySelectorAll('canvas').length")) >= 1
    for words in ("Dora: cube", "BodyGrasp", "RimGrasp", "validity", "(candidate 0)", "no contact"):
        assert words in text


def websocket_text(url: str) -> str:
    """What the page sends first, as far as it is text; it is asked anew until the words of a grasp are there."""
    import viser

    protocol, end = Subprotocol(f"viser-v{viser.__version__}"), time.monotonic() + PATIENCE
    while time.monotonic() < end:
        text = ""
        with (
            connect(url.replace("http", "ws"), subprotocols=[protocol], max_size=None, open_timeout=PATIENCE) as page,
            contextlib.suppress(TimeoutError),
        ):
            while "(candidate 0)" not in text or "no contact" not in text:
                message = page.recv(PATIENCE / 9)
                text += unpacked(message).decode(errors="ignore") if isinstance(message, bytes) else message
            return text
    raise AssertionError("the page sent no grasp")


def unpacked(message: bytes) -> bytes:
    """A message with all that is compressed in it: viser packs its text by zstd since version 1."""
    start = message.find(ZSTD_MAGIC)
    if start < 0:
        return message
    zstandard = pytest.importorskip("zstandard", reason="viser sends compressed messages and there is no zstandard")
    reader = zstandard.ZstdDecompressor().decompressobj()
    return message[:start] + unpacked(reader.decompress(message[start:])) + unpacked(reader.unused_data)


def test_messages_are_unpacked_with_every_part_that_is_compressed():
    zstandard = pytest.importorskip("zstandard", reason="viser sends compressed messages only if there is zstandard")
    first, second = (zstandard.ZstdCompressor().compress(word) for word in (b"palm", b"thumb"))
    assert unpacked(b"head " + first + b" and " + second + b" end") == b"head palm and thumb end"
    assert unpacked(b"nothing") == b"nothing"


def test_a_busy_port_is_refused(page: GraspPage):
    port = page.server.get_port()
    with pytest.raises(InputError, match=f"Port {port} is in use"):
        start_server("127.0.0.1", port, "second")


def test_without_viser(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'viser>=1.1'"):
        start_server("127.0.0.1", 8080, "none")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_command("view")


def test_bad_sources(
    script: ModuleType,
    candidates: GraspCandidates,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
):
    replace(candidates, object="mug").save(tmp_path / "mug.safetensors")
    replace(candidates, digest="0").save(tmp_path / "old.safetensors")
    (tmp_path / "broken.safetensors").write_bytes(b"nothing")
    cases = {
        "spoon": "no object 'spoon', nor a folder or mesh at that path: choose one of cube, hammer, jug, microwave",
        "mug.safetensors": "--mesh",
        "old.safetensors": "another shape or labelling",
        "broken.safetensors": "damaged",
    }
    for source, words in cases.items():
        path = tmp_path / source
        assert call(script, monkeypatch, str(path) if path.exists() else source) == 2
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1


def test_the_page_ends_with_ctrl_c_which_the_command_reports(monkeypatch: pytest.MonkeyPatch):
    view, stopped = load_command("view"), []

    class Shown:
        url = "http://127.0.0.1:8080"
        server = SimpleNamespace(stop=lambda: stopped.append(True))

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(view, "GraspPage", lambda *_: Shown())
    waiting = SimpleNamespace(Event=lambda: SimpleNamespace(wait=interrupted))
    monkeypatch.setattr(view, "threading", waiting)
    with pytest.raises(KeyboardInterrupt):
        call(view, monkeypatch, "cube")
    assert stopped == [True]
