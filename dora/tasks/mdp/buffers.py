"""Named tensors with a row per environment: allocated once, written by rows, saved and restored as one state."""

from typing import Any

import torch
from torch import Tensor


class Buffers:
    """Tensors (n, ...) by name; `buffers.name` is the tensor itself.

    Args:
        num_envs: n.
        device: where the tensors are.
        shapes: shape of a row by name, () for one number. All start at zero, as float32.
    """

    def __init__(self, num_envs: int, device: torch.device | str, **shapes: tuple[int, ...]):
        self._tensors = {name: torch.zeros(num_envs, *shape, device=device) for name, shape in shapes.items()}

    def __getattr__(self, name: str) -> Any:
        try:
            return self.__dict__["_tensors"][name]
        except KeyError:
            known = ", ".join(self.__dict__.get("_tensors", ()))
            raise AttributeError(f"there is no buffer {name!r}; there are {known}") from None

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.__dict__.get("_tensors", ()):
            raise AttributeError(f"the buffer {name!r} is written in place: use update({name}=...) or write(rows, ...)")
        super().__setattr__(name, value)

    def __contains__(self, name: str) -> bool:
        return name in self._tensors

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all tensors."""
        return tuple(self._tensors)

    def write(self, rows: Tensor, **values: Tensor | float) -> None:
        """Writes the environments `rows` (b,) of the named tensors; values are (b, ...) or one number."""
        for name, value in values.items():
            self._tensors[name][rows] = value

    def clear(self, rows: Tensor) -> None:
        """Sets the environments `rows` of all tensors to zero."""
        for tensor in self._tensors.values():
            tensor[rows] = 0.0

    def update(self, **values: Tensor) -> None:
        """Replaces all rows of the named tensors, in place."""
        for name, value in values.items():
            self._tensors[name].copy_(value)

    def get_state(self) -> dict[str, Tensor]:
        """Copies of all tensors by name."""
        return {name: tensor.clone() for name, tensor in self._tensors.items()}

    def set_state(self, state: dict[str, Tensor], rows: Tensor | slice) -> None:
        """Inverse of `get_state` for the given rows; a row may have been flattened."""
        for name, tensor in self._tensors.items():
            tensor[rows] = state[name].reshape(tensor[rows].shape)
