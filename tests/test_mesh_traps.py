"""Meshes that are read without an error and could still be taken for something that they are not."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from dora.affordance.objects.importing import import_object
from dora.affordance.objects.surface_repair import repair
from dora.errors import InputError

U_SHAPE = [(0, 0), (10, 0), (10, 10), (8, 10), (8, 2), (2, 2), (2, 10), (0, 10)]
"""Outline of a U [cm]."""
CAP = [(0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4), (0, 5, 6), (0, 6, 7)]
"""Its triangles."""


def bent(closed: bool) -> trimesh.Trimesh:
    """A U of 5 cm height, with or without its bottom."""
    n = len(U_SHAPE)
    low, high = (np.column_stack([np.array(U_SHAPE), np.full(n, z)]) for z in (0, 5))
    walls = [face for i in range(n) for j in [(i + 1) % n] for face in ((i, j, n + j), (i, n + j, n + i))]
    top, bottom = [tuple(n + k for k in face) for face in CAP], [face[::-1] for face in CAP]
    faces = [*walls, *top, *(bottom if closed else [])]
    return trimesh.Trimesh(0.01 * np.concatenate([low, high]), faces, process=False)


def test_a_hole_whose_fan_would_leave_the_object_is_refused():
    """The middle of the rim lies between the arms of the U, and what closes it from there hangs in the air."""
    whole = bent(closed=True)
    assert whole.is_watertight
    assert len(repair(whole, np.zeros(len(whole.faces), int), "u").mesh.faces) == len(whole.faces)
    with pytest.raises(InputError, match="would lie outside of the object"):
        repair(bent(closed=False), np.zeros(len(whole.faces) - len(CAP), int), "u")


def test_a_hole_that_is_seen_whole_from_its_middle_is_closed():
    """Not convex, but a star."""
    cup = trimesh.creation.cylinder(0.03, 0.08, sections=24)
    open_cup = trimesh.Trimesh(cup.vertices, cup.faces[cup.triangles_center[:, 2] < 0.0399], process=False)
    ring = np.isclose(open_cup.vertices[:, 2], 0.04) & (np.hypot(*open_cup.vertices[:, :2].T) > 0.01)
    open_cup.vertices[np.flatnonzero(ring)[::2], :2] *= 0.8
    assert repair(open_cup, np.zeros(len(open_cup.faces), int), "cup").mesh.is_watertight


def klein_bottle(around: int = 24, across: int = 12) -> trimesh.Trimesh:
    """Closed, since every edge has two faces, and with one side only: a figure of 8 that turns by half a turn."""
    u, v = np.meshgrid(*(np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (around, across)), indexing="ij")
    radius = 2 + np.cos(u / 2) * np.sin(v) - np.sin(u / 2) * np.sin(2 * v)
    height = np.sin(u / 2) * np.sin(v) + np.cos(u / 2) * np.sin(2 * v)
    vertices = 0.02 * np.stack([radius * np.cos(u), radius * np.sin(u), height], -1).reshape(-1, 3)

    def at(i: int, j: int) -> int:
        return i * across + j % across if i < around else -j % across

    corners = [(at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)) for i in range(around) for j in range(across)]
    return trimesh.Trimesh(vertices, [face for a, b, c, d in corners for face in ((a, b, c), (a, c, d))], process=False)


@pytest.mark.parametrize("beside", [False, True], ids=["alone", "beside a box"])
def test_a_surface_with_one_side_only_is_refused(beside: bool):
    mesh = klein_bottle()
    assert mesh.is_watertight
    if beside:
        box = trimesh.creation.box((0.1, 0.1, 0.1))
        vertices = np.concatenate([mesh.vertices, box.vertices + np.array([0.3, 0, 0])])
        faces = np.concatenate([mesh.faces, box.faces + len(mesh.vertices)])
        mesh = trimesh.Trimesh(vertices, faces, process=False)
    with pytest.raises(InputError, match="one side only"):
        repair(mesh, np.zeros(len(mesh.faces), int), "bottle")


def test_a_region_that_earlier_ones_cover_is_refused(tmp_path: Path):
    box = trimesh.creation.box((0.1, 0.05, 0.05))
    box.export(tmp_path / "a.stl")
    everything, end = ({"box": {"min": [x, -1, -1], "max": [1, 1, 1]}} for x in (-1, 0.049))
    for order, refused in (({"body": everything, "handle": end}, True), ({"handle": end, "body": everything}, False)):
        (tmp_path / "a.yaml").write_text(json.dumps({"regions": order}))
        if refused:
            with pytest.raises(InputError, match=r"'handle' of .* not in an earlier region \('body'\)"):
                import_object(tmp_path / "a.stl", tmp_path / "a.yaml", mass=0.1, cache_dir=tmp_path / "cache")
        else:
            obj = import_object(tmp_path / "a.stl", tmp_path / "a.yaml", mass=0.1, cache_dir=tmp_path / "cache")
            assert set(obj.labels) == {"body", "handle"}


def stating(path: Path, size: float, unit: str | None) -> Path:
    """A cube as a 3MF file that says its unit, or nothing."""
    trimesh.creation.box((size, size, size)).export(path)
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist()}
    for name, data in content.items():
        if name.endswith(".model"):
            text = data.decode()
            head, _, rest = text.partition("<model")
            attributes, _, tail = rest.partition(">")
            kept = " ".join(part for part in attributes.split() if not part.startswith("unit="))
            own = "" if unit is None else f' unit="{unit}"'
            content[name] = f"{head}<model{own} {kept}>{tail}".encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize(
    ("size", "unit", "metres"),
    [(1.5, "inch", 0.0381), (50.0, "millimeter", 0.05), (50.0, None, 0.05), (0.05, "meter", 0.05)],
)
def test_a_3mf_file_is_in_the_unit_that_it_states(tmp_path: Path, size: float, unit: str | None, metres: float):
    path = stating(tmp_path / "a.3mf", size, unit)
    obj = import_object(path, mass=0.1, cache_dir=tmp_path / "cache")
    assert obj.mesh.extents == pytest.approx([metres] * 3, rel=1e-4)


def test_another_unit_than_a_3mf_file_states_is_refused(tmp_path: Path):
    path = stating(tmp_path / "a.3mf", 5.0, "centimeter")
    with pytest.raises(InputError, match="says that it is in centimeter, and --units is mm"):
        import_object(path, units="mm", mass=0.1, cache_dir=tmp_path / "cache")
    assert import_object(path, units="cm", mass=0.1, cache_dir=tmp_path / "cache").mesh.extents[0] == pytest.approx(
        0.05
    )
    with pytest.raises(InputError, match="is in micron: export it in millimeters"):
        import_object(stating(tmp_path / "b.3mf", 5.0, "micron"), mass=0.1, cache_dir=tmp_path / "cache")
