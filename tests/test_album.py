"""Pictures of objects, grasps and contact maps: what is drawn, and from where it is seen."""

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import trimesh
from commands import call, load_command
from invented_grasps import COUNT, judged_grasps

from dora.affordance.bundled_sets import bundled_path, load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.contact_maps import mapped
from dora.affordance.hand.link_meshes import joined
from dora.affordance.objects.catalogue import available_objects, load_object
from dora.affordance.objects.palette import PALETTE
from dora.affordance.search.cache import hand_of
from dora.affordance.views import album, pictures
from dora.affordance.views.album import chosen
from dora.affordance.views.pictures import PARTS, TILE, best_view
from dora.affordance.views.rasteriser import Camera, seen
from dora.affordance.views.surface import Surface
from dora.robot import load_robot

SMALL = 160
"""Width and height of the views of pictures that are tested [pixels]."""


@pytest.fixture(scope="module")
def candidates() -> GraspCandidates:
    return judged_grasps()


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_command("view")


def test_pictures_instead_of_the_page(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    """Four grasps: every class is among them, and each part of the hand that touches has its colour.

    Light changes how bright a colour is and not its hue. The thumb touches 1/14 of what the ring finger does, so parts
    are seen the more, the larger a surface they touch; sides that no view shows and edges make that inexact.
    """
    monkeypatch.setattr(pictures, "TILE", SMALL)
    monkeypatch.setattr(pictures, "AZIMUTHS", 3)
    monkeypatch.setattr(album, "FINER", 1.0)
    folder = tmp_path / "new" / "pictures"
    assert call(script, monkeypatch, str(bundled_path("jug", region=False)), "--pictures", str(folder)) == 0
    paths = [folder / f"jug-{what}.png" for what in ("map", "grasps", "contacts")]
    assert capsys.readouterr().out.split() == [str(path) for path in paths]
    views = imageio.imread(paths[2])[: 2 * SMALL, :, :3]  # without the legend
    pixels, faces = _seen_parts(views), _touched_parts()
    assert [part for part in faces if pixels[part]] == [part for part in faces if faces[part]] == list(PARTS)[1:]
    assert np.corrcoef(list(pixels.values()), list(faces.values()))[0, 1] > 0.9
    assert len(np.unique(imageio.imread(paths[0])[..., :3].reshape(-1, 3), axis=0)) > 100
    (tmp_path / "file").write_text("")
    assert call(script, monkeypatch, "jug", "--pictures", str(tmp_path / "file" / "x")) == 2
    assert "choose another one" in capsys.readouterr().err


def _seen_parts(views: np.ndarray) -> dict[str, int]:
    """How many pixels (h, w, 3) have the hue of each part of the hand."""
    hue, counts = views / views.max(-1, keepdims=True).clip(1), {}
    for part, colour in list(PARTS.items())[1:]:
        counts[part] = int((np.abs(hue - np.array(colour) / max(colour)).max(-1) < 0.02).sum())
    return counts


def _touched_parts() -> dict[str, int]:
    """How many faces of the jug each part of the hand touches, over the grasps of an album."""
    candidates, surface = load_candidates("jug", region=False), Surface(load_object("jug"), 1.0)
    shown = mapped(candidates.select(chosen(candidates)), surface.map, hand_of(load_robot("diana7_hit"), "cpu"))
    parts = np.concatenate([surface.parts(each) for each in shown.contact_map])
    return dict(zip(list(PARTS)[1:], np.bincount(parts, minlength=len(PARTS))[1:].tolist(), strict=True))


def test_a_picture_of_all_objects(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    """Without a source: every object, side by side, in the colours of its regions."""
    assert call(script, monkeypatch, "--pictures", str(tmp_path / "new")) == 0
    path = tmp_path / "new" / "objects.png"
    assert capsys.readouterr().out.split() == [str(path)]
    picture = imageio.imread(path)[:TILE, :, :3].astype(float)  # without the legends
    names = available_objects()
    for view, name in zip(np.array_split(picture, len(names), axis=1), names, strict=True):
        hue = view / view.max(-1, keepdims=True).clip(1)
        for index in range(len(PALETTE)):
            wanted = np.array(PALETTE[index]) / max(PALETTE[index])
            many = (np.abs(hue - wanted).max(-1) < 0.02).sum() > 50
            assert many == (index < len(load_object(name).labels)), (name, index)
    assert call(script, monkeypatch) == 2
    assert "for example jug" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert call(script, monkeypatch, "--pictures", str(tmp_path / "file")) == 2
    assert "choose another one" in capsys.readouterr().err


def test_a_grasp_is_seen_from_where_hand_and_held_part_show():
    """A box whose front (+x) is held, and a finger at its side (+y) or a palm there that does not count."""
    box, finger, palm = (trimesh.creation.box(size) for size in ((0.1, 0.1, 0.1), (0.05, 0.02, 0.05), (0.1, 0.02, 0.1)))
    hand = joined([finger.apply_translation((0, 0.06, 0)), palm.apply_translation((0, -0.06, 0))])
    held, fingers = box.face_normals[:, 0] > 0.9, np.arange(len(hand.faces)) < len(finger.faces)
    x, y, z = best_view(box, hand, held, fingers).eye
    assert x > 0
    assert y > 0
    assert z > 0
    x, y, _ = best_view(box, hand, box.face_normals[:, 0] < -0.9, ~fingers).eye
    assert x < 0
    assert y < 0


def test_what_is_behind_is_not_seen():
    near, far = (trimesh.creation.box((0.1, 0.1, 0.1)).apply_translation((x, 0, 0)) for x in (0.2, -0.2))
    found = seen([near, far], Camera((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)), 32, 32)
    assert set(np.unique(found)) <= {*np.flatnonzero(near.face_normals[:, 0] > 0.9), 24}
    assert (found < 12).sum() > 20


def test_every_class_is_pictured(candidates: GraspCandidates):
    names = ("BodyGrasp",) * 6 + ("RimGrasp",) * 5 + ("LidGrasp",)
    several = replace(candidates, grasp_class=names, valid=torch.arange(COUNT) != 0)
    assert {1, 6, 11} < set(chosen(several))
    assert {0, 6, 11} < set(chosen(replace(several, valid=torch.zeros(COUNT, dtype=torch.bool))))


def test_those_farthest_from_each_other_are_pictured_beside_the_best(candidates: GraspCandidates):
    along = torch.tensor([0.0, 0.5, 0.1, 0.9, 0.45, 1.0, *[0.2] * (COUNT - 6)])[:, None] * torch.tensor([0.3, 0.0, 0.0])
    alike = candidates.quaternion[:1].expand(COUNT, 4)
    valid = torch.arange(COUNT) != 5
    line = replace(candidates, position=along, quaternion=alike, valid=valid, grasp_class=("BodyGrasp",) * COUNT)
    assert chosen(line) == [0, 3, 4, 6]
    turned = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(COUNT, 4)
    one_turned = torch.where(torch.arange(COUNT)[:, None] == 4, turned, alike)
    assert chosen(replace(line, quaternion=one_turned)) == [0, 1, 3, 4]
    assert chosen(replace(line, position=torch.zeros(COUNT, 3))) == [0, 1, 2, 3]


def test_a_grasp_that_never_succeeded_is_only_pictured_where_none_did(candidates: GraspCandidates):
    alone = replace(candidates, valid=torch.ones(COUNT, dtype=torch.bool), grasp_class=("BodyGrasp",) * COUNT)
    some = replace(alone, score=torch.where(torch.arange(COUNT) % 3 == 0, 0.5, 0.0))
    assert chosen(some) == [0, 3, 6, 9]
    for scores in (torch.zeros(COUNT), torch.full((COUNT,), torch.nan)):
        assert len(chosen(replace(alone, score=scores))) == 4


def test_maps_and_titles_are_those_of_the_chosen_grasps(
    candidates: GraspCandidates, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    seen = {}
    several = replace(candidates, valid=torch.arange(COUNT) > 4, contact_map=candidates.contact_map.clone())
    monkeypatch.setattr(album, "FINER", 0.5)
    monkeypatch.setattr(album, "picture_grasps", lambda shown, *_: seen.update(shown=shown))
    monkeypatch.setattr(album, "picture_contacts", lambda mesh, maps, titles, *_: seen.update(maps=maps, titles=titles))
    robot, cube = load_robot("diana7_hit"), load_object("cube")
    several.contact_map[chosen(several)[3]] = 0
    album.write_album(cube, several, robot, tmp_path)
    rows = chosen(several)
    assert torch.equal(seen["shown"].position, several.position[rows])
    votes = [f"the other side; the map votes for {held}" for held in ("body", "body", "body", "nothing")]
    assert seen["titles"] == [(pictures.caption(several, row), vote) for row, vote in zip(rows, votes, strict=True)]
    surface = Surface(cube, 0.5)
    for found, row in zip(seen["maps"], rows, strict=True):
        np.testing.assert_array_equal(found, surface.parts(several.contact_map[row]))
