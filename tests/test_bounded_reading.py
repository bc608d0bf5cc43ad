"""Files made to be expensive are refused in one sentence, at once and without memory."""

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from boxes import two_regions
from probes import load_results, write_old_result
from refusals import ENTITIES, refused, written

from dora.affordance.maps.packed_maps import COUNT, PART, POINT, unpack
from dora.affordance.objects.folder_reading import read_object_folder
from dora.affordance.objects.importing import read_mesh
from dora.affordance.objects.labels import read_labels
from dora.affordance.views.page import describe
from dora.affordance.views.server import start_server
from dora.agents.reports.report import write_report
from dora.agents.runs.run_folder import RunFolder
from dora.files import read_tensors
from dora.live.recordings import MOST_MEMBERS, Recording
from dora.reading import read_array, read_toml, read_xml, read_yaml
from dora.robot.urdf import read_urdf
from dora.tables import markdown_text

CENTRES = np.zeros((12, 3))
LAUGHS = "regions: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{','.join(['*' + chr(97 + i)] * 10)}]\n" for i in range(9)
)
CURVE = "env_steps,wall_seconds,success_rate,return_mean,penetration_p95_mm"
"""First line of a curve.csv."""
LOOP = '<robot><link name="a"/><joint name="j" type="fixed"><parent link="a"/><child link="a"/></joint></robot>'
"""A URDF of a link that is its own child."""


def npy(kind: str, shape: str, data: bytes = b"") -> bytes:
    header = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (LAUGHS, "more than 100000 values, those of aliases included"),
        ("a: &x [*x]\n", "alias \\*x of what does not stand before it"),
        ("[" * 100_000, "not valid YAML"),
        ("- " * 400_000, "more than 40 levels deep"),
        ("a: &a {x: 1}\n" + "".join(f"b{i}: &b {{<<: *{'ab'[i > 0]}, y{i}: 1}}\n" for i in range(3000)), "aliases"),
        ("x: " + "1_" * 400_000, "not valid YAML"),
        ("x: 2020-01-01", "holds a date"),
        ("x: !!python/object:os.system {}", "not valid YAML"),
        ("x: 1\n" * 200_001, "may have at most 1000000"),
    ],
)
def test_yaml(tmp_path: Path, text: str, words: str):
    with refused(words):
        read_yaml(written(tmp_path / "a.yaml", text), "file of settings")
    with refused(words):
        read_labels(written(tmp_path / "labels.yaml", text), CENTRES)
    with refused(words):
        RunFolder(written(tmp_path / "config.yaml", text).parent).read_config()


def test_an_alias_that_stays_small_is_read(tmp_path: Path):
    assert read_yaml(written(tmp_path / "a.yaml", "a: &x [1, 2]\nb: *x\n"), "file") == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * 200_000, "not valid JSON"),
        ("[" + "[]," * 2_000_000 + "[]]", "more than 1000000 values"),
        ('{"a":' * 60 + "1" + "}" * 60, "more than 40 levels deep"),
        ('["\\ud800"]', "half a character"),
        ("[" + "9" * 6000 + "]", "not valid JSON"),
        ("[" + '["a"],' * 11 + '["a"]]', "give a name or a whole number"),
        ('{"labels": 3, "faces": 4}', "must hold lists"),
    ],
)
def test_json(tmp_path: Path, text: str, words: str):
    with refused(words):
        read_labels(written(tmp_path / "labels.json", text), CENTRES)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a" + ".a" * 400_000 + "=1", "100 dots"),
        ("a=" + "{a=" * 100_000, "not valid TOML"),
        ("a" + ".a" * 60 + "=1", "levels"),
        ("a=2020-01-01", "holds a date"),
    ],
)
def test_toml(tmp_path: Path, text: str, words: str):
    with refused(words):
        read_toml(written(tmp_path / "robot.toml", text), "file")
    with refused(words):
        read_object_folder(written(tmp_path / "object.toml", text).parent)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no intact .npy file"),
        (npy("<f8", "(10000000000000,)"), "declares"),
        (npy("<U100000000", "(12,)"), "declares"),
        (npy("<f8", "(10**13,)"), "no intact"),
        (npy("<f8", "(-1,)", b"\0" * 96), "declares"),
        (npy("|O", "(12,)", b"\0" * 96), "not numbers or texts"),
        (npy("<f8", "(12,)", b"\xff" * 96), "not whole numbers"),
        (npy("<U1", "(12,)", b"\xff" * 48), "no characters"),
        (npy("<U1", "(12,)", struct.pack("<I", 0xD800) * 12), "no characters"),
        (npy("|S1", "(12,)", b"\xff" * 12), "no text"),
        (npy("<i8", "(1000,)", b"\0" * 8000), "1000 labels for the 12 triangles"),
    ],
)
def test_arrays(tmp_path: Path, content: bytes, words: str):
    with refused(words):
        read_labels(written(tmp_path / "labels.npy", content), CENTRES)


