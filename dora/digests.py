"""Digests of settings and data: sha256 of values under stable keys, independent of the names of their classes.

And checksums of files that people write, as `sha256sum` writes them: `SHA256SUMS` in the folder of a file or in one of
the two above, and `NAME.sha256` beside it.
"""

import dataclasses
import hashlib
import json
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dora.errors import InputError
from dora.reading import read_bytes

KEY = "digest_key"
"""Key of a field's metadata whose value replaces the field's name in digests, so that it can be renamed."""

SEAL = "digest"
"""Entry of a JSON object that holds the digest of its other entries."""

SUMS, OWN_SUM = "SHA256SUMS", ".sha256"
"""Name of a file with the checksums of several files, and ending of the file with that of one file."""
MOST_SUMS = 1_000_000
"""Size of a file of checksums above which it is not read [bytes]."""
DEPTH = 3
"""Folders in which the checksum of a file is looked for: its own, and those above."""
LINE = re.compile(r"([0-9a-fA-F]{64}) [ *](.+)|SHA256 \((.+)\) = ([0-9a-fA-F]{64})")
"""A line of checksums, as of `sha256sum` or of `sha256sum --tag`."""
BARE = re.compile(r"[0-9a-fA-F]{64}")
"""The line of a file that has nothing but the checksum."""
HEAD = "# sha256 of the lines below: "
"""First line of a text with a checksum, without the checksum."""
HEADED = re.compile(r"#.*(sha256|[0-9a-fA-F]{16})")
"""A first line that is one with a checksum, maybe a damaged one."""


def digest_of(value: Any) -> str:
    """sha256, in hexadecimal, of a value.

    A dataclass counts as the mapping of its fields: the name of the class does not matter, and a field that has been
    renamed keeps its old key by `field(metadata={KEY: "old_name"})`. The order of mappings and sets does not matter.

    Args:
        value: None, bool, int, float, str, bytes, NumPy array or CPU tensor, or a dataclass, mapping, sequence or set
            of these.

    Raises:
        TypeError: a value of another type.
    """
    digest = hashlib.sha256()
    _feed(digest, value)
    return digest.hexdigest()


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """What JSON keeps of a mapping, with a digest by which `is_whole` finds any change."""
    entries: dict[str, Any] = {name: value for name, value in json.loads(json.dumps(content)).items() if name != SEAL}
    return entries | {SEAL: digest_of(entries)}


def is_whole(content: Mapping[str, Any]) -> bool:
    """Whether a mapping that `sealed` made is as it was made."""
    return content.get(SEAL) == digest_of({name: value for name, value in content.items() if name != SEAL})


def with_checksum(text: str) -> str:
    """A text with its checksum in a line before it, see `check_text`."""
    return f"{HEAD}{hashlib.sha256(text.encode()).hexdigest()}\n{text}"


def check_text(text: str, path: Path) -> None:
    """Refuse a text that `with_checksum` made and that was changed since; one that begins with no checksum passes.

    Args:
        text: to check; the ends of its lines may be those of another system.
        path: of its file, for the message.

    Raises:
        InputError: it was changed.
    """
    text = text.replace("\r\n", "\n")
    first = text.lstrip("\ufeff\0 \t\n").partition("\n")[0]
    if HEADED.match(first) and text != with_checksum(text.partition("\n")[2]):
        raise InputError(
            f"{path} is not as it was written, by the checksum in its first line: restore it, or remove that line to "
            "use it as it is."
        )


def check_file(path: Path) -> None:
    """Refuse a file that is not as its checksums say, if there are any (docs/files.md).

    Raises:
        InputError: it was damaged or changed, or a file of checksums beside it cannot be read.
    """
    path = Path(os.path.abspath(path))
    own = path.parent / (path.name + OWN_SUM)
    if os.path.isfile(own):
        _compare(path, _own_checksum(own, path.name), own)
    for place in path.parents[:DEPTH]:
        expected = listed_checksums(place / SUMS, place == path.parent).get(path.relative_to(place).as_posix())
        if expected is not None:
            _compare(path, expected, place / SUMS)


