"""What must be read from a command line before the rest, because the defaults of the rest depend on it."""

import itertools
from collections.abc import Sequence


def early_value(words: Sequence[str], flag: str) -> str | None:
    """The value that follows `flag`, or stands behind `flag=`; None if the flag is not there or has no value."""
    for word, following in itertools.zip_longest(words, words[1:]):
        if word == flag and following is not None and not following.startswith("--"):
            return following
        if word.startswith(f"{flag}="):
            return word.partition("=")[2]
    return None


def early_values(words: Sequence[str], flag: str) -> list[str] | None:
    """All values between `flag` and the next flag; None if the flag is not there."""
    if flag not in words:
        return None
    values = []
    for word in words[words.index(flag) + 1 :]:
        if word.startswith("--"):
            break
        values.append(word)
    return values
