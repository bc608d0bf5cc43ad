"""Atomic writing of files, and safetensors files with a digest that detects damage."""

import codecs
import csv
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dora.errors import InputError

METADATA = "metadata"
"""Entry of a file's header with the metadata of `write_tensors`, which its digest covers."""


def decoded(content: bytes) -> str:
    """Text in UTF-8, with or without a byte order mark, or in UTF-16 with one.

    Raises:
        UnicodeDecodeError: it is neither.
    """
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if wide else "utf-8-sig")


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
        InputError: the file is missing, truncated, damaged, or of another format or version than `kind`.
    """
    tensors, header = read_safetensors(path, f"{kind} file", {"format": kind})
    return tensors, json.loads(header[METADATA])


def write_safetensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Replace `path` by a safetensors file with a header and, in it, a digest of the tensors."""
    own = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    write_bytes(path, save(own, {**header, "sha256": _digest(own, header)}))


def read_safetensors(path: Path, what: str, required: Mapping[str, str]) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and header of a file written by `write_safetensors`.

    Args:
        path: of the file.
        what: it is, for messages.
        required: entries that its header must have, such as format and version.

    Raises:
        InputError: if it is missing, truncated, damaged, or lacks a required entry.
    """
    if not path.is_file():
        raise InputError(f"There is no {what} {path}: give the path of one (.safetensors).")
    try:
        with safe_open(path, framework="pt") as stream:
            header = stream.metadata() or {}
            tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is truncated, damaged or no {what} ({error}): use another one.") from error
    if any(header.get(name) != value for name, value in required.items()):
        found = header.get("format", "another format")
        raise InputError(f"{path} is {found}, no {what} of this version of Dora: use another one, or make it again.")
    if header.get("sha256") != _digest(tensors, header):
        raise InputError(f"{path} is damaged (its digest differs): use another one, or make it again.")
    return tensors, header


def _digest(tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> str:
    """sha256 over names, types, shapes and values of CPU tensors, and over the metadata of `write_tensors`."""
    digest = hashlib.sha256(header.get(METADATA, "").encode())
    for name in sorted(tensors):
        value = tensors[name]
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
