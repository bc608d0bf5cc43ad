"""HDF5 files on a disk that may fill up.

The HDF5 library does not let go of a file that it cannot write: h5py prints a page of lines, and the process ends in a
segmentation fault. Here it never meets an error; who writes asks for it.
"""

import contextlib
import io
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Context of calls of HDF5, in which Ctrl-C and SIGTERM wait until its end: an exception that a signal raises in
    what HDF5 calls here would end in a segmentation fault, too. Elsewhere than in the main thread none arrives."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, Any]] = []
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in before:
            signal.signal(number, lambda *arrived: came.append(arrived))
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        if came:
            signal.raise_signal(came[0][0])


class ForgivingFile(io.RawIOBase):
    """A new file that keeps in memory what the disk does not take.

    Attributes:
        failure: the first error of the disk, or an interruption, after which nothing more is written to it; None
            before.

    Args:
        path: of the file.

    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path):
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        super().__init__()
        self.failure: BaseException | None = None
        self._kept: list[tuple[int, bytes]] = []
        self._at, self._size = 0, 0

    def check(self) -> None:
        """Raise what `failure` holds, if anything."""
        if self.failure is not None:
            raise self.failure

    def readable(self) -> bool:
        """Yes."""
        return True

    def writable(self) -> bool:
        """Yes."""
        return True

    def seekable(self) -> bool:
        """Yes."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a place, as in any file."""
        self._at = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._size}[whence]
        return self._at

    def tell(self) -> int:
        """The place [bytes]."""
        return self._at

    def write(self, data: Any) -> int:
        """Write to the disk, or after its first error keep in memory."""
        content = bytes(data)
        try:
            done = 0
            while self.failure is None and done < len(content):
                done += os.pwrite(self._descriptor, content[done:], self._at + done)
        except (OSError, KeyboardInterrupt) as error:  # HDF5 cannot be interrupted, either
            self.failure = error
        if self.failure is not None:
            self._kept.append((self._at, content))
        self._at += len(content)
        self._size = max(self._size, self._at)
        return len(content)

    def readinto(self, buffer: Any) -> int:
        """Read what was written, wherever it is."""
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self._size - self._at))
        found = bytearray(os.pread(self._descriptor, count, self._at).ljust(count, b"\0"))
        for start, content in self._kept:
            low, high = max(start, self._at), min(start + len(content), self._at + count)
            if low < high:
                found[low - self._at : high - self._at] = content[low - start : high - start]
        view[:count] = found
        self._at += count
        return count

    def truncate(self, size: int | None = None) -> int:
        """Set the size [bytes], to the place by default."""
        self._size = self._at if size is None else size
        if self.failure is None:
            try:
                os.ftruncate(self._descriptor, self._size)
            except (OSError, KeyboardInterrupt) as error:
                self.failure = error
        return self._size

    def close(self) -> None:
        """Close it; what is kept in memory is gone."""
        descriptor, self._descriptor = getattr(self, "_descriptor", -1), -1
        super().close()
        if descriptor >= 0:
            os.close(descriptor)


@contextlib.contextmanager
def open_undisturbed(below: ForgivingFile, **options: Any) -> Iterator[h5py.File]:
    """An HDF5 file in another one, which no signal disturbs while it is begun and closed.

    Args:
        below: where it is written.
        options: of `h5py.File`.
    """
    file = None
    try:
        with undisturbed():
            file = h5py.File(below, "w", **options)
        yield file
    finally:
        if file is not None:
            with undisturbed():
                file.close()
