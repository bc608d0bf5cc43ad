"""Fonts of this machine for names in any script."""

import functools
import unicodedata

from matplotlib import font_manager, rcParams
from matplotlib.font_manager import FontEntry, FontProperties

LAST = "Last Resort"
"""Beginning of the name of a font that has a sign for the script of every character, which matplotlib brings."""

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
    entries = sorted(font_manager.fontManager.ttflist, key=_rank)
    for entry in entries:
        if not missing:
            break
        found = missing & _letters(entry.fname)
        if found and entry.name not in chosen:
            chosen.append(entry.name)
            missing -= found
    return chosen


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
