"""The page shows the grasps that pass its filters, in a browser if there is one here, else over its websocket."""

import socket
import sys
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from browser import find_browser, open_page, until
from commands import call, load_command
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from dora.affordance import viewing
from dora.affordance.album import chosen
from dora.affordance.candidates import GraspCandidates
from dora.affordance.hand import HandModel
from dora.affordance.hand_mesh import HandMesh
from dora.affordance.objects import load_object
from dora.affordance.palette import PALETTE
from dora.affordance.pictures import PARTS
from dora.affordance.shipped import shipped_path
from dora.affordance.viewing import CONTACTS, VALID, Filter, GraspPage, Surface, describe
from dora.errors import InputError
from dora.robot import load_robot
from dora.robot.rotations import matrix_from_quaternion

COUNT = 12


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def candidates() -> GraspCandidates:
    """Shipped grasps with invented verdicts: every third is not valid, two classes, energies 0 .. 11."""
    shipped = GraspCandidates.load(shipped_path("cube"), robot=load_robot("diana7_hit")).select(slice(COUNT))
    return replace(
        shipped,
        grasp_class=("BodyGrasp", "RimGrasp") * (COUNT // 2),
        valid=torch.arange(COUNT) % 3 != 2,
        energy={"closure": torch.arange(COUNT).float()},
        score=torch.linspace(1, 0, COUNT),
    )


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
    assert Filter(frozenset({"BodyGrasp"}), VALID, "closure", 0.5).rows(candidates).tolist() == [0, 4]


def test_description(candidates: GraspCandidates):
    text = describe(candidates, 2)
    assert "**BodyGrasp** (candidate 2)" in text
    assert "not valid" in text
    assert "succeeded in 82 %" in text
    assert "closure: 2" in text


def test_surface_colours(candidates: GraspCandidates):
    obj = load_object("jug")
    surface = Surface(obj)
    edges = surface.mesh.edges_unique_length
    assert edges.max() <= viewing.EDGE
    colours = surface.regions()
    for index, label in enumerate(obj.labels):
        here = (colours[:, :3] == PALETTE[index]).all(1)
        area = surface.mesh.area_faces[here].sum()
        assert area == pytest.approx(obj.region(label).area, rel=1e-6)
    hand = HandModel(load_robot("diana7_hit"))
    cube = Surface(load_object("cube"))
    painted = cube.contacts(candidates, 0, hand)[:, :3]
    touching = {f for f in candidates.contact_finger[0].tolist() if f > 0}
    seen = {tuple(row) for row in np.unique(painted, axis=0)}
    assert {tuple(PARTS[list(PARTS)[f]]) for f in touching} <= seen


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
    until(lambda: page._painted == page.surface.contacts(candidates, 4, page.model).tobytes())
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
    """The first messages of the page, as far as they are text."""
    import viser

    protocol = f"viser-v{viser.__version__}"
    with connect(url.replace("http", "ws"), subprotocols=[Subprotocol(protocol)], max_size=None) as connection:
        text = ""
        while "(candidate 0)" not in text or "no contact" not in text:
            message = connection.recv(30)
            text += message.decode(errors="ignore") if isinstance(message, bytes) else message
        return text


def test_a_busy_port_is_refused(page: GraspPage):
    port = page.server.get_port()
    with pytest.raises(InputError, match=f"Port {port} is in use"):
        viewing.start_server("127.0.0.1", port, "second")


def test_without_viser(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'dora\[view\]'"):
        viewing.start_server("127.0.0.1", 8080, "none")


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
        "spoon": "neither an object",
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


def test_pictures_instead_of_the_page(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    """Four grasps: every class is among them, and each part of the hand that touches has its colour."""
    folder = tmp_path / "new" / "pictures"
    assert call(script, monkeypatch, "jug", "--pictures", str(folder)) == 0
    paths = [folder / f"jug-{what}.png" for what in ("map", "grasps", "contacts")]
    assert capsys.readouterr().out.split() == [str(path) for path in paths]
    touched, untouched = (imageio.imread(path)[..., :3].reshape(-1, 3) for path in (paths[2], paths[0]))
    for part in ("palm", "thumb", "middle"):
        near = np.abs(touched.astype(int) - np.array(PARTS[part])).max(1) < 40
        assert near.sum() > 300, part
    assert len(np.unique(untouched, axis=0)) > 100
    (tmp_path / "file").write_text("")
    assert call(script, monkeypatch, "jug", "--pictures", str(tmp_path / "file" / "x")) == 2
    assert "choose another one" in capsys.readouterr().err


def test_every_class_is_pictured(candidates: GraspCandidates):
    names = ("BodyGrasp",) * 6 + ("RimGrasp",) * 5 + ("LidGrasp",)
    several = replace(candidates, grasp_class=names, valid=torch.arange(COUNT) != 0)
    assert chosen(several) == [1, 2, 6, 11]
    assert chosen(replace(several, valid=torch.zeros(COUNT, dtype=torch.bool))) == [0, 1, 6, 11]
