"""What tests of refused files share: expecting one sentence, soon and without memory, and writing files."""

import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from dora.errors import InputError

ENTITIES = '<!DOCTYPE l [<!ENTITY a "aaaaaaaaaa">]>'
"""A document type of XML whose entity could be repeated without end."""


@contextmanager
def refused(words: str, seconds: float = 3.0) -> Iterator[None]:
    """Expects one sentence with these words, soon, and no growth of the memory above 300 MB."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=words) as caught:
        yield
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1300
    assert time.perf_counter() - start < seconds
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 300_000


def written(path: Path, content: str | bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path
