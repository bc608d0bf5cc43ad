"""Files that are written and checked: checksums that follow, headers that are too large, caches, and configurations."""

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from dora.configs import check_finite, check_not_negative, check_ranges, flat, overridden, plain
from dora.digests import SEAL, SUMS, check_file, check_folder, digest_of, is_whole, parsed_checksum, sealed
from dora.errors import InputError
from dora.files import (
    LEFT_SECONDS,
    METADATA,
    check_name,
    check_new_name,
    make_folder,
    read_safetensors,
    renew_checksums,
    stored_or_made,
    write_bytes,
    write_json,
    write_safetensors,
)


def sha(content: str) -> str:
    return hashlib.sha256(content.encode()).hexdigest()


def test_checksums_follow_what_is_written_and_removed(tmp_path: Path):
    below = tmp_path / "a" / "b" / "c"
    below.mkdir(parents=True)
    for place, name in ((tmp_path / "a", "b/c/x"), (tmp_path, "a/b/c/x"), (below, "x")):
        (place / SUMS).write_text(f"# head\n{'0' * 64}  {name}\n{'1' * 64}  other\n")
    (below / "x").write_text("new")
    (below / "x.sha256").write_text("0" * 64)
    renew_checksums([below / "x"])
    assert (below / SUMS).read_text() == f"# head\n{sha('new')}  x\n{'1' * 64}  other\n"
    assert (tmp_path / "a" / SUMS).read_text() == f"# head\n{sha('new')}  b/c/x\n{'1' * 64}  other\n"
    assert "0" * 64 in (tmp_path / SUMS).read_text(), "checksums are looked for in two folders above, no further"
    assert (below / "x.sha256").read_text() == f"{sha('new')}  x\n"
    check_file(below / "x")
    (below / "y").write_text("beside")
    renew_checksums([below / "y"], [below / "x"])
    assert (below / SUMS).read_text() == f"# head\n{'1' * 64}  other\n{sha('beside')}  y\n"
    assert (tmp_path / "a" / SUMS).read_text() == f"# head\n{'1' * 64}  other\n"
    assert not (below / "x.sha256").exists()


def test_a_name_that_is_listed_twice_gets_one_line_where_the_first_was(tmp_path: Path):
    (tmp_path / "x").write_text("new")
    (tmp_path / SUMS).write_text(f"{'1' * 64}  a\n{'0' * 64}  x\n{'2' * 64}  b\n{'0' * 64}  ./x")
    renew_checksums([tmp_path / "x"])
    assert (tmp_path / SUMS).read_text() == f"{'1' * 64}  a\n{sha('new')}  x\n{'2' * 64}  b"
    (tmp_path / "y").write_text("y")
    renew_checksums([tmp_path / "y"])  # the last line has no end
    assert (tmp_path / SUMS).read_text().splitlines()[-1] == f"{sha('y')}  y"


def test_a_folder_is_checked_with_the_checksums_of_two_folders_above(tmp_path: Path):
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    (folder / "x").write_text("x")
    (tmp_path / "a" / "beside").write_text("changed")
    (tmp_path / SUMS).write_text(f"{sha('x')}  a/b/x\n{sha('y')}  a/beside\n")
    check_folder(folder)
    (folder / "x").write_text("z")
    with pytest.raises(InputError, match="x is not as its checksum"):
        check_folder(folder)


@pytest.mark.parametrize("line", ["", f"{'a' * 63}  x", f"{'a' * 64} x", f"MD5 (x) = {'a' * 32}", "# remark"])
def test_other_lines_are_no_checksums(line: str):
    assert parsed_checksum(line) is None
    assert parsed_checksum(f"SHA256 (a/../x) = {'A' * 64}") == ("x", "a" * 64)


def test_a_seal_finds_every_change():
    content = sealed({"a": (1, 2), SEAL: "of before"})
    assert content["a"] == [1, 2]
    assert is_whole(content)
    assert not is_whole(content | {"a": [1, 3]})
    assert not is_whole({"a": [1, 2]})


