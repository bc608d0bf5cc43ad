"""Fonts of this machine for names in any script."""

import functools
import unicodedata
from pathlib import Path

from matplotlib import font_manager, get_data_path, rcParams
from matplotlib.font_manager import FontEntry, FontProperties

LAST = "Last Resort"
"""Beginning of the name of a font that has a sign for the script of every character, which matplotlib brings."""
LAST_FILE = "fonts/ttf/LastResortHE-Regular.ttf"
"""Its file among matplotlib's data."""

INVISIBLE = ("Cc", "Cf", "Cs", "Zs", "Zl", "Zp")
"""Categories of characters that no font has to draw."""


def families(text: str) -> list[str]:
    """Fonts that together draw a text: matplotlib's own, those installed for what it lacks, and the last resort.

    Args:
        text: all characters to draw.
    """
    own = font_manager.findfont(FontProperties())
    missing = {ord(letter) for letter in text if unicodedata.category(letter) not in INVISIBLE} - _letters(own)
    chosen = list(rcParams["font.family"])
    for entry in sorted(_entries(), key=_rank):
        if not missing:
            break
        found = missing & _letters(entry.fname)
        if found and entry.name not in chosen:
            chosen.append(entry.name)
            missing -= found
    return chosen


def _entries() -> list[FontEntry]:
    """The fonts that matplotlib knows. Its list is cached for all environments of a user, and one that was made while
    an environment was removed lacks matplotlib's own fonts; the last resort is added then."""
    fonts, last = font_manager.fontManager, Path(get_data_path()) / LAST_FILE
    if last.is_file() and not any(entry.name.startswith(LAST) for entry in fonts.ttflist):
        fonts.addfont(last)
    return fonts.ttflist


def _rank(entry: FontEntry) -> tuple[bool, bool, str]:
    """Ordinary letters of fonts of text come first."""
    return entry.name.startswith(LAST), (entry.style, entry.weight) != ("normal", 400), entry.name


@functools.lru_cache(maxsize=256)
def _letters(path: str) -> frozenset[int]:
    """Codes of the characters that a font file has."""
    try:
        return frozenset(font_manager.get_font(path).get_charmap())
    except (OSError, RuntimeError):  # gone or damaged since the list of fonts was made
        return frozenset()
