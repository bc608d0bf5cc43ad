"""Checksums of files that people write: what `sha256sum` wrote is compared, and all that is shipped has them."""

import dataclasses
import shutil
import subprocess
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import sapien

from dora.affordance.objects.articulation import load_mount
from dora.affordance.objects.catalogue import load_object
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.folder_writing import write_object_folder
from dora.affordance.objects.importing import read_mesh
from dora.affordance.objects.labels import read_labels
from dora.digests import (
    MOST_SUMS,
    SUMS,
    check_file,
    check_folder,
    check_text,
    file_sha256,
    listed_checksums,
    with_checksum,
)
from dora.errors import InputError
from dora.files import renew_checksums
from dora.robot import loading
from dora.robot.build import write_urdf
from dora.sim.grasp_tests.floating_hand import _hand_builder
from dora.sim.robots import register_robot
from dora.tasks.hammer.finger_motion import read_motion

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
        loading.load_robot(folder)
        return
    found = read_object_folder(folder)
    if (folder / "articulation.toml").exists():
        load_mount(found)
    if (folder / "turning.toml").exists():
        read_motion(folder / "turning.toml")


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
        with pytest.raises(InputError, match=rf"{name.name} is not as its checksum in .*SHA256SUMS says"):
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


def test_labels_are_compared_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    Path("labels.txt").write_text("handle\n")
    sha256sum(tmp_path, "*.txt")
    assert read_labels(Path("labels.txt"), np.zeros((1, 3))).names == ("handle",)
    Path("labels.txt").write_text("hand1e\n")
    with pytest.raises(InputError, match=r"checksum in .*SHA256SUMS says, .* write its checksum again by `sha256sum`"):
        read_labels(Path("labels.txt"), np.zeros((1, 3)))