def test_digests_are_those_that_are_stored():
    """Written down, so that files of today can be read tomorrow."""
    assert digest_of({"a": [1, 2.5, None, True, "x"], "b": b"y"}) == (
        hashlib.sha256(
            b"mapping 2\nscalar 7\nstr 'a'sequence 5\nscalar 5\nint 1scalar 9\nfloat 2.5scalar 13\nNoneType None"
            b"scalar 9\nbool Truescalar 7\nstr 'x'scalar 7\nstr 'b'bytes 1\ny"
        ).hexdigest()
    )
    assert digest_of({3, 1}) == digest_of(frozenset({1, 3})) == digest_of([1, 3]) == digest_of((1, 3))
    array = np.arange(6.0).reshape(2, 3)
    assert digest_of(array.T) == digest_of(np.ascontiguousarray(array.T)) != digest_of(array)
    assert digest_of(torch.ones(2, requires_grad=True)) == digest_of(np.ones(2, np.float32))
    with pytest.raises(TypeError, match="a type cannot"):
        digest_of(Plain)


# ------------------------------------------------------------ files


def test_a_header_may_be_as_large_as_can_be_read_and_no_larger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, tensors = tmp_path / "x.safetensors", {"a": torch.zeros(3)}
    write_safetensors(path, tensors, {"format": "x"})
    size = 8 + int.from_bytes(path.read_bytes()[:8], "little")
    monkeypatch.setattr("dora.files.MOST_HEADER", size)
    write_safetensors(path, tensors, {"format": "x"})
    assert torch.equal(read_safetensors(path, "file", {})[0]["a"], torch.zeros(3))
    monkeypatch.setattr("dora.files.MOST_HEADER", size - 9)
    with pytest.raises(InputError, match=f"a header of {size} bytes; at most {size - 9}"):
        write_safetensors(path, tensors, {"format": "x"})
    with pytest.raises(InputError, match="the size of its header is wrong"):
        read_safetensors(path, "file", {})


def test_a_file_of_the_first_format_is_read_by_its_own_digest(tmp_path: Path):
    """sha256 of the metadata and of names, types, shapes and values of the tensors."""
    path, values = tmp_path / "x.safetensors", {"b": torch.tensor([1.5, 2.0]), "a": torch.tensor([[1], [2]])}
    content = b"{}" + b"a torch.int64 (2, 1)" + values["a"].numpy().tobytes()
    content += b"b torch.float32 (2,)" + values["b"].numpy().tobytes()
    digest = hashlib.sha256(content).hexdigest()
    save_file(values, path, metadata={"format": "x", METADATA: "{}", "sha256": digest})
    tensors, header = read_safetensors(path, "file", {"format": ("x",)})
    assert torch.equal(tensors["a"], values["a"])
    assert header["sha256"] == digest
    save_file(values | {"b": torch.tensor([1.5, 2.5])}, path, metadata={METADATA: "{}", "sha256": digest})
    with pytest.raises(InputError, match="its digest differs"):
        read_safetensors(path, "file", {})


def test_a_cache_is_read_if_it_is_intact_and_made_again_if_not(tmp_path: Path):
    path, saved = tmp_path / "new" / "found", []

    def load(where: Path) -> str:
        if where.read_text() == "damaged":
            raise InputError("it is damaged.")
        return where.read_text()

    def save(where: Path, content: str) -> None:
        saved.append(content)
        where.write_text(content)

    assert stored_or_made(path, load, lambda: "made", save) == "made"
    assert stored_or_made(path, load, lambda: "another", save) == "made"
    path.write_text("damaged")
    assert stored_or_made(path, load, lambda: "again", save) == "again"
    assert saved == ["made", "again"]


