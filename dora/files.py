"""Atomic writing of files, and safetensors files with a digest of the whole file that detects any damage."""

import contextlib
import csv
import glob
import hashlib
import io
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from dora.digests import DEPTH, OWN_SUM, SUMS, file_sha256, lines_of_checksums, listed_checksums, parsed_checksum
from dora.errors import InputError, shown
from dora.reading import check_size, parse_json

METADATA = "metadata"
"""Entry of a file's header with the metadata of `write_tensors`."""
WHOLE = "file_sha256"
"""Entry of a header with the sha256 of the whole file, in which this entry's digits are zeros."""
FIRST = "sha256"
"""The same entry in files of the first format: sha256 of the tensors and `METADATA`, not of the rest of the header."""
ZEROS = "0" * 64
"""What stands for the digits of the digest while it is computed."""
FRAMES_OF_ROUNDING = 1.5
"""Frames that the length of a film, which is told in hundredths of a second, may lack [1]."""
MOST_BYTES = 2**29
"""Size of a safetensors file above which it is not read [bytes]."""
MOST_HEADER = 4_000_000
"""Size of the header of a safetensors file above which it is not read [bytes]."""
LEFT_SECONDS = 3600.0
"""Age above which a file of a cache that is still half written has no writer any more [s]."""
CHUNK = 2**20
"""Size of the pieces in which a file's digest is computed [bytes]."""

Content = TypeVar("Content")
"""What a file of a cache holds."""


def write_bytes(path: Path, content: bytes) -> None:
    """Replace `path` by `content` atomically: write a file beside it, flush it to the disk, rename it.

    Raises:
        InputError: the disk is full or the folder cannot be written; `path` is unchanged.
    """
    temporary = None
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
        temporary = None
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise InputError(
            f"Cannot write {path} ({error.strerror or error}): the previous file is kept; "
            "free some space or choose another folder."
        ) from error
    finally:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)


def renew_checksums(written: Iterable[Path], removed: Iterable[Path] = ()) -> None:
    """Write the checksums of files again, where they have any; `dora.digests.check_file` compares them.

    A file that is new gets one where others of its folder have one. Other lines stay as they are.

    Args:
        written: files that were written.
        removed: files that were removed.

    Raises:
        InputError: a file of checksums cannot be read or written.
    """
    gone = {Path(os.path.abspath(path)) for path in removed}
    for path in sorted({Path(os.path.abspath(path)) for path in written} | gone):
        own = path.parent / (path.name + OWN_SUM)
        if own.is_file():
            own.unlink() if path in gone else write_bytes(own, os.fsencode(f"{file_sha256(path)}  {path.name}\n"))
        for place in path.parents[:DEPTH]:
            _renew(place / SUMS, path.relative_to(place).as_posix(), None if path in gone else file_sha256(path))


def _renew(sums: Path, name: str, checksum: str | None) -> None:
    """Write the line of a name in a file of checksums again, or leave it out."""
    listed = listed_checksums(sums, near=False)
    beside = any(os.path.dirname(other) == os.path.dirname(name) for other in listed)
    if name not in listed and not (beside and checksum):
        return
    lines = lines_of_checksums(sums)
    places = [i for i, line in enumerate(lines) if (parsed_checksum(line) or ("",))[0] == name]
    new = [f"{checksum}  {name}"] if checksum else []
    start = places[0] if places else len(lines) - (not lines[-1])
    rest = [line for i, line in enumerate(lines) if i not in places]
    write_bytes(sums, os.fsencode("\n".join(rest[:start] + new + rest[start:])))


def make_folder(folder: Path) -> None:
    """Make a folder, and those above it, unless it exists.

    Raises:
        InputError: it cannot be made, or a file has its name.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot make the folder {folder} ({error}): choose another one.") from error


def files_under(folder: Path, name: str) -> list[Path]:
    """Files of a name in a folder and those below it, behind links too, each once; sorted by path."""
    found, seen = list[Path](), set[str]()
    for path, below, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(path)
        below[:] = [] if real in seen else sorted(below)
        if real not in seen and name in names:
            found.append(Path(path, name))
        seen.add(real)
    return sorted(found)


def check_name(path: Path) -> None:
    """Refuse a path that libraries which write there cannot take.

    Raises:
        InputError: it is not UTF-8.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"The name {os.fsencode(path)!r} is not in UTF-8: choose another one.") from None


def check_new_name(path: Path) -> None:
    """Refuse a path at which something is, or at which nothing can be made for its name alone.

    Raises:
        InputError: it exists, is too long, or is not UTF-8.
    """
    check_name(path)
    try:
        os.lstat(path)
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(f"{shown(str(path))} cannot be made ({reason}): choose another one.") from error
    raise InputError(f"{path} exists already: choose another folder, or remove it.")


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Replace `path` by a JSON object, atomically.

    Raises:
        InputError: as `write_bytes`.
    """
    write_bytes(path, (json.dumps(content, indent=2) + "\n").encode())


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Replace `path` by a table of comma-separated values, atomically; floats have six digits.

    Raises:
        InputError: as `write_bytes`.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([f"{v:.6g}" if isinstance(v, float) else v for v in row] for row in rows)
    write_bytes(path, text.getvalue().encode())


def write_tensors(path: Path, kind: str, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Replace `path` by a safetensors file, atomically.

    Args:
        path: path of the file.
        kind: name and version of the format, such as "dora-grasps 1".
        tensors: tensors by name.
        metadata: values that JSON can represent; `read_tensors` returns them.

    Raises:
        InputError: as `write_bytes`.
    """
    write_safetensors(path, tensors, {"format": kind, METADATA: json.dumps(dict(metadata))})


