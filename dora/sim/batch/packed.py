"""Simulator state of many environments as flat float32 arrays, read again only where it is out of date.

SAPIEN packs a whole scene into bytes in one C++ call: `Scene.pack_poses` returns the poses of all entities,
`PhysxCpuSystem.pack` the state of all bodies and articulations. One such call replaces dozens of getters,
returns exact copies of the simulator's numbers and changes nothing.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np

POSE_FLOATS = 7
"""Number of floats of a packed pose: quaternion wxyz, then position [m]."""
RIGID_FLOATS = 13
"""Number of floats of a packed body or articulation root: pose, linear [m/s] and angular velocity [rad/s]."""
POSE_ORDER = np.array([4, 5, 6, 0, 1, 2, 3])
"""Indices of position and quaternion, in ManiSkill's order, in a packed pose."""

_FLOAT_BYTES = 4
"""Size of a float32 in bytes."""
_ZERO = bytes(_FLOAT_BYTES)
"""A float32 zero as bytes."""


@runtime_checkable
class Source(Protocol):
    """A provider of current simulator values as one flat array."""

    def flat(self) -> np.ndarray:
        """Current values, float32, read-only."""
        ...


class PackedSource:
    """The packed state of all environments in one array, with a zero at the end for padding.

    ``readers[i]()`` returns the bytes of environment i. `refresh` calls the readers of environments that were
    invalidated and not read since; between two calls of it the values do not change.
    """

    def __init__(self, readers: Sequence[Callable[[], bytes]]):
        self._readers = list(readers)
        self._chunks = [b""] * len(self._readers)
        self._everyone = frozenset(range(len(self._readers)))
        self._stale = set(self._everyone)
        self._flat = np.zeros(1, np.float32)

    def invalidate_all(self) -> None:
        """Declare the values of every environment out of date."""
        self._stale = set(self._everyone)

    def invalidate(self, environments: Iterable[int]) -> None:
        """Declare the values of some environments out of date."""
        self._stale.update(environments)

    def read(self, environment: int) -> None:
        """Read one environment ahead of the next `refresh`."""
        self._chunks[environment] = self._readers[environment]()
        self._stale.discard(environment)

    def refresh(self) -> bool:
        """Read what is out of date and make it current; returns True if the number of values changed."""
        for environment in tuple(self._stale):
            self.read(environment)
        size = self._flat.size
        self._flat = np.frombuffer(b"".join((*self._chunks, _ZERO)), np.float32)
        return self._flat.size != size

    def flat(self) -> np.ndarray:
        """Values of all environments as of the last `refresh`, float32, read-only; the last element is 0."""
        return self._flat

    def chunks(self) -> list[bytes]:
        """The packed values of each environment as of the last `refresh`."""
        return list(self._chunks)

    def starts(self) -> np.ndarray:
        """(environments,) index of the first float of each environment in `flat`."""
        sizes = [len(chunk) // _FLOAT_BYTES for chunk in self._chunks]
        return np.cumsum([0, *sizes[:-1]])

    @property
    def padding(self) -> int:
        """Index of the zero at the end of `flat`."""
        return self._flat.size - 1


class GetterSource:
    """Values that are not in the packed state, read by one getter each and kept until ``epoch()`` changes.

    ``flat`` returns the getters' flattened results, concatenated, and one zero.
    """

    def __init__(self, getters: Sequence[Callable[[], np.ndarray]], epoch: Callable[[], int]):
        self._getters = list(getters)
        self._epoch = epoch
        self._read_at = -1
        self._flat = np.zeros(1, np.float32)

    def flat(self) -> np.ndarray:
        """Current values, float32; the last element is 0."""
        epoch = self._epoch()
        if epoch != self._read_at:
            parts = [np.ravel(get()) for get in self._getters]
            self._flat = np.concatenate([*parts, np.zeros(1, np.float32)])
            self._read_at = epoch
        return self._flat
