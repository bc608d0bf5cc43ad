"""Masses of users' meshes: given, or assumed by what the geometry shows; and what that does to grasps of a vessel."""

import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
from commands import call, load_command

from dora.affordance.objects import build
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.importing import Imported, import_mesh
from dora.affordance.objects.solids import lathe
from dora.affordance.objects.surface_repair import repair
from dora.affordance.objects.surfaces.weighing import Weighing, enclosed_room, weigh
from dora.errors import InputError
from dora.progress import ProgressDisplay
from dora.robot import load_robot
from dora.sim.grasp_tests.failures import failures
from dora.sim.grasp_tests.generation import generate

OUTSIDE = np.array([(0, 0), (0.056, 0), (0.07, 0.05), (0.056, 0.10), (0.02, 0.14), (0.02, 0.22), (0, 0.22)])
"""Outline of a carafe 22 cm high with a neck of 4 cm, as (radius, height) [m]."""
INSIDE = np.array([(0, 3), (53, 3), (67, 50), (53, 99), (17, 139), (17, 217), (0, 217)]) / 1000
"""Outline of the room in it, behind walls of about 3 mm [m]."""
GRASPS = 32
"""Candidates of a search."""


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_command("grasps")


def inverted(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    found = trimesh.util.concatenate(list(meshes))
    assert isinstance(found, trimesh.Trimesh)
    return found


def filled() -> trimesh.Trimesh:
    return lathe(OUTSIDE, 32)


def hollow() -> trimesh.Trimesh:
    """The carafe with a lid: two surfaces, the inner one turned inwards."""
    return joined(filled(), inverted(lathe(INSIDE, 32)))


def walled() -> trimesh.Trimesh:
    """The carafe with an open mouth and modelled walls."""
    return lathe(np.concatenate([OUTSIDE[:-1], [(0.017, 0.22)], INSIDE[-3:0:-1], INSIDE[:1]]), 32)


def sheet() -> trimesh.Trimesh:
    """The carafe with an open mouth and without walls."""
    mesh = filled()
    lid = (mesh.face_normals[:, 2] > 0.9) & (mesh.triangles_center[:, 2] > 0.21)
    return trimesh.Trimesh(mesh.vertices, mesh.faces[~lid], process=False)


def imported(
    mesh: trimesh.Trimesh,
    cache: Path,
    mass: float | None = None,
    density: float | None = None,
    threshold: float = 0.3,
) -> Imported:
    mesh.export(cache / "thing.stl")
    return import_mesh(cache / "thing.stl", mass=mass, density=density, threshold=threshold, cache_dir=cache)


def weighed(mesh: trimesh.Trimesh) -> Weighing:
    return weigh(repair(mesh, np.zeros(len(mesh.faces), np.int64), "thing"))


VOLUME = hollow().volume
"""Volume of the material of the hollow carafe [m^3]."""
KINDS = {
    "solid": (filled, 600 * filled().volume, "taken for a solid, 600 kg/m^3"),
    "hollow": (hollow, 1000 * hollow().area / 2 * 0.003, "around a closed cavity"),
    "vessel": (
        walled,
        1000 * walled().area / 2 * 0.003,
        "taken for a thin-walled vessel, walls of 3.0 mm and 1000 kg/m^3",
    ),
    "shell": (sheet, 3 * sheet().area, "taken for a shell, because its surface was open"),
}
"""How each is made, its mass by the rule [kg], and the words for it."""


@pytest.mark.parametrize("kind", KINDS)
def test_the_estimate_follows_the_geometry(kind: str, cache: Path):
    make, mass, words = KINDS[kind]
    found = imported(make(), cache)
    assert found.weighing.kind == kind
    assert found.weighing.assumed
    assert found.object.mass == found.weighing.mass == pytest.approx(mass, rel=1e-3)
    assert words in found.weighing.sentence()
    assert "kg assumed" in found.lines()[0]
    np.testing.assert_allclose(found.object.mesh.extents, [0.14, 0.14, 0.22], rtol=0.02)
    assert found.lines()[0].startswith("thing: 14.0 x 14.0 x 22.0 cm, ")


@pytest.mark.parametrize("kind", KINDS)
def test_mass_and_density_that_are_given_change_nothing_else(kind: str, cache: Path):
    make, _, _ = KINDS[kind]
    estimate, given = imported(make(), cache).object, imported(make(), cache, mass=0.3)
    dense = imported(make(), cache, density=2000.0)
    volume = {"shell": 0.003 * sheet().area, "solid": filled().volume}.get(kind, VOLUME if kind == "hollow" else None)
    assert given.object.mass == 0.3
    assert dense.object.mass == pytest.approx(2000 * (walled().volume if volume is None else volume), rel=1e-3)
    assert not given.weighing.assumed
    assert "0.3 kg by the mass given" in given.lines()[0]
    assert "kg by the density given" in dense.lines()[0]
    for other in (given.object, dense.object):
        assert other.digest == estimate.digest
        np.testing.assert_allclose(other.inertia / other.mass, estimate.inertia / estimate.mass, rtol=1e-9)


def test_inertia_and_centre_of_a_hollow_ball_and_of_a_shell(cache: Path):
    outer, inner = (trimesh.creation.icosphere(subdivisions=4, radius=r) for r in (0.05, 0.045))
    ball = imported(joined(outer, inverted(inner)), cache, mass=1.0).object
    exact = 0.4 * (0.05**5 - 0.045**5) / (0.05**3 - 0.045**3)
    np.testing.assert_allclose(ball.inertia, exact * np.eye(3), rtol=0.01, atol=1e-7)
    cup = trimesh.creation.cylinder(radius=0.04, height=0.1, sections=60)
    cup = trimesh.Trimesh(cup.vertices, cup.faces[cup.face_normals[:, 2] < 0.9], process=False)
    shell = imported(cup, cache).object
    bottom, side = np.pi * 0.04**2, 2 * np.pi * 0.04 * 0.1
    assert -shell.mesh.bounds[0, 2] == pytest.approx(0.05 * side / (side + bottom), rel=0.01)


@pytest.mark.parametrize(
    ("mesh", "least", "most"),
    [
        (walled(), 0.95, 1.10),
        (lathe(np.array([(0, 0), (0.1, 0), (0.1, 0.004), (0, 0.004)]), 32), 0, 0),  # a plate
        (trimesh.creation.torus(0.1, 0.002), 0, 0),
    ],
    ids=["carafe", "plate", "ring"],
)
def test_the_room_that_a_surface_encloses(mesh: trimesh.Trimesh, least: float, most: float):
    room = lathe(INSIDE, 32).volume
    assert least * room <= enclosed_room(mesh) <= most * room


def test_a_bowl_is_a_vessel_and_a_thick_tube_is_not():
    arc = np.linspace(0.1, np.pi / 2, 12)
    outer, inner = (np.column_stack([r * np.sin(arc), 0.07 - r * np.cos(arc)]) for r in (0.07, 0.066))
    assert weighed(lathe(np.array([(0, 0), *outer, *inner[::-1], (0, 0.004)]), 32)).kind == "vessel"
    tube = lathe(np.array([(0.02, 0), (0.03, 0), (0.03, 0.1), (0.02, 0.1), (0.02, 0)]), 32)
    assert weighed(tube).kind == "solid"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mass": 0.3, "density": 500.0}, "both a mass and a density"),
        ({"mass": -1.0}, r"mass of .* is -1.0; give a positive number, 1e-05 to 100 kg"),
        ({"mass": 0.0}, "mass of .* is 0.0"),
        ({"mass": 500.0}, "mass of .* is 500.0"),
        ({"density": float("nan")}, "density of .* is nan"),
        ({"density": 0.5}, r"density of .* is 0.5; give a positive number, 1 to 25000 kg/m\^3"),
        ({"density": 30_000.0}, "density of .* is 30000.0"),
    ],
)
def test_masses_that_no_object_has_are_refused(options: dict[str, float], words: str, cache: Path):
    filled().export(cache / "thing.stl")
    with pytest.raises(InputError, match=words):
        import_mesh(cache / "thing.stl", mass=options.get("mass"), density=options.get("density"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--mesh {mesh} --mass 0.3 --density 500", "exclude each other"),
        ("--mesh {mesh} --mass -1", "give a positive number"),
        ("--mesh {mesh} --density 0", "give a positive number"),
        ("--object jug --mass 0.3", "--mass and --density belong to --mesh"),
        ("--object jug --density 300", "--mass and --density belong to --mesh"),
    ],
)
def test_the_commands_refuse_them(
    arguments: str,
    words: str,
    script: ModuleType,
    cache: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    filled().export(cache / "thing.stl")
    assert call(script, monkeypatch, *arguments.format(mesh=cache / "thing.stl").split()) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_walls_count_as_one_to_three_millimetres_thick():
    for wall, counted in ((0.00001, 0.003), (0.0002, 0.001), (0.002, 0.002), (0.006, 0.003)):
        outer, inner = (trimesh.creation.icosphere(subdivisions=3, radius=r) for r in (0.05, 0.05 - wall))
        area = (outer.area + inner.area) / 2
        assert weighed(joined(outer, inverted(inner))).mass == pytest.approx(1000 * counted * area, rel=0.05)
    thick = joined(outer, inverted(trimesh.creation.icosphere(subdivisions=3, radius=0.03)))
    assert weighed(thick).mass == pytest.approx(600 * thick.volume)


def test_a_folder_of_a_given_density(cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setenv("DORA_CACHE", str(cache))
    trimesh.creation.box((0.05, 0.04, 0.03)).export(cache / "brick.stl")
    monkeypatch.setattr(
        "sys.argv", ["build", str(cache / "brick"), "--mesh", str(cache / "brick.stl"), "--density", "1000"]
    )
    assert build.main() == 0
    assert "brick: 5.0 x 4.0 x 3.0 cm, 0.06 kg by the density given" in capsys.readouterr().err
    assert load_object(cache / "brick").mass == pytest.approx(0.06)


@pytest.mark.slow
def test_more_grasps_of_a_hollow_vessel_are_valid_than_of_a_solid_one(cache: Path):
    """22 cm high: weighed as a solid few are valid, weighed as what it is about half."""
    shares = {}
    for kind, mass in (("solid", 600 * filled().volume), ("hollow", None)):
        found = imported(hollow(), cache, mass, threshold=0.1)
        with ProgressDisplay() as phases:
            made = generate(found.object, load_robot("diana7_hit"), GRASPS, 0, None, phases)
        shares[kind] = float(made.candidates.valid.float().mean())
        counted = failures(made.candidates, made.verdict)
        assert sum(counted["causes"].values()) == counted["failed"] == GRASPS - int(made.candidates.valid.sum())
    print(shares)
    assert shares["hollow"] > shares["solid"] + 0.15


def test_the_command_says_size_and_mass_first_and_why_few_are_valid_last(
    script: ModuleType, cache: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """A box that no hand holds, of 40 kg."""
    monkeypatch.setenv("DORA_CACHE", str(cache))
    trimesh.creation.box((0.06, 0.05, 0.10)).export(cache / "box.stl")
    out = cache / "box.safetensors"
    options = ("--mesh", str(cache / "box.stl"), "--mass", "40", "--num", "8", "--baselines", "0")
    assert call(script, monkeypatch, *options, "--validate", "sapien", "--out", str(out)) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("box: 6.0 x 5.0 x 10.0 cm, 40 kg by the mass given, taken for a solid\n")
    assert "why 8 candidates are not valid" in shown
    assert "most slip down: the object weighs 40 kg; if that is right, ask for another --region" in shown
    report = json.loads(out.with_suffix(".json").read_text())
    assert (report["mass_kg"], report["mass_assumed"]) == (40, False)
    assert report["size_cm"] == pytest.approx([6, 5, 10])
    assert report["failures"]["failed"] == 8
    assert report["failures"]["causes"]["slipped down"] >= 6
    assert report["failures"]["hint"] in shown