def check_folder(folder: Path) -> None:
    """Check all files in a folder that `SHA256SUMS` names, as `sha256sum --check` does; see `check_file`.

    Raises:
        InputError: one is missing, was damaged or changed, or cannot be read.
    """
    folder = Path(os.path.abspath(folder))
    for place in (folder, *folder.parents)[:DEPTH]:
        for name, expected in listed_checksums(place / SUMS, place == folder).items():
            if (place / name).is_relative_to(folder):
                _compare(place / name, expected, place / SUMS)


def listed_checksums(sums: Path, near: bool = True) -> dict[str, str]:
    """The checksums in a file, by the path of what they are of, from its folder; none if there is no such file.

    Args:
        sums: path of the file.
        near: whether it has to be readable; one in a folder above may belong to something else.

    Raises:
        InputError: it is too large or cannot be read.
    """
    if not os.path.isfile(sums):
        return {}
    try:
        lines = lines_of_checksums(sums)
    except InputError:
        if near:
            raise
        return {}
    found = dict(line for line in map(parsed_checksum, lines) if line)
    return {name: found[name] for name in found if not name.startswith((os.sep, os.pardir)) and Path(name).name != SUMS}


def lines_of_checksums(sums: Path) -> list[str]:
    """The lines of a file of checksums, in which bytes that are no UTF-8 stand as `os.fsdecode` makes them.

    Raises:
        InputError: it is too large or cannot be read.
    """
    return os.fsdecode(read_bytes(sums, "file of checksums", MOST_SUMS)).split("\n")


def parsed_checksum(line: str) -> tuple[str, str] | None:
    """Path and checksum in a line; None for another one."""
    found = LINE.fullmatch(line.strip("\ufeff\r"))
    return (os.path.normpath(found[2] or found[3]), (found[1] or found[4]).lower()) if found else None


def file_sha256(path: Path) -> str:
    """sha256, in hexadecimal, of a file.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): check its permissions.") from error


def _own_checksum(own: Path, name: str) -> str:
    """The checksum in a file that has that of one file; InputError if it has none."""
    for line in lines_of_checksums(own):
        if BARE.fullmatch(line.strip("\ufeff\r ")):
            return line.strip("\ufeff\r ").lower()
        path, checksum = parsed_checksum(line) or ("", "")
        if Path(path).name == name:
            return checksum
    raise InputError(f"{own} has no checksum of {name}: write it again by `sha256sum {name} > {own.name}`.")


def _compare(path: Path, expected: str, sums: Path) -> None:
    """Refuse a file that is missing or has another checksum."""
    if not os.path.isfile(path):
        raise InputError(f"{path} is missing, and {sums} names it: restore it, or remove that line.")
    if file_sha256(path) != expected:
        raise InputError(
            f"{path} is not as its checksum in {sums} says, so it was damaged or changed: restore it; if you changed "
            "it yourself, write its checksum again by `sha256sum`, or remove that."
        )


def _array_of(value: Any) -> np.ndarray | None:
    """The numbers of a tensor of PyTorch, which is loaded where there are any; None for another value."""
    torch = sys.modules.get("torch")
    return value.detach().numpy() if torch is not None and isinstance(value, torch.Tensor) else None


def _feed(digest: Any, value: Any) -> None:
    """Adds a value, preceded by its kind and length, so that different values give different bytes."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        _feed(digest, {f.metadata.get(KEY, f.name): getattr(value, f.name) for f in fields})
    elif isinstance(value, Mapping):
        _head(digest, "mapping", len(value))
        for key in sorted(value):
            _feed(digest, key)
            _feed(digest, value[key])
    elif isinstance(value, set | frozenset):
        _feed(digest, sorted(value))
    elif isinstance(value, list | tuple):
        _head(digest, "sequence", len(value))
        for item in value:
            _feed(digest, item)
    elif (array := _array_of(value)) is not None:
        _feed(digest, array)
    elif isinstance(value, np.ndarray):
        _feed(digest, [str(value.dtype), list(value.shape), np.ascontiguousarray(value).tobytes()])
    elif isinstance(value, bytes):
        _head(digest, "bytes", len(value))
        digest.update(value)
    elif value is None or isinstance(value, bool | int | float | str):
        text = f"{type(value).__name__} {value!a}".encode()  # `repr` differs between versions of Unicode
        _head(digest, "scalar", len(text))
        digest.update(text)
    else:
        raise TypeError(f"a {type(value).__name__} cannot be part of a digest")


def _head(digest: Any, kind: str, length: int) -> None:
    digest.update(f"{kind} {length}\n".encode())
