"""Damage to files, drawn from a seed, and what a loader makes of it: accepted, refused, or a traceback.

Each is loaded twice: as it is, which tells whether something other than a sentence comes of it, and beside `SHA256SUMS`
of the intact files, with which nothing may be accepted.

`python tests/damage.py 200` damages 200 files for each loader of `probes.LOADERS` and prints a table.
"""

import contextlib
import io
import random
import re
import resource
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from dora.digests import SUMS, file_sha256
from dora.errors import InputError

WORDS = (
    b"nan", b"inf", b"-1", b"0", b"1e308", b"999999999999999999999", b'""', b"null", b"true", b"[]", b"{}", b"\xff\xfe",
    b"\0", b"'", b"[[[[", b"- - - -", b"&a [*a, *a]", b"<script>", b"2147483648", b"../..", b"0x10", b"1_000", b"\n\n",
    "\u202e".encode(), b"~", b"!!python/object:os.system", b"{{7*7}}", b"%s",
)  # fmt: skip
"""What is put in the place of a number or word, or anywhere."""
TOKEN = re.compile(rb"-?\d+\.?\d*(?:e-?\d+)?|[A-Za-z_]{2,}")


def flipped(content: bytes, draw: random.Random) -> bytes:
    """One to four bits are changed."""
    changed = bytearray(content)
    for _ in range(draw.randint(1, 4)):
        if changed:
            changed[draw.randrange(len(changed))] ^= 1 << draw.randrange(8)
    return bytes(changed)


def cut(content: bytes, draw: random.Random) -> bytes:
    """The end is missing."""
    return content[: draw.randrange(max(len(content), 1))]


def without(content: bytes, draw: random.Random) -> bytes:
    """A piece is missing."""
    start = draw.randrange(len(content) + 1)
    return content[:start] + content[start + draw.randint(1, 64) :]


def more(content: bytes, draw: random.Random) -> bytes:
    """Something is put in between."""
    start = draw.randrange(len(content) + 1)
    return content[:start] + draw.choice((draw.randbytes(draw.randint(1, 40)), *WORDS)) + content[start:]


def header_flipped(content: bytes, draw: random.Random) -> bytes:
    """One byte of the first 200 is another one."""
    if not content:
        return b"?"
    place = draw.randrange(min(200, len(content)))
    return content[:place] + bytes([draw.randrange(256)]) + content[place + 1 :]


def retyped(content: bytes, draw: random.Random) -> bytes:
    """Another value or word in the place of one."""
    found = list(TOKEN.finditer(content[:100_000]))
    if not found:
        return more(content, draw)
    place = draw.choice(found)
    return content[: place.start()] + draw.choice(WORDS) + content[place.end() :]


def doubled(content: bytes, draw: random.Random) -> bytes:
    """A piece is there many times."""
    start = draw.randrange(len(content) + 1)
    return content[:start] + content[start : start + 50] * draw.randint(2, 200) + content[start:]


DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    flipped, cut, without, more, header_flipped, retyped, retyped, doubled,
)  # fmt: skip


@dataclass(frozen=True)
class Loader:
    """What is probed.

    Attributes:
        make: writes intact files into an empty folder.
        load: reads them; raises InputError if they are refused.
        damaged: patterns of the files that are damaged.
        sealed: whether every damage has to be refused, because a digest covers the file; the others are files that
            people or other programs write, in which a change may be another valid value.
    """

    make: Callable[[Path], object]
    load: Callable[[Path], object]
    damaged: tuple[str, ...] = ("*",)
    sealed: bool = False


@dataclass
class Outcome:
    """What became of the damaged files of a loader: counts, the slowest call [s], growth of the memory [MB].

    `accepted` counts files as they are, `despite` those that were accepted although they have checksums.
    """

    probes: int = 0
    accepted: int = 0
    despite: int = 0
    refused: int = 0
    tracebacks: list[str] = field(default_factory=list)
    unclear: list[str] = field(default_factory=list)
    slowest: float = 0.0
    grown: float = 0.0