FORMS = {
    "sha256sum": "{sum}  a.txt\n", "binary": "{sum} *a.txt\n", "tag": "SHA256 (a.txt) = {sum}\n", "bare": "{sum}",
    "from elsewhere": "{sum}  /home/me/a.txt\n", "of Windows": "\ufeff{sum}  ./a.txt\r\n", "capitals": "{SUM}  a.txt\n",
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_checksum_of_one_file_has_any_usual_form(tmp_path: Path, form: str):
    path = tmp_path / "a.txt"
    path.write_text("a")
    checksum = file_sha256(path)
    (tmp_path / "a.txt.sha256").write_text(form.format(sum=checksum, SUM=checksum.upper()), newline="")
    check_file(path)
    path.write_text("b")
    with pytest.raises(InputError, match=r"a\.txt is not as its checksum in .*a\.txt\.sha256 says"):
        check_file(path)
    renew_checksums([path])
    check_file(path)
    (tmp_path / "a.txt.sha256").write_text("")
    with pytest.raises(
        InputError, match=r"a\.txt\.sha256 has no checksum of a\.txt: write it again by `sha256sum a\.txt"
    ):
        check_file(path)


def test_other_lines_and_files_are_left_alone(tmp_path: Path):
    """A folder of downloads has checksums of files that are not there, in other forms, and files without."""
    (tmp_path / "a.txt").write_text("a")
    lines = ["-----BEGIN PGP SIGNED MESSAGE-----", "f" * 40 + "  a.txt", f"SHA1 (a.txt) = {'f' * 40}", "\xff\x00"]
    lines += [f"{'f' * 64}  {name}" for name in ("absent.txt", "../a.txt", "/etc/hostname", SUMS, "a.txt\x85", "\xe9")]
    (tmp_path / SUMS).write_text("\n".join(lines), "latin-1")
    assert set(listed_checksums(tmp_path / SUMS)) == {"absent.txt", "a.txt\udc85", "\udce9"}
    for path in (tmp_path / "a.txt", Path("/etc/hostname")):
        check_file(path)
    with pytest.raises(InputError, match=r"absent\.txt is missing, and .*SHA256SUMS names it"):
        check_folder(tmp_path)
    (tmp_path / "absent.txt").write_text("b")
    renew_checksums([tmp_path / "absent.txt"])
    wanted = [
        line.replace("f" * 64, file_sha256(tmp_path / "absent.txt")) if "absent" in line else line for line in lines
    ]
    assert (tmp_path / SUMS).read_text("latin-1").split("\n") == wanted
    (tmp_path / SUMS).unlink()
    (tmp_path / SUMS).mkdir()
    check_file(tmp_path / "a.txt")
    assert listed_checksums(tmp_path / "n" / SUMS) == {}


def test_a_large_file_of_checksums_is_refused_where_it_belongs(tmp_path: Path):
    """Not in folders below, where it may be of something else."""
    (tmp_path / SUMS).write_bytes(b"x" * (MOST_SUMS + 1))
    (tmp_path / "below").mkdir()
    for path in (tmp_path / "a.txt", tmp_path / "below" / "a.txt"):
        path.write_text("a")
    check_file(tmp_path / "below" / "a.txt")
    check_folder(tmp_path / "below")
    with pytest.raises(InputError, match="a file of checksums may have at most 1000000"):
        check_file(tmp_path / "a.txt")


def test_many_checksums_take_no_time(tmp_path: Path):
    for number in range(3000):
        (tmp_path / f"{number}.txt").write_text("a")
    (tmp_path / SUMS).write_text("".join(f"{file_sha256(tmp_path / '0.txt')}  {n}.txt\n" for n in range(3000)))
    start = time.perf_counter()
    check_folder(tmp_path)
    assert time.perf_counter() - start < 2


def test_who_writes_a_folder_anew_renews_its_checksums(tmp_path: Path):
    jug, folder = load_object("jug"), tmp_path / "jug"
    write_object_folder(jug, folder)
    assert not (folder / SUMS).exists(), "a folder of the user gets none that he did not ask for"
    sha256sum(folder, "*.toml *.ply")
    write_object_folder(load_object("hammer"), folder)
    check_folder(folder)
    assert set(listed_checksums(folder / SUMS)) == {"object.toml", *(path.name for path in folder.glob("*.ply"))}
    subprocess.run(["sha256sum", "--check", "--quiet", "--strict", SUMS], check=True, cwd=folder)
    assert read_object_folder(folder).mass != jug.mass


def test_who_writes_a_file_vouches_for_no_other(tmp_path: Path):
    robot = shutil.copytree(ROOT / "robots" / "diana7_hit", tmp_path / "robot")
    (robot / "robot.urdf").write_text("<robot/>")
    sha256sum(tmp_path, "robot/*.toml robot/*.urdf robot/*.yaml robot/meshes/*.glb")
    (robot / "robot.toml").write_text(
        (robot / "robot.toml").read_text().replace("tip_radius = 0.0", "tip_radius = 0.00")
    )
    write_urdf(robot)
    check_file(robot / "robot.urdf")
    assert (robot / "robot.urdf").read_bytes() == (ROOT / "robots" / "diana7_hit" / "robot.urdf").read_bytes()
    with pytest.raises(InputError, match=r"robot\.toml is not as its checksum"):
        loading.load_robot(robot)
    (robot / "parameters.yaml").write_text(f"{(robot / 'parameters.yaml').read_text()}# a remark\n")
    with pytest.raises(InputError, match=r"parameters\.yaml is not as its checksum"):
        write_urdf(robot)
    shutil.rmtree(tmp_path / "robot" / "meshes")
    (tmp_path / SUMS).unlink()
    write_urdf(robot)
    assert not list(tmp_path.rglob(f"{SUMS}*"))


def test_a_robot_is_compared_whenever_it_is_used(tmp_path: Path):
    """It is described once per process, and the simulator reads its files for every environment."""
    robot = shutil.copytree(ROOT / "robots" / "diana7_hit", tmp_path / "robot")
    sha256sum(robot, "*.toml *.urdf meshes/*.glb")
    description = loading.load_robot(robot)
    (robot / "robot.urdf").write_text((robot / "robot.urdf").read_text().replace("mass value=", "mass  value=", 1))
    for use in (lambda: loading.load_robot(robot), lambda: _hand_builder(sapien.Scene([]), description)):
        with pytest.raises(InputError, match=r"robot\.urdf is not as its checksum"):
            use()


def test_a_robots_own_file_of_one_checksum_is_compared(tmp_path: Path):
    robot = shutil.copytree(ROOT / "robots" / "diana7_hit", tmp_path / "robot")
    sha256sum(robot, "robot.toml", "robot.toml.sha256")
    (robot / "robot.toml").write_text((robot / "robot.toml").read_text() + "# a remark\n")
    with pytest.raises(InputError, match=r"robot\.toml is not as its checksum in .*robot\.toml\.sha256 says"):
        loading.load_robot(robot)


def test_a_task_compares_its_robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A process may live for days; the robot's description is of its start."""
    robot = shutil.copytree(ROOT / "robots" / "diana7_hit", tmp_path / "robot")
    sha256sum(robot, "*.toml *.urdf meshes/*.glb")
    (robot / "meshes" / "palm.glb").write_bytes(b"glTF")
    cls = register_robot("diana7_hit")
    monkeypatch.setattr(cls, "description", dataclasses.replace(cls.description, folder=robot))
    with pytest.raises(InputError, match=r"palm\.glb is not as its checksum"):
        gym.make("DoraCube-v1")


def test_a_text_with_a_checksum():
    text = with_checksum("seed: 3\n")
    for whole in (text, text.replace("\n", "\r\n"), "seed: 4\n"):
        check_text(whole, Path("config.yaml"))
    check_text("# my best one\nseed: 3\n", Path("config.yaml"))
    for changed in (text.replace("3\n", "4\n"), f"\n{text}", text[:-1], f"# {text}", text.replace("sha", "shb")):
        with pytest.raises(
            InputError, match=r"config\.yaml is not as it was written, by the checksum in its first line"
        ):
            check_text(changed, Path("config.yaml"))