def test_what_is_half_written_has_an_hour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path, halves = tmp_path / "x", {age: tmp_path / f".x.{age}" for age in (LEFT_SECONDS - 5, LEFT_SECONDS + 5)}
    monkeypatch.setattr("dora.files.time", SimpleNamespace(time=lambda: 1_000_000.0))
    for age, half in halves.items():
        half.touch()
        os.utime(half, (1_000_000.0 - age, 1_000_000.0 - age))
    stored_or_made(path, Path.read_bytes, lambda: b"made", write_bytes)
    assert [half.exists() for half in halves.values()] == [True, False]


def test_a_name_at_which_nothing_can_be_made_is_refused(tmp_path: Path):
    check_new_name(tmp_path / "new")
    wrong = {
        tmp_path: "exists already", tmp_path / ("x" * 300): "cannot be made", tmp_path / "a\0b": "cannot be made",
        Path(os.fsdecode(b"\xff")): "is not in UTF-8",
    }  # fmt: skip
    for path, words in wrong.items():
        with pytest.raises(InputError, match=words):
            check_new_name(path)
    check_name(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="Cannot make the folder"):
        make_folder(tmp_path / "file" / "below")
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    write_json(tmp_path / "x.json", {"a": [1]})
    assert (tmp_path / "x.json").read_text() == json.dumps({"a": [1]}, indent=2) + "\n"


# ------------------------------------------------------------ configurations


@dataclass(frozen=True)
class Plain:
    """Numbers of several kinds."""

    rate: float | None = 0.5
    sizes: tuple[Any, ...] = (1, 2.0)
    quick: bool = False


def test_settings_are_named_as_on_the_command_line():
    assert list(flat({"a": 1, "b": {"c": 2, "d": {"e": 3}}})) == [("a", 1), ("b.c", 2), ("b.d.e", 3)]
    assert plain(Plain(sizes=(Plain(), (1, [2])))) == {
        "rate": 0.5, "sizes": [{"rate": 0.5, "sizes": [1, 2.0], "quick": False}, [1, [2]]], "quick": False
    }  # fmt: skip


def test_a_whole_number_stands_for_a_float_unless_it_is_too_large_for_one():
    assert str(overridden(Plain(), {"rate": -3}, "config").rate) == "-3.0"
    for wrong in (True, "far"):
        with pytest.raises(InputError, match="rate"):
            overridden(Plain(), {"rate": wrong}, "config")
    for large in (10**301, -(10**301), 10**400):
        with pytest.raises(InputError, match=r"config\.rate is .* finite number"):
            check_finite(overridden(Plain(), {"rate": large}, "config"), "config")
    assert overridden(Plain(rate=None), {"rate": 10**300}, "config").rate == 1e300
    assert overridden(Plain(), {"quick": True}, "config").quick is True


def test_ranges_hold_their_ends_and_refuse_what_is_beyond_or_no_number():
    def check(**given: Any) -> None:
        check_ranges(SimpleNamespace(**given), {"n": (1, 3)}, lambda name: f"--{name}")

    for fine in ({"n": 1}, {"n": 3}, {"n": None}, {}):
        check(**fine)
    for wrong in (0.99, 3.01, float("nan")):
        with pytest.raises(InputError, match=f"--n is {wrong} and has to be from 1 to 3"):
            check(n=wrong)


@pytest.mark.parametrize("value", [1e12, -1e12, float("nan"), float("inf"), 10**12])
def test_numbers_are_finite_and_small_wherever_they_stand(value: float):
    for config in (Plain(rate=value), Plain(sizes=(1, (value,))), Plain(sizes=(Plain(rate=value),))):
        with pytest.raises(InputError, match="has to be a finite number below 1e\\+12"):
            check_finite(config, "config")
    check_finite(Plain(rate=-9e11, sizes=("x", None, True, -5)), "config")


def test_a_field_is_not_negative_where_that_makes_no_sense():
    for fine in (Plain(rate=0.0), Plain(rate=None, sizes=(-1,)), Plain(quick=True)):
        check_not_negative(fine, "config")
    with pytest.raises(InputError, match=r"config\.rate is -0\.5; it cannot be negative"):
        check_not_negative(Plain(rate=-0.5), "config")