def test_an_array_is_read_in_its_order(tmp_path: Path):
    for array in (np.arange(6).reshape(2, 3), np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.array(["a", "bc"])):
        np.save(tmp_path / "a.npy", array)
        assert read_array(tmp_path / "a.npy", "file", 1000).tolist() == array.tolist()


def test_other_huge_files_are_refused_by_their_size(tmp_path: Path):
    readers: dict[str, Callable[[Path], object]] = {
        "labels.npy": lambda path: read_labels(path, CENTRES),
        "labels.txt": lambda path: read_labels(path, CENTRES),
        "object.toml": lambda path: read_object_folder(path.parent),
        "config.yaml": lambda p: RunFolder(p.parent).read_config(),
        "robot.urdf": read_urdf,
        "g.safetensors": lambda path: read_tensors(path, "dora-grasps 1"),
        "result.json": lambda path: write_report(path.parent, path.parent / "out"),
    }
    for name, reader in readers.items():
        with (tmp_path / name).open("wb") as stream:
            stream.truncate(10**11)
        with refused("may have at most", 1.0):
            reader(tmp_path / name)


def test_what_is_no_file_is_refused(tmp_path: Path):
    os.mkfifo(tmp_path / "labels.yaml")
    with refused("There is no label file", 1.0):
        read_labels(tmp_path / "labels.yaml", CENTRES)
    with refused("There is no mesh file"):
        read_mesh(written(tmp_path / "x.stl" / "y", "").parent)
    with refused("There is no"):
        read_yaml(Path("a\0b.yaml"), "file")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f'<?xml version="1.0"?>{ENTITIES}<robot/>', "declares a document type"),
        ("<a>" * 200_000 + "</a>" * 200_000, "40 levels"),
        ("<robot>" + '<link name="a"/>' * 30_000 + "</robot>", "20000 elements"),
        ("<robot>" + "".join(f'<link name="l{i}"/>' for i in range(2000)) + "</robot>", "more than 1000 links"),
        ("<robot/>", "one tree"),
        (LOOP, "one tree"),
        ('<robot><link name="a"/><joint name="j" type="glued"/></robot>', "of the type 'glued'"),
    ],
)
def test_urdf(tmp_path: Path, text: str, words: str):
    with refused(words):
        read_urdf(written(tmp_path / "a.urdf", text))


def test_xml_that_is_small_is_read(tmp_path: Path):
    assert read_xml(written(tmp_path / "a.xml", "<a><b c='1'/></a>"), "file")[0].get("c") == "1"


