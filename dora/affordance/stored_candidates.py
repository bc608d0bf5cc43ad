"""What a file of grasp candidates may hold: names, types, shapes and ranges of its tensors and texts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dora.affordance.maps.voting import HAND_PARTS
from dora.errors import InputError, shown

ENERGY = "energy/"
"""Beginning of the name of a tensor with the values of an energy term."""
JOINTS, CONTACTS = "joints", "contacts"
"""Sizes that tensors of one file share: hand joints, and contacts of a candidate."""
SHAPES: dict[str, tuple[int | str, ...]] = {
    "position": (3,), "quaternion": (4,), "approach": (3,), "pregrasp": (JOINTS,), "grasp": (JOINTS,),
    "joints": (JOINTS,), "contacts": (CONTACTS, 3), "contact_finger": (CONTACTS,), "penetration": (),
    "self_penetration": (), "valid": (), "score": (),
}  # fmt: skip
"""Shape of the rows of every tensor; those of energy terms are numbers."""
ANGLES = ("pregrasp", "grasp", "joints")
"""Tensors of angles."""
UPPER = {"score": 1.0, "penetration": 1.0, "self_penetration": 1.0}
"""Largest values of numbers that are not negative, or nan where they are not known: shares [1], depths [m]."""
REQUIRED = ("position", "quaternion", "approach", "pregrasp", "grasp", "grasp_class")
"""Tensors that a file must have."""
TEXTS = ("object", "digest", "robot", "robot_digest", "settings")
"""Texts that a file must have; `settings` is long."""
MOST_CANDIDATES, MOST_CLASSES, LONGEST_TEXT = 1_000_000, 1000, 200
"""Largest number of candidates and of classes, and of characters of a text [1]."""
LARGEST_NUMBER, LARGEST_ANGLE = 1e3, 10.0
"""Every length [m] and every angle of a joint [rad] is smaller."""
UNIT = 1e-2
"""Largest error of the norm of a quaternion or direction [1]."""


def check_stored(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> tuple[str, ...]:
    """Grasp class of every candidate of a file, whose content is refused unless it fits.

    Args:
        path: of the file, for messages.
        tensors: of the file, without those of contact maps; "grasp_class", an index into the classes, is taken out.
        metadata: of the file; "classes", the names of the classes, is taken out.

    Raises:
        InputError: naming the first tensor or text that is missing, unknown, of another type or shape, or out of range.
    """

    def fail(text: str) -> InputError:
        return InputError(f"{path} {text}: use another file, or make it again.")

    names = metadata.pop("classes", None)
    if not isinstance(names, list) or not 0 < len(names) <= MOST_CLASSES or not all(map(_is_name, names)):
        raise fail("has no list of the names of grasp classes")
    for name in TEXTS:
        text = metadata.get(name)
        if not isinstance(text, str) or (name != "settings" and len(text) > LONGEST_TEXT):
            raise fail(f"has {shown(text)} as its {name}, not a text")
    unknown = set(metadata) - set(TEXTS)
    if unknown:
        raise fail(f"has the unknown entry {shown(min(unknown))}")
    lacking = [name for name in REQUIRED if name not in tensors]
    if lacking:
        raise fail(f"lacks the tensor {lacking[0]!r}")
    index = tensors.pop("grasp_class")
    if index.ndim != 1 or index.dtype.is_floating_point or index.dtype == torch.bool or index.dtype.is_complex:
        raise fail("has grasp classes that are not one whole number each")
    count = len(index)
    if not 0 < count <= MOST_CANDIDATES:
        raise fail(f"holds {count} candidates, not 1 to {MOST_CANDIDATES}")
    if int(index.min()) < 0 or int(index.max()) >= len(names):
        raise fail("has grasp classes without a name")
    sizes: dict[str, int] = {}
    for name, value in tensors.items():
        if name not in SHAPES and not (name.startswith(ENERGY) and _is_name(name)):
            raise fail(f"has the unknown tensor {shown(name)}")
        wanted = (count, *SHAPES.get(name, ()))
        found = [sizes.setdefault(w, n) if isinstance(w, str) else w for w, n in zip(wanted, value.shape, strict=False)]
        if len(wanted) != value.ndim or tuple(found) != tuple(value.shape):
            raise fail(f"has the tensor {name!r} of shape {tuple(value.shape)}, not {wanted}")
        _check_values(name, value, fail)
    return tuple(names[i] for i in index.tolist())


def _check_values(name: str, value: Tensor, fail: Any) -> None:
    """Refuses another type than that of the field, and numbers out of range."""
    if name == "valid":
        fits = value.dtype == torch.bool
    elif name == "contact_finger":
        fits = value.dtype in (torch.uint8, torch.int16, torch.int32, torch.int64)
        fits = fits and (not value.numel() or (int(value.min()) >= 0 and int(value.max()) <= HAND_PARTS))
    else:
        fits = value.dtype in (torch.float32, torch.float64)
    if not fits:
        raise fail(f"has the tensor {name!r} of another type or range than it may have")
    largest = LARGEST_ANGLE if name in ANGLES else LARGEST_NUMBER
    if name in ("position", "contacts", *ANGLES) and not bool((value.abs() < largest).all()):
        raise fail(f"has the tensor {name!r} with numbers that are not finite or not below {largest:g}")
    if name in ("quaternion", "approach") and not bool(((value.norm(dim=-1) - 1).abs() < UNIT).all()):
        raise fail(f"has the tensor {name!r} with rows that are not finite or whose norm is not 1")
    if name in UPPER and not bool((value.isnan() | ((value >= 0) & (value <= UPPER[name]))).all()):
        raise fail(f"has the tensor {name!r} with values that are not from 0 to {UPPER[name]:g}")


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= LONGEST_TEXT