def peak() -> float:
    """Largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class Probe:
    """Damages files of a loader, each in one way, and loads them.

    Args:
        name: of the loader.
        loader: what is probed.
        folder: an empty one, for the intact files and for a damaged copy.
    """

    def __init__(self, name: str, loader: Loader, folder: Path):
        self.intact, self.copy, self.loader, self.outcome = folder / "intact", folder / "copy", loader, Outcome()
        self.intact.mkdir(parents=True)
        loader.make(self.intact)
        loader.load(self.intact)
        self._before = peak()
        self.files = sorted(path for pattern in loader.damaged for path in self.intact.rglob(pattern) if path.is_file())
        assert self.files, f"{name} has no files to damage"
        names = [path.relative_to(self.intact).as_posix() for path in self.files]
        self.checksums = "".join(f"{file_sha256(self.intact / name)}  {name}\n" for name in names)

    def damage(self, draw: random.Random) -> None:
        """Loads the files after one of them was damaged, and counts what became of it."""
        path = draw.choice(self.files)
        content = path.read_bytes()
        damaged = draw.choice(DAMAGES)(content, draw)
        if damaged == content:
            return
        shutil.rmtree(self.copy, ignore_errors=True)
        shutil.copytree(self.intact, self.copy)
        (self.copy / path.relative_to(self.intact)).write_bytes(damaged)
        self.outcome.probes += 1
        accepted = self._load(path.name)
        self.outcome.accepted += accepted is True
        self.outcome.refused += accepted is False
        if not self.loader.sealed:
            (self.copy / SUMS).write_text(self.checksums)
            self.outcome.despite += self._load(path.name) is True

    def _load(self, name: str) -> bool | None:
        """Loads the copy, in which the file of this name is damaged; whether it was accepted, None for a traceback."""
        outcome, accepted = self.outcome, None
        start = time.perf_counter()
        try:
            with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
                warnings.simplefilter("ignore")
                self.loader.load(self.copy)
            accepted = True
        except InputError as error:
            accepted = False
            if "\n" in str(error) or len(str(error)) > 1300 or not str(error).strip():
                outcome.unclear.append(str(error))
        except Exception as error:
            outcome.tracebacks.append(f"{name}: {type(error).__name__}: {error}"[:300])
        outcome.slowest = max(outcome.slowest, time.perf_counter() - start)
        outcome.grown = max(outcome.grown, peak() - self._before)
        return accepted


def probe(name: str, loader: Loader, count: int, folder: Path, seed: int = 0) -> Outcome:
    """Damages files of a loader `count` times."""
    one, draw = Probe(name, loader, folder), random.Random(f"{name} {seed}")
    for _ in range(count):
        one.damage(draw)
    return one.outcome


def main(words: list[str]) -> int:
    """Print a table of all loaders, or of those that are named; returns 1 if a target is missed."""
    import tempfile

    from probes import LOADERS

    count = int(words[0]) if words else 200
    missed = 0
    print(f"{'loader':24} files accepted (with checksums) refused tracebacks slowest [s] memory [MB]")
    for name, loader in LOADERS.items():
        if words[1:] and name not in words[1:]:
            continue
        with tempfile.TemporaryDirectory() as folder:
            o = probe(name, loader, count, Path(folder))
        bad = o.despite + (o.accepted if loader.sealed else 0) + len(o.tracebacks) + len(o.unclear)
        missed += bool(bad or o.slowest > 5 or o.grown > 1000)
        print(
            f"{name:24} {o.probes:5} {o.accepted:8} {o.despite:16} {o.refused:7} {len(o.tracebacks):10} "
            f"{o.slowest:11.2f} {o.grown:11.0f}{'   has a digest' if loader.sealed else ''}",
            flush=True,
        )
        for line in sorted({*o.tracebacks, *o.unclear})[:8]:
            print("    ", line.replace("\n", " | "))
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
