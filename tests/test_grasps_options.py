"""What `dora grasps` does with its options: which object and region it takes, and which work is done."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from commands import call, refusal

from dora.affordance.bundled_sets import bundled_path
from dora.affordance.candidates import GraspCandidates
from dora.affordance.objects.catalogue import load_object
from dora.affordance.search.optimise import Settings
from dora.commands import grasps
from dora.errors import InputError

MADE = ("made", "cube", 3, "usable cube", True, Settings.seat)
BLIND = ("made", "cube", 0, "usable cube", False, Settings.seat)
"""How sets are made with seed 3, and without a region."""


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    folder = load_object("cube").folder
    assert folder is not None
    (tmp_path / "block.ply").write_bytes((folder / "mesh.ply").read_bytes())
    return tmp_path / "block.ply"


@pytest.mark.parametrize("name", ["labels", "mass", "density", "scale", "units"])
def test_options_of_a_mesh_are_refused_with_an_object(name: str):
    given: dict[str, Any] = {"labels": Path("a.yaml"), "mass": 1.0, "density": 1.0, "scale": 2.0, "units": "mm"}
    with pytest.raises(InputError, match="belong to --mesh"):
        grasps.target(grasps.Args(object="cube", **{name: given[name]}))


def test_an_object_is_taken_with_its_target_and_a_mesh_with_any_region(mesh: Path):
    found = grasps.described_target(grasps.Args(object="jug"))
    jug = load_object("jug")
    assert (found.obj.name, found.region, found.assumed) == ("jug", "handle", False)
    (line,) = found.lines
    assert line.endswith(f"{jug.mass:.3g} kg")
    assert grasps.described_target(grasps.Args(object="jug", region="any")).region is None
    own = grasps.described_target(grasps.Args(mesh=mesh))
    assert (own.obj.name, own.region, own.assumed) == ("block", None, True)
    with_mass = grasps.described_target(grasps.Args(mesh=mesh, mass=0.5))
    assert (with_mass.obj.mass, with_mass.assumed) == (0.5, False)
    file = grasps.described_target(grasps.Args(object=str(mesh)))
    assert file.assumed
    assert file.lines[0].endswith(" kg assumed")
    with pytest.raises(InputError, match="exclude each other"):
        grasps.target(grasps.Args(mesh=mesh, mass=0.5, density=1000.0))
    for args in (grasps.Args(), grasps.Args(object="jug", mesh=mesh)):
        with pytest.raises(InputError, match="Give either --object or --mesh"):
            grasps.target(args)


def test_the_size_of_an_object_is_told_in_centimetres(mesh: Path):
    found = grasps.described_target(grasps.Args(mesh=mesh, mass=0.5))
    about = grasps.about(found)
    assert about["size_cm"] == pytest.approx([100 * side for side in load_object("cube").mesh.extents])
    assert (about["mass_kg"], about["mass_assumed"], about["notes"]) == (0.5, False, list(found.lines))


def test_the_letters_of_a_region_may_be_composed_in_either_way():
    """A keyboard makes one letter of what some files store as two."""
    cube = load_object("cube")
    renamed = replace(
        cube, labels=tuple("gr\u00fcn" if n == cube.target else n for n in cube.labels), target="gr\u00fcn"
    )
    assert grasps.region_of(renamed, "gru\u0308n") == "gr\u00fcn"
    with pytest.raises(InputError, match="no region 'blau'"):
        grasps.region_of(renamed, "blau")


def test_a_ranked_set_is_told_with_its_best_scores(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    found = GraspCandidates.load(bundled_path("cube"))
    grasps.print_ranked([bundled_path("cube")])
    first, second = capsys.readouterr().out.splitlines()
    assert first == str(bundled_path("cube"))
    assert second.endswith("scores of the best: " + ", ".join(f"{score:.2f}" for score in found.score[:5].tolist()))


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Which work on bundled sets is done, without doing it."""
    done: list[Any] = []
    monkeypatch.setattr(grasps, "usable_in_task", lambda name: f"usable {name}")
    monkeypatch.setattr(
        grasps, "make_bundle", lambda name, seed, _, usable, region, settings: done.append(
            ("made", name, seed, usable, region, settings.seat)
        ) or "made"
    )  # fmt: skip
    monkeypatch.setattr(grasps, "rank_bundled_set", lambda name, _, region: done.append(("ranked", name, region)) or [])
    monkeypatch.setattr(
        grasps, "refine_bundled_set", lambda name, _, region, __: done.append(("refined", name, region)) or []
    )
    return done


