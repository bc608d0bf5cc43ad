"""Files: what was written is read, and nothing else is; a write replaces a file wholly or not at all."""

import os
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from dora.errors import InputError
from dora.files import (
    METADATA,
    read_safetensors,
    read_tensors,
    stored_or_made,
    write_bytes,
    write_csv,
    write_safetensors,
    write_tensors,
)

KIND = "dora-test 1"
TENSORS = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([True, False])}
NOTE = {"name": "x", "count": 3}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    target = tmp_path / "file.safetensors"
    write_tensors(target, KIND, TENSORS, NOTE)
    return target


def test_tensors_and_metadata_come_back(path: Path):
    tensors, note = read_tensors(path, KIND)
    assert note == NOTE
    assert set(tensors) == set(TENSORS)
    assert all(torch.equal(tensors[name], TENSORS[name]) for name in TENSORS)


@pytest.mark.parametrize("kind", ["dora-test 2", "dora-other 1"])
def test_another_version_or_format_is_refused(path: Path, kind: str):
    with pytest.raises(InputError, match="make it again"):
        read_tensors(path, kind)


@pytest.mark.parametrize("wrong", ["format", "version"])
def test_each_required_entry_of_a_header_counts(tmp_path: Path, wrong: str):
    """One wrong entry is enough, whichever it is."""
    required, path = {"format": "dora-test", "version": "1"}, tmp_path / "two.safetensors"
    write_safetensors(path, TENSORS, {**required, wrong: "another"})
    with pytest.raises(InputError, match="make it again"):
        read_safetensors(path, "test file", {k: (v,) for k, v in required.items()})


def test_every_damaged_byte_is_found(path: Path):
    content = path.read_bytes()
    for place in range(0, len(content), 7):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        with pytest.raises(InputError):
            read_tensors(path, KIND)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_file_is_refused(path: Path, share: float):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"file\.safetensors"):
        read_tensors(path, KIND)


def test_a_file_without_digest_is_refused(tmp_path: Path):
    save_file(TENSORS, tmp_path / "f.safetensors", metadata={"format": KIND, METADATA: "{}"})
    with pytest.raises(InputError, match="digest"):
        read_tensors(tmp_path / "f.safetensors", KIND)


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"no test file .*nothing\.safetensors"):
        read_safetensors(tmp_path / "nothing.safetensors", "test file", {})


def test_a_failed_write_keeps_the_former_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "kept"
    write_bytes(path, b"former")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("dora.files.os.fsync", full)
    with pytest.raises(InputError, match="No space left"):
        write_bytes(path, b"new")
    assert path.read_bytes() == b"former"
    assert [p.name for p in tmp_path.iterdir()] == ["kept"]


@pytest.mark.parametrize("limit", ["MOST_BYTES", "MOST_HEADER"])
def test_what_could_not_be_read_again_is_not_written(path: Path, limit: str, monkeypatch: pytest.MonkeyPatch):
    before = path.read_bytes()
    monkeypatch.setattr(f"dora.files.{limit}", 100)
    with pytest.raises(InputError, match=r"file\.safetensors would have .* at most 100 can be read again"):
        write_tensors(path, KIND, TENSORS, NOTE)
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_file_may_be_as_large_as_can_be_read_and_no_larger(path: Path, monkeypatch: pytest.MonkeyPatch):
    size = path.stat().st_size
    monkeypatch.setattr("dora.files.MOST_BYTES", size)
    write_tensors(path, KIND, TENSORS, NOTE)
    assert path.stat().st_size == size
    monkeypatch.setattr("dora.files.MOST_BYTES", size - 1)
    with pytest.raises(InputError, match=f"would have {size} bytes; at most {size - 1}"):
        write_tensors(path, KIND, TENSORS, NOTE)


def test_a_file_can_be_read_by_others(tmp_path: Path):
    write_csv(tmp_path / "t.csv", ["a", "b"], [[1, 0.12345678], ["x", 2.0]])
    assert (tmp_path / "t.csv").read_text() == "a,b\n1,0.123457\nx,2\n"
    assert (tmp_path / "t.csv").stat().st_mode & 0o777 == 0o644


def test_what_a_killed_process_left_half_written_in_a_cache_is_removed(tmp_path: Path):
    """Not what another process may be writing, nor what belongs to another file."""
    path = tmp_path / "found[1].json"
    old, new, other = (
        tmp_path / name for name in (f".{path.name}.aaaaaaaa", f".{path.name}.bbbbbbbb", ".x.json.cccccccc")
    )
    for half in (old, new, other):
        half.touch()
    for half in (old, other):
        os.utime(half, (0, 0))
    assert stored_or_made(path, Path.read_bytes, lambda: b"made", write_bytes) == b"made"
    assert sorted(tmp_path.iterdir()) == sorted([path, new, other])
