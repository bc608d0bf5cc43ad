"""The grasp command: bad input, what it writes, interruption, and a mesh that nobody here made."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import mani_skill
import numpy as np
import pytest
import torch
from commands import call, load_command, refusal

from dora.affordance.bundled_sets import bundled_path, load_candidates
from dora.affordance.candidates import GraspCandidates
from dora.affordance.contact_maps import with_contact_maps
from dora.affordance.hand.grasp_test_settings import STANDARD
from dora.affordance.objects.catalogue import load_object
from dora.affordance.search.cache import hand_of, map_of
from dora.affordance.search.optimise import Settings
from dora.affordance.views import album
from dora.progress import ProgressDisplay
from dora.robot import load_robot
from dora.sim.grasp_tests import generation as grasps
from dora.sim.grasp_tests.shake_test import Reason, Validation

PACKAGE = Path(mani_skill.__file__).parent
KEYS = {
    "object", "robot", "requested", "optimised", "valid", "valid_per_second", "optimise_seconds", "sim_success_rate",
    "penetration_mm", "classes", "energy", "digest",
}  # fmt: skip
QUICK = Settings(iterations=20)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_command("grasps")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "--object or --mesh"),
        ("--object jug --mesh a.stl", "--object or --mesh"),
        ("--object jug --num 0", "--num is 0"),
        ("--object jug --num 65537", "--num is 65537"),
        ("--object jug --baselines -1", "--baselines is -1"),
        ("--object jug --by-region -1", "--by-region is -1"),
        ("--object jug --by-region 8", "--validate sapien with it"),
        ("--object jug --region spoon", "no region 'spoon'"),
        ("--object jug --seat nan", "0 to 2.0 rad"),
        ("--object cube --make-bundle --seat -0.1", "0 to 2.0 rad"),
        ("--object jug --scale 2", "belong to --mesh"),
        ("--object jug --units mm", "belong to --mesh"),
        ("--object jug --mass 1", "belong to --mesh"),
        ("--object jug --density 900", "belong to --mesh"),
        ("--object jug --labels a.yaml", "belong to --mesh"),
        ("--mesh a.stl --mass 1 --density 900", "exclude each other"),
        ("--object jug --out a.json", "ends in .safetensors"),
        ("--object jug --out /proc/nowhere/a.safetensors", "choose another --out"),
        ("--object jug --robot ur5", "unknown robot 'ur5'"),
        ("--mesh nowhere.stl", "nowhere.stl"),
        ("--object hamer", "no object 'hamer', nor a folder or mesh at that path: did you mean 'hammer'?"),
        ("--make-bundle", "need --object"),
        ("--contact-maps", "need --object"),
        ("--contact-maps --object spoon", "no object 'spoon'"),
        ("--rank-in-task --mesh a.stl", "need --object"),
        ("--make-bundle --object cube --kinematics pytorch_kinematics", "is for searches, not for --make-bundle"),
        ("--make-bundle --object cube --num 8", "--num 8 is for searches"),
        ("--make-bundle --object cube --out a.safetensors", "--out a.safetensors is for searches"),
        ("--make-bundle --object cube --labels a.yaml", "--labels a.yaml is for searches"),
        ("--make-bundle --object cube --mass 2", "--mass 2.0 is for searches"),
        ("--make-bundle --object cube --validate sapien", "--validate sapien is for searches"),
        ("--rank-in-task --object cube --seed 3", "--seed 3 is for searches"),
        ("--refine-in-task", "need --object"),
        ("--refine-in-task --object cube --seed 3", "--seed 3 is for searches"),
        ("--refine-in-task --object microwave", "DoraMicrowave-v1 has several arms"),
        ("--contact-maps --object cube --any-region", "--any-region True is for searches"),
        ("--contact-maps --rank-in-task --object cube", "--contact-maps goes alone"),
        ("--object cube --any-region", "a search takes --region any"),
        ("--rank-in-task --object spoon", "no object 'spoon'"),
    ],
)
def test_bad_input(
    script: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: str,
    words: str,
):
    for work in ("generate", "make_bundle", "rank_bundled_set", "refine_bundled_set", "map_bundled_set"):
        if "cube" in arguments:
            monkeypatch.setattr(script, work, lambda *_, **__: pytest.fail("work has begun"))
    assert words in refusal(script, monkeypatch, capsys, arguments)


@pytest.mark.parametrize("arguments", ["--validate isaac", "--kinematics newton", "--ship", "--no-such-option 1"])
def test_errors_of_the_parser(script: ModuleType, monkeypatch: pytest.MonkeyPatch, arguments: str):
    with pytest.raises(SystemExit) as exit_info:
        call(script, monkeypatch, *arguments.split())
    assert exit_info.value.code == 2


@pytest.mark.parametrize(
    ("name", "words"),
    [("labels.safetensors", "is no set of grasps"), ("labels.json", "where the report is written, exists")],
)
def test_other_files_are_not_replaced(
    script: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    name: str,
    words: str,
):
    path = tmp_path / name
    path.write_text('{"object": "mine"}')
    said = refusal(script, monkeypatch, capsys, f"--object cube --num 2 --out {tmp_path / 'labels.safetensors'}")
    assert words in said
    assert path.read_text() == '{"object": "mine"}'


def test_searches_for_comparison_are_those_that_were_asked_for_less_a_part(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(grasps, "generate", lambda *given, name, kinematics: (name, kinematics, given[7]))
    monkeypatch.setattr(grasps, "summary", lambda found: {"search": found})
    obj, robot = load_object("cube"), load_robot("diana7_hit")
    asked = Settings(seat=0.4, oversampling=3.0)
    made = grasps.baselines(obj, robot, 3, 0, None, ProgressDisplay(), False, "compiled", asked)
    found = {name: summary["search"] for name, summary in made.items()}
    assert set(found) == set(grasps.BASELINES)
    assert all(name == key and kind == "compiled" for key, (name, kind, _) in found.items())
    assert {key: settings.seat for key, (_, _, settings) in found.items() if settings.seat} == {"no_closure": 0.4}
    assert {settings.oversampling for *_, settings in found.values()} == {3.0}
    assert found["no_closure"][2].weights.closure == 0 != found["unseated"][2].weights.closure


def test_files_and_table(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    monkeypatch.setattr(grasps, "BASELINES", {name: {"iterations": 1} for name in grasps.BASELINES})
    monkeypatch.setattr("dora.commands.grasps.Settings", lambda **_: QUICK)
    monkeypatch.setenv("COLUMNS", "200")  # headings are not wrapped
    out = tmp_path / "new" / "jug.safetensors"
    arguments = ("--object", "jug", "--num", "6", "--baselines", "3", "--seed", "4", "--out", str(out))
    assert call(script, monkeypatch, *arguments) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[-1] == str(out)
    assert "unseated no closure" in shown
    assert "unseated one iteration" in shown
    report = json.loads(out.with_suffix(".json").read_text())
    candidates = GraspCandidates.load(out, load_object("jug"), load_robot("diana7_hit"))
    anew = with_contact_maps(candidates, map_of(load_object("jug"), "cpu"), hand_of(load_robot("diana7_hit"), "cpu"))
    assert torch.equal(candidates.contact_map, anew.contact_map)
    assert candidates.contact_map.any()
    assert set(report) >= KEYS
    assert set(report["penetration_mm"]) >= {"median", "p95", "max"}
    assert report["requested"] == 6
    assert report["optimised"] == len(candidates)
    assert report["region"] == "handle"
    assert report["valid"] == int(candidates.valid.sum())
    assert report["sim_success_rate"] is None
    assert sum(report["classes"].values()) == report["valid"]
    assert set(report["energy"]) == set(candidates.energy)
    assert report["penetration_mm"]["max"] == pytest.approx(1000 * float(candidates.penetration.max()))
    names = ("no_closure", "unseated", "unseated_no_closure", "unseated_one_iteration")
    assert {name: b["requested"] for name, b in report["baselines"].items()} == dict.fromkeys(names, 3)
    assert sorted(p.name for p in out.parent.iterdir()) == ["jug.json", "jug.safetensors"]


@pytest.mark.parametrize(
    ("words", "region"), [("--refine-in-task", True), ("--refine-in-task --any-region --seat 0", False)]
)
def test_refining_says_what_it_took(
    words: str, region: bool, script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    asked: list[tuple[str, bool, float]] = []

    def refine(name: str, phases: object, region: bool, settings: Settings) -> list[Path]:
        asked.append((name, region, settings.seat))
        return [bundled_path("jug")]

    monkeypatch.setattr(script, "refine_bundled_set", refine)
    assert call(script, monkeypatch, "--object", "jug", *words.split()) == 0
    assert asked == [("jug", region, Settings().seat if region else 0.0)]
    found = load_candidates("jug")
    path, ranking = capsys.readouterr().out.splitlines()
    assert path == str(bundled_path("jug"))
    assert f"{found.ranking_steps:,} control steps" in ranking
    assert f"best: {found.score[0]:.2f}, {found.score[1]:.2f}" in ranking


def test_contact_maps_of_a_folder(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    """A copy of the jug whose grasps have lost their maps gets them back, and all else stays."""
    folder = tmp_path / "jug"
    shutil.copytree(bundled_path("jug").parent, folder)
    bundled = GraspCandidates.load(bundled_path("jug"))
    replace(bundled, contact_map=torch.zeros(len(bundled), 0, dtype=torch.uint8)).save(folder / "grasps.safetensors")
    assert call(script, monkeypatch, "--object", str(folder), "--contact-maps") == 0
    shown = capsys.readouterr().out.splitlines()
    assert shown[1].startswith("handle 96: contact maps vote ")
    assert shown[-1] == str(folder / "grasps.safetensors")
    again = GraspCandidates.load(folder / "grasps.safetensors")
    assert (again.contact_map == bundled.contact_map).float().mean() > 0.9999
    assert torch.equal(again.grasp, bundled.grasp)


def test_what_is_done_together_takes_the_options_of_both(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    done = []
    monkeypatch.setattr(script, "rank_bundled_set", lambda *_: done.append("ranked") or [])
    monkeypatch.setattr(script, "refine_bundled_set", lambda *given: done.append(given[-1].seat) or [])
    assert call(script, monkeypatch, *["--rank-in-task", "--refine-in-task", "--object", "cube", "--seat", "0.1"]) == 0
    assert done == ["ranked", 0.1]


def test_interruption_leaves_nothing(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(grasps, "optimise", stop)
    out = tmp_path / "jug.safetensors"
    assert call(script, monkeypatch, "--object", "jug", "--out", str(out)) == 130
    assert "nothing was written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_validity_is_that_of_the_simulation(monkeypatch: pytest.MonkeyPatch):
    obj, robot = load_object("cube"), load_robot("diana7_hit")
    seen = {}

    def judge(candidates, obj, robot, test_settings, progress) -> Validation:
        progress(len(candidates), len(candidates))
        seen["found"] = candidates
        passed = torch.arange(len(candidates)) % 2
        zeros = torch.zeros(len(candidates))
        return Validation(
            reason=torch.where(passed == 1, int(Reason.PASSED), int(Reason.SLIPPED)),
            displacement=zeros, closing_shift=zeros + 0.03 * (torch.arange(len(candidates)) == 1), penetration=zeros,
            part_force=torch.zeros(len(candidates), 6), label_force=torch.zeros(len(candidates), 1),
            contacts=candidates.contacts, contact_finger=candidates.contact_finger,
            candidate_penetration=zeros + 0.003 * (torch.arange(len(candidates)) == 3),
            self_penetration=zeros, test_settings=test_settings,
        )  # fmt: skip

    monkeypatch.setattr(grasps, "validate", judge)
    generated = grasps.generate(obj, robot, 6, 0, None, ProgressDisplay(), True, QUICK)
    report = grasps.summary(generated)
    assert generated.candidates.valid.tolist() == [False, True, False, False, False, True]
    assert report["valid"] == 2
    assert report["sim_success_rate"] == pytest.approx(0.5)
    assert report["valid_share"] == pytest.approx(2 / 6)
    assert report["strict_share"] == pytest.approx(1 / 6)
    seconds = generated.optimise_seconds + generated.validate_seconds
    assert report["valid_per_second"] == pytest.approx(2 / seconds)


def test_the_digest_of_a_report_depends_on_the_mass():
    """Closing, ranking and the grasp test do."""
    robot, digests = load_robot("diana7_hit"), set()
    for mass in (0.1, 0.1, 2.0):
        obj = replace(load_object("cube"), mass=mass)
        generated = grasps.generate(obj, robot, 2, 0, None, ProgressDisplay(), simulate=False, settings=QUICK)
        digests.add(grasps.summary(generated)["digest"])
    assert len(digests) == 2


def at_handle_and_body(
    candidates: GraspCandidates, robot: object, test_settings: object, progress: object
) -> Validation:
    """A verdict by which grasps in turn close upon handle and body, whatever they touched before; two of them slip."""
    jug, count = load_object("jug"), len(candidates)
    by_handle = torch.arange(count) % 2 == 0
    outer = jug.mesh.vertices[jug.mesh.vertices[:, 0].argmax()]  # of the handle
    places = torch.tensor(np.stack([jug.centroid("body"), outer])).float()
    force = torch.zeros(count, len(jug.labels))
    force[by_handle, jug.label_index("handle")] = 5.0
    force[~by_handle, jug.label_index("body")] = 5.0
    force[:2] += 4.0  # not clearly held
    zeros, reason = torch.zeros(count), torch.full((count,), int(Reason.PASSED))
    reason[2:4] = int(Reason.SLIPPED)
    return Validation(
        reason=reason, displacement=zeros, closing_shift=zeros, penetration=zeros,
        part_force=torch.zeros(count, 6), label_force=force,
        contacts=places[by_handle.long()][:, None], contact_finger=torch.full((count, 1), 2),
        candidate_penetration=zeros, self_penetration=zeros, test_settings=STANDARD,
    )  # fmt: skip


def test_searches_by_region_and_the_votes(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    """12 grasps by the handle asked for, and as many of a free search, of the body's and of the rim's."""
    bundled = GraspCandidates.load(bundled_path("jug"))
    asked = []

    def search(obj, robot, num, seed, region, settings, progress, kinematics) -> GraspCandidates:
        asked.append((region, num))
        return bundled.select(slice(num))

    monkeypatch.setattr(grasps, "optimise", search)
    monkeypatch.setattr(grasps, "validate", lambda c, obj, *rest, **named: at_handle_and_body(c, *rest, **named))
    out = tmp_path / "jug.safetensors"
    options = ("--object", "jug", "--num", "12", "--by-region", "8", "--baselines", "0", "--validate", "sapien")
    assert call(script, monkeypatch, *options, "--out", str(out)) == 0
    assert asked == [("handle", 12), (None, 8), ("body", 8), ("rim", 8)]
    shown = capsys.readouterr().out
    assert "balanced" in shown
    report = json.loads(out.with_suffix(".json").read_text())
    assert report["class_shares"] == {"HandleGrasp": 0.5, "BodyGrasp": 0.5}
    assert list(report["by_region"]) == ["any", "body", "rim"]
    assert GraspCandidates.load(out).grasp_class == ("HandleGrasp", "BodyGrasp") * 6
    voting = report["voting"]
    assert voting["labels"] == ["body", "handle", "rim"]
    for group, each in (("all", 18), ("clear", 14), ("valid", 14), ("valid_clear", 10)):
        assert voting[group]["grasps"] == 2 * each
        closed, before = voting[group]["closed_hand"], voting[group]["candidate"]
        assert closed["balanced_accuracy"] == 1
        assert closed["confusion"] == [[each, 0, 0, 0], [0, each, 0, 0], [0, 0, 0, 0]]
        assert before["balanced_accuracy"] == pytest.approx(0.5)  # the bundled ones touch the handle
        assert before["recall"] == {"body": 0, "handle": 1}
        mapped = voting[group]["contact_map"]["confusion"]
        assert [sum(row) for row in mapped] == [each, each, 0]
        assert min(mapped[0][1], mapped[1][1]) > each / 2  # so do most of their maps
    assert voting["map_by_closed_hand"] == voting["all"]["contact_map"]["confusion"]


def test_the_digest_follows_object_robot_and_settings():
    path = bundled_path("cube")
    candidates = GraspCandidates.load(path)
    digest = grasps.origin_digest(candidates)
    assert grasps.origin_digest(GraspCandidates.load(path)) == digest
    for name in ("digest", "robot_digest", "settings"):
        assert grasps.origin_digest(replace(candidates, **{name: "other"})) != digest


FOREIGN = {
    "assets/deformable_manipulation/beaker.glb": (
        ("--scale", "0.04"),
        {"plane": {"point": [0, 0, 1], "normal": [0, 0, 1]}},
    ),
    "envs/tasks/fmb/assets/purple_u.ply": ((), {"box": {"min": [-1, -1, -1], "max": [1, 0, 1]}}),
}
"""A laboratory beaker and a CAD part, which ManiSkill contains: options, and a region that they get here."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FOREIGN)
def test_labelled_meshes_by_others_go_all_the_way(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
):
    """Import, regions, search by region, simulation, files, and pictures of them, in a short search."""
    monkeypatch.setenv("DORA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("dora.commands.grasps.Settings", lambda **_: QUICK)
    monkeypatch.setattr(album, "FINER", 1.0)
    options, shape = FOREIGN[name]
    labels, out = tmp_path / "labels.yaml", tmp_path / "found.safetensors"
    labels.write_text(json.dumps({"regions": {"grip": shape}}))
    mesh = ("--mesh", str(PACKAGE / name), "--labels", str(labels), *options)
    search = ("--region", "grip", "--num", "4", "--baselines", "0", "--validate", "sapien", "--out", str(out))
    assert call(script, monkeypatch, *mesh, *search) == 0
    report = json.loads(out.with_suffix(".json").read_text())
    candidates = GraspCandidates.load(out)
    assert (report["region"], report["optimised"], candidates.object) == ("grip", 4, Path(name).stem)
    assert set(candidates.grasp_class) <= {"GripGrasp", "BodyGrasp"}
    assert "GripGrasp" in candidates.grasp_class
    assert set(report["voting"]["labels"]) == {"grip", "body"}
    folder = tmp_path / "pictures"
    assert call(load_command("view"), monkeypatch, str(out), *mesh, "--pictures", str(folder)) == 0
    stem = Path(name).stem
    assert {p.name for p in folder.iterdir()} == {f"{stem}-{what}.png" for what in ("map", "grasps", "contacts")}


def test_a_mesh_from_elsewhere_goes_all_the_way(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    """A bottle modelled by others (18 cm at this scale): import, search, simulation, files."""
    monkeypatch.setenv("DORA_CACHE", str(tmp_path / "cache"))
    bottle = PACKAGE / "assets" / "deformable_manipulation" / "bottle.glb"
    out = tmp_path / "bottle.safetensors"
    options = ("--mesh", str(bottle), "--scale", "0.03", "--num", "8", "--baselines", "0", "--validate", "sapien")
    assert call(script, monkeypatch, *options, "--out", str(out)) == 0
    report = json.loads(out.with_suffix(".json").read_text())
    candidates = GraspCandidates.load(out)
    assert candidates.object == "bottle"
    assert report["region"] is None
    assert report["valid"] == int(candidates.valid.sum()) >= 1
    assert 0 < report["sim_success_rate"] <= 1