@pytest.mark.parametrize(
    ("table", "content", "words"),
    [
        ("curve.csv", "a," * 1_000_000, "lacks a column"),
        ("curve.csv", '"' + "x" * 200_000, "damaged"),
        ("curve.csv", f"{CURVE}\n" + "1,1,0,0,0\n" * 20_001, "rows"),
        ("curve.csv", f"{CURVE}\n1,1,0,0\n", "line 2 has 4 cells"),
        ("curve.csv", f"{CURVE}\nnan,1,0,0,0\n", "out of range"),
        ("curve.csv", f"{CURVE}\n1,1,inf,0,0\n", "out of range"),
        ("curve.csv", f"{CURVE}\n2,1,0,0,0\n1,2,0,0,0\n", "fewer than the line before"),
        ("curve.csv", f"{CURVE}\n1,1,7,0,0\n", "not from 0 to 1"),
        ("curve.csv", f"{CURVE}\n1,1,0,0,-2\n", "negative depth"),
        ("eval.csv", "episode,success\n" + "1,1\n" * 20_001, "rows"),
        (
            "eval.csv",
            "episode,success\n" + "".join(f"{k},1\n" for k in range(20)),
            "a share of 1 are successes, and result.json says 0.5",
        ),
        (
            "zero.csv",
            "episode,success\n" + "".join(f"{k},{k % 2}\n" for k in range(6)),
            "it has 6 episodes, and result.json says 20",
        ),
        ("eval.csv", "episode,success\n1,0.5\n", "success is not 0 or 1"),
        ("zero.csv", "episode,success\n1,nan\n", "success is not 0 or 1"),
        ("zero.csv", "episode,win\n1,1\n", "lacks a column"),
        ("progress.csv", "x\n" * 300_000, "lacks a column|more than a report reads"),
        ("progress.csv", "", "lacks a column"),
    ],
)
def test_tables_of_runs(tmp_path: Path, table: str, content: str, words: str):
    write_old_result(tmp_path)
    load_results(tmp_path)
    with refused(words):
        write_report(written(tmp_path / table, content).parent, tmp_path / "out")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("env", 3),
        ("env", ""),
        ("env", "x" * 300),
        ("env_steps", 10**400),
        ("wall_seconds", float("nan")),
        ("wall_seconds", -1.0),
        ("success_rate", 7),
        ("penetration_p95_mm", -0.5),
        ("finished", 1),
        ("success_rate", None),
        ("success_rate", 2),
        ("first_seed", [1]),
        ("stage_rates", {"reach": 2}),
        ("stage_rates", [0.5]),
        ("steps_to_80", 0.5),
        ("raw_success_rate", "all"),
        ("other_load", float("inf")),
        ("task", {"guidance_parts": "abc"}),
        ("task", 1),
    ],
)
def test_results_of_another_type(tmp_path: Path, name: str, value: Any):
    write_old_result(tmp_path)
    result = json.loads((tmp_path / "result.json").read_text())
    with refused("result.json is damaged"):
        load_results(written(tmp_path / "result.json", json.dumps(result | {name: value})).parent)


def test_names_from_files_are_text_in_figures_and_on_pages(tmp_path: Path):
    write_old_result(tmp_path)
    result = json.loads((tmp_path / "result.json").read_text())
    name = "$\\frac{$_<b>[x](y)"
    written(tmp_path / "result.json", json.dumps(result | {"env": name, "guidance": "$x_{$"}))
    table, compared, page, *_ = write_report(tmp_path, tmp_path / "out")
    assert "<b>" not in compared.read_text()
    assert "<b>" not in table.read_text() + page.read_text()
    assert "[x](y)" not in table.read_text()
    assert markdown_text("a\n*b* <i>") == "a \\*b\\* &lt;i&gt;"


def test_names_of_classes_are_text_on_the_page(monkeypatch: pytest.MonkeyPatch):
    from dora.affordance.candidates import GraspCandidates

    zero, grasp = torch.zeros(1, 3), torch.zeros(1, 20)
    candidates = GraspCandidates("box", zero, torch.tensor([[1.0, 0, 0, 0]]), zero, grasp, grasp, ("<b>*A*",),
                                 energy={"<i>": torch.zeros(1)})  # fmt: skip
    assert "<b>" not in describe(candidates, 0)
    assert "<i>" not in describe(candidates, 0)


@pytest.mark.parametrize(
    ("host", "port", "words"), [("127.0.0.1", 70_000, "from 1 to 65535"), ("no host", 8080, "no address")]
)
def test_no_page_without_an_address(host: str, port: int, words: str):
    with refused(words, 10.0):
        start_server(host, port, "page")


def unwritten(group: Any) -> None:
    for k in range(12):
        group.create_dataset(f"env_states/actors/{k}", shape=(1, 9_999_999), dtype="f4")


