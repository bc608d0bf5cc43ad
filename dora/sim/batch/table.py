"""Tables of live simulator values with the interface of the CUDA arrays that ManiSkill reads and writes."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dora.sim.batch.packed import Source

_PLANS_KEPT = 1024
"""Largest number of reading plans kept per table; few are needed, because ManiSkill indexes with the same tensors."""


@dataclass(frozen=True, eq=False)
class Part:
    """The source of some elements of a table: ``source.flat()[index]``.

    ``where`` are their positions in the flattened result, or None if they are the whole result (``index`` then has
    its shape).
    """

    source: Source
    index: np.ndarray
    where: np.ndarray | None = None


Planner = Callable[[np.ndarray], Sequence[Part]]
"""Function from element numbers to the parts from which they are read."""
Writer = Callable[[np.ndarray, np.ndarray], None]
"""Function that writes values (second argument) to element numbers (first argument)."""
Writing = Callable[[np.ndarray], AbstractContextManager[None]]
"""Function from rows to the context in which they are changed."""


def assemble(parts: Sequence[Part], shape: tuple[int, ...]) -> np.ndarray:
    """A new float32 array of ``shape`` from its parts."""
    if len(parts) == 1 and parts[0].where is None:
        return parts[0].source.flat().take(parts[0].index)
    result = np.empty(prod(shape), np.float32)
    for part in parts:
        result[part.where] = part.source.flat().take(part.index)
    return result.reshape(shape)


class Table:
    """A table of simulator values with the interface of a `sapien.CudaArray`.

    ``table.torch()[key]`` reads the current values of the elements asked for and returns a new tensor;
    ``table.torch()[key] = value`` writes them into the simulator directly. Nothing is stored in between, so
    there is nothing to fetch or to apply.

    Args:
        shape: shape of the table; the first axis is that of bodies or articulations.
        plan: maps element numbers (of the flattened table) to the parts from which they are read.
        write: sets values in the simulator, given element numbers and values of equal shape.
        refresh: called before every read to make the sources current.
    """

    def __init__(self, shape: tuple[int, ...], plan: Planner, write: Writer, refresh: Callable[[], None]):
        self._elements = torch.arange(prod(shape)).view(shape)
        self._plan = plan
        self._write = write
        self._refresh = refresh
        self._plans: dict[tuple, tuple[Any, Sequence[Part], tuple[int, ...]]] = {}

    @property
    def shape(self) -> torch.Size:
        """Shape of the table."""
        return self._elements.shape

    def torch(self) -> "Table":
        """The table itself, to be indexed like a tensor."""
        return self

    def forget_plans(self) -> None:
        """Drop all reading plans, after the layout of the sources changed."""
        self._plans.clear()

    def __getitem__(self, key: Any) -> Tensor:
        self._refresh()
        signature = _signature(key)
        known = self._plans.get(signature)
        if known is None:
            known = self._remember(signature, key)
        _, parts, shape = known
        return torch.from_numpy(assemble(parts, shape))

    def __setitem__(self, key: Any, value: Any) -> None:
        elements = self._elements[key]
        if elements.numel():
            values = torch.as_tensor(value, dtype=torch.float32).expand(elements.shape)
            self._write(elements.numpy(), values.numpy())

    def read(self, elements: np.ndarray) -> np.ndarray:
        """Values of the elements with these numbers, in the same shape."""
        self._refresh()
        return assemble(self._plan(elements), elements.shape)

    def _remember(self, signature: tuple, key: Any) -> tuple[Any, Sequence[Part], tuple[int, ...]]:
        elements = self._elements[key].numpy()
        plan = (key, self._plan(elements), elements.shape)
        if len(self._plans) >= _PLANS_KEPT:
            self._plans.clear()
        self._plans[signature] = plan
        return plan

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        if name.endswith("_"):
            raise TypeError(f"write with table[...] = value: {name}() would change a copy")
        return getattr(self[...], name)

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Lets torch functions accept a table as a tensor, of which they get a copy."""
        if function.__name__.endswith("_") and not function.__name__.endswith("__"):
            raise TypeError(f"write with table[...] = value: {function.__name__}() would change a copy")
        args = tuple(arg[...] if isinstance(arg, cls) else arg for arg in args)
        kwargs = {name: arg[...] if isinstance(arg, cls) else arg for name, arg in (kwargs or {}).items()}
        return function(*args, **kwargs)


def _signature(key: Any) -> tuple:
    """A hashable key of an index; tensors are identified by ``id`` (the plan keeps them alive)."""
    if isinstance(key, tuple):
        return tuple(_signature(part) for part in key)
    if isinstance(key, slice):
        return (key.start, key.stop, key.step)
    if isinstance(key, int) or key is Ellipsis:
        return (key,)
    return ("object", id(key))


class BlockWriter:
    """Writes the blocks of a row by their setters, in the order given.

    Args:
        width: number of columns of a row.
        blocks: per block its columns, and for each row a setter or None.
        read: function from element numbers to current values, which a block written in part keeps in its other columns.
        writing: function from rows to the context of the setters' calls.
    """

    def __init__(
        self,
        width: int,
        blocks: Sequence[tuple[slice, Sequence[Callable | None]]],
        read: Callable[[np.ndarray], np.ndarray],
        writing: Writing,
    ):
        self._width, self._blocks = width, blocks
        self._read, self._writing = read, writing

    def __call__(self, elements: np.ndarray, values: np.ndarray) -> None:
        written_rows, columns = np.divmod(elements.ravel(), self._width)
        rows, row_of = np.unique(written_rows, return_inverse=True)
        touched = np.zeros((len(rows), self._width), bool)
        touched[row_of, columns] = True
        new = self._current(rows, touched)
        new[row_of, columns] = values.ravel()
        with self._writing(rows):
            for block, setters in self._blocks:
                for i in np.flatnonzero(touched[:, block].any(axis=1)).tolist():
                    setter = setters[rows[i]]
                    if setter is not None:
                        setter(new[i, block])

    def _current(self, rows: np.ndarray, touched: np.ndarray) -> np.ndarray:
        """The rows before the write; read only if a block is written in part."""
        if any(touched[:, block].any() and not touched[:, block].all() for block, _ in self._blocks):
            return self._read(rows[:, None] * self._width + np.arange(self._width))
        return np.zeros(touched.shape, np.float32)