def read_tensors(path: Path, kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and metadata of a file written by `write_tensors`.

    Raises:
        InputError: the file is missing, too large, truncated, damaged, or of another format or version than `kind`.
    """
    tensors, header = read_safetensors(path, f"{kind} file", {"format": (kind,)})
    metadata = parse_json(header.get(METADATA, "null"), f"the header of {path}")
    if not isinstance(metadata, dict):
        raise InputError(f"{path} has no metadata: use another file, or make it again.")
    return tensors, metadata


def write_safetensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Replace `path` by a safetensors file with a header and, in it, a digest of the whole file.

    Raises:
        InputError: as `write_bytes`, or the file would be larger than `MOST_BYTES` or its header than `MOST_HEADER`.
    """
    own = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    content = save(own, {**header, WHOLE: ZEROS})
    size = 8 + int.from_bytes(content[:8], "little")
    if size > MOST_HEADER:
        raise InputError(f"{path} would have a header of {size} bytes; at most {MOST_HEADER} can be read again.")
    if len(content) > MOST_BYTES:
        raise InputError(f"{path} would have {len(content)} bytes; at most {MOST_BYTES} can be read again.")
    digest = hashlib.sha256(content).hexdigest()
    place = content.index(_entry(ZEROS), 0, size) + len(_entry(""))
    write_bytes(path, b"".join((content[:place], digest.encode(), content[place + len(ZEROS) :])))


def read_safetensors(
    path: Path, what: str, required: Mapping[str, Sequence[str]]
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and header of a file written by `write_safetensors`, every byte of which its digest covers.

    Files of the first format, with another digest, are read as well; what it does not cover is their header but for
    `METADATA`.

    Args:
        path: of the file.
        what: it is, for messages.
        required: entries that its header must have, such as format and version, with the values that are accepted.

    Raises:
        InputError: if it is missing, too large, truncated, damaged, or lacks a required entry.
    """
    check_size(path, what, MOST_BYTES)
    unusable = f"{path} is truncated, damaged or no {what}"
    try:
        if not _header_fits(path):
            raise InputError(f"{unusable} (the size of its header is wrong): use another one.")
        with safe_open(path, framework="pt") as stream:
            header = stream.metadata() or {}
            if any(header.get(name) not in values for name, values in required.items()):
                found = header.get("format", "another format")
                raise InputError(
                    f"{path} is {found}, no {what} of this version of Dora: use another one, or make it again."
                )
            whole = _whole_digest(path, header.get(WHOLE, ""))
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
        intact = header[WHOLE] == whole if WHOLE in header else header.get(FIRST) == _first_digest(tensors, header)
    except InputError:
        raise
    except Exception as error:  # safetensors and torch raise several kinds for what they cannot represent
        raise InputError(f"{unusable} ({type(error).__name__}: {error}): use another one.") from error
    if not intact:
        raise InputError(f"{path} is damaged (its digest differs): use another one, or make it again.")
    return tensors, header


def stored_or_made(
    path: Path, load: Callable[[Path], Content], make: Callable[[], Content], save: Callable[[Path, Content], None]
) -> Content:
    """What a file of a cache holds, or what is made where there is no intact file.

    A cache that cannot be written is done without. What a killed process left half written of this file is removed.

    Args:
        path: of the file.
        load: reads it, and raises InputError if it is damaged.
        make: makes the content.
        save: writes it.
    """
    with contextlib.suppress(InputError, OSError):
        if os.path.isfile(path):
            return load(path)
    content = make()
    with contextlib.suppress(InputError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        for half in path.parent.glob(f".{glob.escape(path.name)}.*"):
            if time.time() - half.stat().st_mtime > LEFT_SECONDS:
                half.unlink()
        save(path, content)
    return content


def _entry(digits: str) -> bytes:
    """The bytes of a header up to the end of the digits of its digest."""
    return f'"{WHOLE}":"{digits}'.encode()


def _header_fits(path: Path) -> bool:
    """Whether the header ends within the file and is not too large, so that it may be parsed."""
    with path.open("rb") as stream:
        size = int.from_bytes(stream.read(8), "little")
    return size <= min(MOST_HEADER, path.stat().st_size - 8)


def _whole_digest(path: Path, digits: str) -> str:
    """sha256 of a file in which zeros replace the digits of its digest; "" if they do not stand there once."""
    with path.open("rb") as stream:
        start = stream.read(8)
        start += stream.read(int.from_bytes(start, "little"))
        if len(digits) != len(ZEROS) or start.count(_entry(digits)) != 1:
            return ""
        digest = hashlib.sha256(start.replace(_entry(digits), _entry(ZEROS)))
        while piece := stream.read(CHUNK):
            digest.update(piece)
    return digest.hexdigest()


def _first_digest(tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """sha256 over names, types, shapes and values of CPU tensors, and over the metadata of `write_tensors`."""
    digest = hashlib.sha256(header.get(METADATA, "").encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def film_is_whole(path: Path, frames: int, rate: float | int) -> bool:
    """Whether a film can be read and lacks no frames: who writes films is not told how the encoder ended.

    Args:
        path: of the film, which is closed.
        frames: that were given to the encoder.
        rate: frames per second [Hz].
    """
    import imageio_ffmpeg  # takes its time, and is needed by few

    try:
        reader = imageio_ffmpeg.read_frames(str(path))
        seconds = float(next(reader)["duration"])
        reader.close()
    except (OSError, RuntimeError, StopIteration):
        return False
    return seconds > 0 and seconds * rate >= frames - FRAMES_OF_ROUNDING