def huge_chunks(group: Any) -> None:
    for k in range(3):
        group.create_dataset(f"env_states/actors/{k}", shape=(2, 13), maxshape=(None, 13), chunks=(400_000, 13))
        group[f"env_states/actors/{k}"][:] = 0


def repeated(group: Any) -> None:
    group["env_states/0/x"] = np.zeros((1, 1))
    for k in range(7):
        group.create_group(f"env_states/{k + 1}")
        for copy in range(10):
            group[f"env_states/{k + 1}/{copy}"] = group[f"env_states/{k}"]


def inflated(group: Any) -> None:
    """A chunk of 4 kB that unpacks to 500 MB."""
    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(10**7)) for _ in range(50)) + packer.flush()
    data = group.create_dataset("env_states/x", shape=(1000,), chunks=(1000,), dtype="f4", compression="gzip")
    data.id.write_direct_chunk((0,), packed)


def crumbs(group: Any) -> None:
    group.create_dataset("env_states/x", shape=(1, 1_000_000), dtype="f4", chunks=(1, 1))


def other_packing(group: Any) -> None:
    group.create_dataset("env_states/x", data=np.zeros((5, 13)), compression="lzf")


def many(group: Any) -> None:
    for k in range(MOST_MEMBERS + 1):
        group[f"env_states/{k}"] = np.zeros((1, 1))


def endless(group: Any) -> None:
    group.create_group("env_states")
    group["env_states/again"] = group["env_states"]


@pytest.mark.parametrize(
    ("fill", "words"),
    [
        (unwritten, "more than 10000000 numbers"),
        (huge_chunks, "more than 10000000 numbers"),
        (inflated, "unpacks to more than it holds"),
        (crumbs, "more than 10000000 numbers"),
        (other_packing, "another way than by gzip"),
        (repeated, "too many"),
        (many, "too many"),
        (endless, "too deep"),
    ],
)
def test_recordings(tmp_path: Path, fill: Callable[[Any], None], words: str):
    index = {"env_info": {"env_id": "DoraCube-v1"}, "episodes": [{"episode_id": 0}]}
    written(tmp_path / "a.json", json.dumps(index))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("traj_0/actions", data=np.random.default_rng(0).random((30, 7)), compression="gzip")
    assert Recording.open(tmp_path / "a.h5").episode(0).actions.shape == (30, 7)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        fill(file["traj_0"])
    with refused(words):
        Recording.open(tmp_path / "a.h5").episode(0)


def tensors_file(header: bytes, data: bytes = b"") -> bytes:
    return struct.pack("<Q", len(header)) + header + data


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (struct.pack("<Q", 2**62) + b"{}", "size of its header"),
        (tensors_file(b'{"a":' + b"[" * 100_000), "truncated, damaged"),
        (tensors_file(b'{"a":{"dtype":"F32","shape":[1000000000000],"data_offsets":[0,0]}}'), "truncated, damaged"),
        (
            tensors_file(
                b'{"__metadata__":{"format":"dora-grasps 1"},"a":{"dtype":"F32","shape":[0,4611686018427387904],'
                b'"data_offsets":[0,0]}}'
            ),
            "damaged",
        ),
        (tensors_file(b" " * 5_000_000), "size of its header"),
    ],
)
def test_tensors(tmp_path: Path, content: bytes, words: str):
    with refused(words):
        read_tensors(written(tmp_path / "a.safetensors", content), "dora-grasps 1")


def test_maps_that_unpack_to_too_much():
    empty = torch.zeros(0, dtype=torch.int32)
    packed = {COUNT: torch.zeros(1000, dtype=torch.int32), POINT: empty, PART: empty.byte()}
    with refused("more than 268435456 together"):
        unpack(packed, 1000, 2**20, "a file")


def test_an_object_of_two_regions_is_not_refused(tmp_path: Path):
    """The bounds leave room for what is small."""
    box = two_regions()
    box.mesh.export(tmp_path / "a.glb")
    assert len(read_mesh(tmp_path / "a.glb")[0].faces) == len(box.mesh.faces)
