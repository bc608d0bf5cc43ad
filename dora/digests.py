"""Digests of settings and data: sha256 of values under stable keys, independent of the names of their classes."""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

KEY = "digest_key"
"""Key of a field's metadata whose value replaces the field's name in digests, so that it can be renamed."""

SEAL = "digest"
"""Entry of a JSON object that holds the digest of its other entries."""


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
    elif isinstance(value, Tensor):
        _feed(digest, value.detach().numpy())
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