@pytest.mark.parametrize(
    ("words", "used", "wanted"),
    [
        ("--make-bundle --seed 3", True, [MADE, ("ranked", "cube", True)]),
        ("--make-bundle --seat 0.5", False, [("made", "cube", 0, "usable cube", True, 0.5)]),
        ("--make-bundle --any-region", True, [BLIND, ("ranked", "cube", False)]),
        ("--rank-in-task", False, [("ranked", "cube", True)]),
        ("--rank-in-task --any-region", True, [("ranked", "cube", False)]),
        ("--refine-in-task", True, [("refined", "cube", True)]),
        ("--refine-in-task --any-region", True, [("refined", "cube", False)]),
    ],
)  # fmt: skip
def test_a_set_that_is_made_is_ranked_where_a_task_uses_its_object(
    words: str, used: bool, wanted: list[Any], done: list[Any], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(grasps, "tasks_of", lambda obj: ["DoraCube-v1"] if used else [])
    assert call(grasps, monkeypatch, "--object", "cube", *words.split()) == 0
    assert done == wanted


@pytest.mark.parametrize("words", ["--seat 0.5", "--seed 2"])
def test_what_a_ranking_does_not_take_is_refused(
    words: str, done: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    assert "is for searches" in refusal(grasps, monkeypatch, capsys, f"--object cube --rank-in-task {words}")
    assert done == []


@pytest.mark.parametrize(
    ("words", "entries"),
    [
        ("", ["baselines"]),
        ("--baselines 0", []),
        ("--seat 0.4", ["baselines"]),
        ("--baselines 0 --validate sapien", ["voting"]),
        ("--validate sapien --by-region 5", ["baselines", "by_region", "voting"]),
    ],
)
def test_a_search_is_reported_with_what_was_asked_for_beside_it(
    words: str, entries: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    written: list[Any] = []
    searched: dict[str, Any] = {}
    simulated = "sapien" in words

    def generated(obj: Any, robot: Any, num: int, seed: int, region: Any, *rest: Any, kinematics: str) -> Any:
        searched["search"] = obj.name, num, seed, region, rest[1], rest[2].seat, kinematics
        return SimpleNamespace(candidates="the candidates")

    monkeypatch.setattr(grasps, "generate", generated)
    monkeypatch.setattr(grasps, "summary", lambda found: {"failures": {}})
    monkeypatch.setattr(grasps, "hint", lambda failures, obj, assumed: f"hint {assumed}")
    monkeypatch.setattr(grasps, "by_region", lambda *given: {"base": given[2:5]})
    monkeypatch.setattr(grasps, "voting_summary", lambda found, obj: len(found))
    monkeypatch.setattr(grasps, "baselines", lambda *given: (*given[2:5], *given[6:8], given[8].seat))
    monkeypatch.setattr(grasps, "print_report", lambda report: None)
    monkeypatch.setattr(grasps, "write_report", lambda *given: written.append(given))
    seat = 0.4 if "--seat" in words else Settings.seat
    assert call(grasps, monkeypatch, "--object", "jug", "--seed", "4", *words.split()) == 0
    out = Path("runs") / "grasps" / "jug.safetensors"
    assert capsys.readouterr().out.splitlines()[-1] == str(out)
    ((report, candidates, path),) = written
    assert (candidates, path) == ("the candidates", out)
    assert searched["search"] == ("jug", 256, 4, "handle", simulated, seat, "compiled")
    assert sorted(set(report) & {"baselines", "by_region", "voting"}) == entries
    assert report["failures"] == {"hint": "hint False"}
    assert report["kinematics"] == "compiled"
    if "baselines" in entries:
        assert report["baselines"] == (64, 4, "handle", simulated, "compiled", seat)
    if "voting" in entries:
        assert report["voting"] == (2 if "by_region" in entries else 1)
