"""Checksums of files that people write: what `sha256sum` wrote is compared, and all that is shipped has them."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from dora.affordance.objects.articulation import load_mount
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.objects.importing import read_mesh
from dora.affordance.objects.labels import read_labels
from dora.digests import MOST_SUMS, SUMS, check_file, check_folder, check_text, listed_checksums, with_checksum
from dora.errors import InputError
from dora.files import renew_checksums
from dora.reading import read_text
from dora.robot import loading
from dora.robot.build import write_urdf

ROOT = Path(__file__).parents[1]
PLACES = (ROOT / "objects", ROOT / "robots")
SHIPPED = sorted(folder for place in PLACES for folder in place.iterdir() if folder.is_dir())
KINDS = (".toml", ".ply", ".urdf", ".yaml", ".glb")
"""Endings of the files that have checksums; the others have digests of their own, or are for people."""


def sha256sum(folder: Path, names: str, target: str = SUMS) -> None:
    """What docs/files.md says."""
    subprocess.run(f"sha256sum {names} > {target}", shell=True, check=True, cwd=folder)


def load(folder: Path) -> None:
    """Reads all of a folder that has checksums."""
    if (folder / "robot.toml").exists():
        loading._load.__wrapped__(folder)
        return
    found = read_object_folder(folder)
    if (folder / "articulation.toml").exists():
        load_mount(found)


@pytest.mark.parametrize("place", PLACES, ids=lambda place: place.name)
def test_all_files_that_are_shipped_have_checksums(place: Path):
    check_folder(place)
    files = {p.relative_to(place).as_posix() for p in place.rglob("*") if p.suffix in KINDS}
    assert files
    assert set(listed_checksums(place / SUMS)) == files
    subprocess.run(["sha256sum", "--check", "--quiet", "--strict", SUMS], check=True, cwd=place)


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_another_valid_value_in_a_file_that_is_shipped_is_noticed(folder: Path, tmp_path: Path):
    """A bit of a number, which is a number all the same, and of each mesh; a copy elsewhere may be edited."""
    shutil.copy(folder.parent / SUMS, tmp_path)
    copy = tmp_path / folder.name
    for name in (p.relative_to(folder) for p in sorted(folder.rglob("*")) if p.suffix in KINDS):
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        content = (copy / name).read_bytes()
        (copy / name).write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
        with pytest.raises(InputError, match=rf"{name.name} is not as its checksum in SHA256SUMS says"):
            load(copy)
    (tmp_path / SUMS).unlink()
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    about = next(p for p in (copy / "robot.toml", copy / "object.toml") if p.exists())
    about.write_text(about.read_text() + "# a remark\n")
    load(copy)


@pytest.mark.parametrize("place", [f"things/{SUMS}", SUMS, "things/box.stl.sha256"])
def test_a_file_is_compared_with_the_checksum_that_it_has(tmp_path: Path, place: str):
    folder = tmp_path / "things"
    folder.mkdir()
    for name in ("box.stl", "labels.txt"):
        shutil.copy(ROOT / "objects" / "cube" / "mesh.ply", folder / name)
    above = place == SUMS
    sha256sum(tmp_path if above else folder, "things/*" if above else "box.stl", place.removeprefix("things/"))
    check_file(folder / "box.stl")
    (folder / "box.stl").write_bytes(b"solid changed\nendsolid changed\n")
    with pytest.raises(InputError, match=r"box\.stl is not as its checksum"):
        read_mesh(folder / "box.stl")
    (tmp_path / place).unlink()
    with pytest.raises(InputError, match="holds no triangles"):
        read_mesh(folder / "box.stl")


def test_labels_and_texts_are_compared_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("labels.txt").write_text("handle\n")
    sha256sum(tmp_path, "*.txt")
    assert read_text(Path("labels.txt"), "label file") == "handle\n"
    Path("labels.txt").write_text("hand1e\n")
    for load in (lambda path: read_labels(path, np.zeros((1, 3))), lambda path: read_text(path, "label file")):
        with pytest.raises(InputError, match=r"restore it; if you changed it, write .*SHA256SUMS again by `sha256sum`"):
            load(Path("labels.txt"))


def test_other_lines_and_files_are_left_alone(tmp_path: Path):
    """A folder of downloads has checksums of files that are not there, in other forms, and files without."""
    (tmp_path / "a.txt").write_text("a")
    lines = ["-----BEGIN PGP SIGNED MESSAGE-----", "f" * 40 + "  a.txt", f"SHA256 (a.txt) = {'f' * 64}"]
    lines += [f"{'f' * 64}  absent.txt", f"{'f' * 64}  ../a.txt", f"{'f' * 64}  /etc/hostname", "\xff\x00"]
    (tmp_path / SUMS).write_text("\n".join(lines), "latin-1")
    assert set(listed_checksums(tmp_path / SUMS)) == {"absent.txt"}
    check_file(tmp_path / "a.txt")
    check_file(Path("/etc/hostname"))
    with pytest.raises(InputError, match=r"absent\.txt is missing, and .*SHA256SUMS names it"):
        check_folder(tmp_path)
    (tmp_path / SUMS).unlink()
    (tmp_path / SUMS).mkdir()
    check_file(tmp_path / "a.txt")
    assert listed_checksums(tmp_path / "n" / SUMS) == {}


def test_a_large_file_of_checksums_is_refused(tmp_path: Path):
    (tmp_path / SUMS).write_bytes(b"x" * (MOST_SUMS + 1))
    with pytest.raises(InputError, match="more than 1000000 bytes"):
        check_file(tmp_path / "a.txt")


def test_who_writes_a_folder_anew_renews_its_checksums(tmp_path: Path):
    jug = load_object("jug")
    write_object_folder(jug, tmp_path / "jug")
    assert not (tmp_path / "jug" / SUMS).exists(), "a folder of the user gets none that he did not ask for"
    sha256sum(tmp_path / "jug", "*.toml *.ply")
    write_object_folder(load_object("hammer"), tmp_path / "jug")
    check_folder(tmp_path / "jug")
    assert "solid.ply" not in listed_checksums(tmp_path / "jug" / SUMS)
    assert read_object_folder(tmp_path / "jug").mass != jug.mass


def test_a_robot_written_anew_fits_its_checksums(tmp_path: Path):
    robot = shutil.copytree(ROOT / "robots" / "diana7_hit", tmp_path / "robot")
    names = "*.toml *.urdf *.yaml meshes/*.glb"
    sha256sum(robot, names)
    text = (robot / "parameters.yaml").read_text()
    (robot / "parameters.yaml").write_text(f"{text}# a remark\n")
    with pytest.raises(InputError, match=r"parameters\.yaml is not as its checksum"):
        write_urdf(robot)
    (robot / "robot.urdf").write_text("<robot/>")
    sha256sum(robot, names)
    write_urdf(robot)
    check_folder(robot)
    assert (robot / "robot.urdf").read_bytes() == (ROOT / "robots" / "diana7_hit" / "robot.urdf").read_bytes()
    (robot / SUMS).unlink()
    renew_checksums(robot)
    assert not (robot / SUMS).exists()


def test_a_text_with_a_checksum():
    text = with_checksum("seed: 3\n")
    for whole in (text, text.replace("\n", "\r\n"), "seed: 4\n"):
        check_text(whole, Path("config.yaml"))
    for changed in (text.replace("3\n", "4\n"), f"\n{text}", text[:-1], f"# {text}", text.replace("sha", "shb")):
        with pytest.raises(
            InputError, match=r"config\.yaml is not as it was written, by the checksum in its first line"
        ):
            check_text(changed, Path("config.yaml"))
