"""Films of a camera over many episodes: MP4 files of bounded size, in which each episode has its time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from jaxtyping import UInt8

from dora.datasets.tables import MEGABYTE
from dora.errors import InputError
from dora.files import film_is_whole

CODEC, PIXELS = "libx264", "yuv420p"
"""Encoder and form of the pixels; each picture has an even number of rows and columns."""
SETTINGS = ("-g", "2", "-bf", "0", "-crf", "18")
"""Every second frame stands for itself, so that single ones are found quickly; quality, 0 is without loss."""


class Film:
    """The film of one camera.

    Args:
        folder: of the dataset.
        template: place of a file, with `chunk_index` and `file_index`.
        files_per_chunk: files in one folder.
        size: above which a further file is begun [MB of 2^20 bytes].
        rate: pictures per second [Hz].
    """

    def __init__(self, folder: Path, template: str, files_per_chunk: int, size: int | float, rate: int):
        self.folder, self.template, self.files_per_chunk = folder, template, files_per_chunk
        self.size, self.rate = size, rate
        self._number, self._frames, self._path, self._writer = 0, 0, folder, None

    @staticmethod
    def description(shape: Sequence[int], rate: int) -> dict[str, Any]:
        """What `info.json` says of the film of pictures (h, w, 3)."""
        height, width, channels = shape
        return {
            "video.height": height, "video.width": width, "video.channels": channels, "video.codec": "h264",
            "video.pix_fmt": PIXELS, "video.fps": rate, "video.is_depth_map": False, "has_audio": False,
        }  # fmt: skip

    def add(self, pictures: UInt8[np.ndarray, "t h w 3"]) -> dict[str, int | float]:
        """Append the pictures of an episode; where they are: chunk, file, and times in the file [s]."""
        if self._writer is not None and self._written > self.size * MEGABYTE:
            self.close()
            self.check()
            self._number, self._frames = self._number + 1, 0
        chunk, file = divmod(self._number, self.files_per_chunk)
        if self._writer is None:
            self._path = self.folder / self.template.format(chunk_index=chunk, file_index=file)
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = imageio.get_writer(
                self._path, fps=self.rate, codec=CODEC, pixelformat=PIXELS, quality=None, macro_block_size=2,
                output_params=list(SETTINGS),
            )  # fmt: skip
        for picture in pictures:
            self._writer.append_data(picture)  # pyright: ignore[reportAttributeAccessIssue]
        start, self._frames = self._frames, self._frames + len(pictures)
        times = {"from_timestamp": start / self.rate, "to_timestamp": self._frames / self.rate}
        return {"chunk_index": chunk, "file_index": file, **times}

    @property
    def _written(self) -> int:
        """Size of the file so far [bytes]; the encoder makes it some pictures later."""
        return self._path.stat().st_size if self._path.exists() else 0

    def close(self) -> None:
        """Finish the file that is being written."""
        if self._writer is not None:
            self._writer.close()
        self._writer = None

    def check(self) -> None:
        """Refuse a file that the encoder did not finish, once it is closed.

        Raises:
            InputError: it lacks pictures.
        """
        if self._frames and not film_is_whole(self._path, self._frames, self.rate):
            raise InputError(f"{self._path} could not be written whole: make room on the disk, and record again.")
