"""Bounded reading of plain files: bytes, text, JSON, YAML, TOML, XML and arrays; what does not fit is an `InputError`.
`TomlTables` checks the values of a description in TOML.

A file is refused by its size before it is read, and what it holds by its depth and its number of values before anything
is made of it. So no file costs more than a few seconds and a few hundred megabytes.
"""

from __future__ import annotations

import codecs
import io
import json
import math
import tomllib
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
import yaml

from dora.errors import InputError, shown

MOST_TEXT = 8_000_000
"""Size of a text file above which it is not read, where nothing else is said [bytes]."""
MOST_SETTINGS = 1_000_000
"""Size of a file of settings (YAML, TOML) above which it is not read [bytes]."""
DEEPEST = 40
"""Largest depth of lists, mappings and XML elements in each other."""
MOST_VALUES = 1_000_000
"""Largest number of values in a file of JSON or TOML."""
MOST_YAML = 100_000
"""Largest number of values in a YAML file; what an alias stands for counts each time."""
MOST_DOTS = 100
"""Largest number of dots in a line of a TOML file; keys with more parts take quadratic time."""
MOST_ELEMENTS = 20_000
"""Largest number of elements in an XML file."""
UNICODE, LAST_CHARACTER = {"<": "<u4", ">": ">u4", "=": "u4"}, 0x10FFFF
"""Types of the codes of characters by byte order, and the largest code."""
SCALARS = (str, int, float, bool, type(None))
"""Types of values besides lists and mappings."""
MOST_BITS = 1000
"""Largest number of bits of an integer, so that each can be made a float and be printed."""
_Parser: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Parser):
    """Makes values of YAML; refuses a key that a mapping has twice, and takes 1:30 as a text, not as base 60."""

    def get_single_node(self) -> Any:
        """The root of the only document, before merge keys (<<) are resolved."""
        root = super().get_single_node()
        self._check_keys(root)
        return root

    def _check_keys(self, node: Any) -> None:
        found = set()
        for part in node.value if isinstance(node, yaml.CollectionNode) else ():
            for each in part if isinstance(part, tuple) else (part,):
                self._check_keys(each)
            if isinstance(part, tuple) and isinstance(part[0], yaml.ScalarNode) and not part[0].tag.endswith(":merge"):
                key = self.construct_object(part[0])
                if key in found:
                    raise yaml.YAMLError(f"line {part[0].start_mark.line + 1} has the key {shown(key)} again")
                found.add(key)

    def number(self, node: Any) -> Any:
        """A number; a text where it would be one to the base 60, which takes quadratic time."""
        text = self.construct_scalar(node)
        make = self.construct_yaml_int if node.tag.endswith(":int") else self.construct_yaml_float
        return text if ":" in text else make(node)


for _kind in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _Loader.number)


def read_bytes(path: Path, what: str, most: int = MOST_TEXT) -> bytes:
    """Content of a file.

    Args:
        path: of the file.
        what: it is, for messages, such as "label file".
        most: size above which it is refused, without being read [bytes].

    Raises:
        InputError: there is no such file, it is too large, or it cannot be read.
    """
    check_size(path, what, most)
    try:
        with path.open("rb") as stream:
            content = stream.read(most + 1)
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}): check its permissions.") from error
    if len(content) > most:
        raise InputError(f"{path} grows while it is read; wait until it is written.")
    return content


def check_size(path: Path, what: str, most: int) -> None:
    """Refuses a file that is missing or too large.

    Raises:
        InputError: saying which.
    """
    try:
        found, size = path.is_file(), path.stat().st_size if path.is_file() else 0
    except (OSError, ValueError) as error:
        raise InputError(f"There is no {what} {path} ({error}): give the path of one.") from error
    if not found:
        raise InputError(f"There is no {what} {path}: give the path of one.")
    if size > most:
        raise InputError(f"{path} has {size} bytes; a {what} may have at most {most}: reduce it.")


def entries(folder: Path) -> list[Path]:
    """What lies in a folder, sorted; nothing where there is no folder, or one that may not be read."""
    try:
        return sorted(folder.iterdir())
    except OSError:
        return []


def read_text(path: Path, what: str, most: int = MOST_TEXT) -> str:
    """Content of a text file, see `decoded`; arguments and errors as for `read_bytes`."""
    try:
        return decoded(read_bytes(path, what, most))
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no UTF-8 text ({error.reason} at byte {error.start}): write it again.") from error


def decoded(content: bytes) -> str:
    """Text in UTF-8, with or without a byte order mark, or in UTF-16 with one.

    Raises:
        UnicodeDecodeError: it is neither.
    """
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if wide else "utf-8-sig")


def read_json(path: Path, what: str, most: int = MOST_TEXT) -> Any:
    """Content of a JSON file; arguments and errors as for `read_bytes`, and for what is no JSON or too deep."""
    return parse_json(read_text(path, what, most), str(path))


def parse_json(text: str, source: str) -> Any:
    """What a JSON text says.

    Args:
        text: to parse.
        source: names it in messages.

    Raises:
        InputError: it is no JSON, is too deep or too large, or has a key twice in a mapping.
    """
    if text.count(",") > MOST_VALUES:
        raise InputError(f"{source} holds more than {MOST_VALUES} values: reduce it.")
    content = _parsed(lambda text: json.loads(text, object_pairs_hook=_mapping), text, "JSON", source)
    return checked(content, source, MOST_VALUES)


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """The mapping of these keys and values; ValueError if it has a key twice."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError(f"a mapping has the key {shown(Counter(key for key, _ in pairs).most_common(1)[0][0])} twice")
    return found


def read_toml(path: Path, what: str, most: int = MOST_SETTINGS) -> dict[str, Any]:
    """Content of a TOML file; arguments and errors as for `read_bytes`, and for what is no TOML or too deep."""
    text = read_text(path, what, most)
    for number, line in enumerate(text.splitlines(), 1):
        if line.count(".") > MOST_DOTS:
            raise InputError(f"{path} has more than {MOST_DOTS} dots in line {number}; break the line.")
    return checked(_parsed(tomllib.loads, text, "TOML", str(path)), str(path), MOST_VALUES)


def read_yaml(path: Path, what: str, most: int = MOST_SETTINGS) -> Any:
    """Content of a YAML file; arguments and errors as for `read_bytes`, and for what is no YAML, too deep, too large
    with its aliases written out, or has a key twice in a mapping."""
    text = read_text(path, what, most)
    _parsed(lambda text: _check_yaml(text, str(path)), text, "YAML", str(path))
    content = _parsed(lambda text: yaml.load(text, _Loader), text, "YAML", str(path))
    return checked(content, str(path), MOST_YAML)


def _parsed(parse: Callable[[str], Any], text: str, kind: str, source: str) -> Any:
    try:
        return parse(text)
    except InputError:
        raise
    except Exception as error:  # parsers raise some ten kinds of errors
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{source} is not valid {kind} ({reason}): correct it.") from error


def _check_yaml(text: str, source: str) -> None:
    """Refuses a YAML text by its events, before values are made of them."""
    open_nodes: list[tuple[str | None, int]] = []  # anchor, and values so far, of each list and mapping
    sizes: dict[str, int] = {}
    total = 0
    for event in yaml.parse(text, _Parser):
        size = 0
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                raise InputError(f"{source} has the alias *{event.anchor} of what does not stand before it: write it.")
            size = sizes[event.anchor]
        elif isinstance(event, yaml.ScalarEvent):
            size = 1
            sizes |= {event.anchor: 1} if event.anchor else {}
        elif isinstance(event, yaml.CollectionStartEvent):
            open_nodes.append((event.anchor, total))
            total += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_nodes.pop()
            sizes |= {anchor: total - before} if anchor else {}
        total += size
        if len(open_nodes) > DEEPEST:
            raise InputError(f"{source} is more than {DEEPEST} levels deep: write it flatter.")
        if total > MOST_YAML:
            raise InputError(f"{source} holds more than {MOST_YAML} values, those of aliases included: reduce it.")


def checked(content: Any, source: str, most: int) -> Any:
    """Plain data, if they are of bounded depth and number, and hold nothing but lists, mappings, texts and numbers
    of bounded size.

    Raises:
        InputError: saying what is wrong.
    """
    level, count, depth = [content], 0, 0
    while level:
        count, depth = count + len(level), depth + 1
        if count > most:
            raise InputError(f"{source} holds more than {most} values: reduce it.")
        if depth > DEEPEST:
            raise InputError(f"{source} is more than {DEEPEST} levels deep: write it flatter.")
        below: list[Any] = []
        for value in level:
            if isinstance(value, dict):
                below += value.keys()
                below += value.values()
            elif isinstance(value, list):
                below += value
            elif isinstance(value, int) and value.bit_length() > MOST_BITS:
                raise InputError(f"{source} holds a whole number of more than {MOST_BITS} bits: correct it.")
            elif not isinstance(value, SCALARS):
                kind = type(value).__name__
                raise InputError(f"{source} holds a {kind}; only lists, mappings, texts and numbers are read.")
            elif isinstance(value, str) and not value.isascii() and any("\ud800" <= c <= "\udfff" for c in value):
                raise InputError(f"{source} holds half a character (a lone surrogate) in a text: correct it.")
        level = below
    return content


def read_xml(path: Path, what: str, most: int = MOST_TEXT) -> ElementTree.Element:
    """Root element of an XML file; arguments and errors as for `read_bytes`, and as for `checked_xml`."""
    return checked_xml(read_bytes(path, what, most), str(path), MOST_ELEMENTS)


def checked_xml(content: bytes, source: str, most: int) -> ElementTree.Element:
    """Root element of an XML text.

    Args:
        content: to parse.
        source: names it in messages.
        most: largest number of elements.

    Raises:
        InputError: it is no XML, too deep or too large, or declares entities or a document type.
    """
    depth = count = 0

    def begin(_name: str, _attributes: Any) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEEPEST or count > most:
            raise InputError(f"{source} has more than {most} elements or {DEEPEST} levels: reduce it.")

    def end(_name: str) -> None:
        nonlocal depth
        depth -= 1

    def refuse(*_: Any) -> None:
        raise InputError(f"{source} declares a document type or entities, which are not read: remove them.")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(content, True)
        return ElementTree.fromstring(content)
    except InputError:
        raise
    except Exception as error:  # the encodings that a file may name raise errors of their own
        raise InputError(f"{source} is not valid XML ({error}): correct it.") from error


def read_array(path: Path, what: str, most: int) -> np.ndarray:
    """The array of a .npy file of numbers or texts; arguments and errors as for `read_bytes`, and for what is no such
    file, holds Python objects, or declares another size than it has."""
    content = read_bytes(path, what, most)
    stream = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(stream)
        reader = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
        shape, fortran, kind = reader(stream)
    except Exception as error:  # the header is Python text, and fails as such
        raise InputError(f"{path} is no intact .npy file ({type(error).__name__}): write it again.") from error
    left = len(content) - stream.tell()
    if kind.hasobject or kind.names is not None or kind.kind not in "biufUS":
        raise InputError(f"{path} holds {kind}, not numbers or texts: write it with another dtype.")
    if any(size < 0 for size in shape) or math.prod(shape) * kind.itemsize != left or not kind.itemsize:
        raise InputError(f"{path} declares {tuple(shape)} values of {kind} and has {left} bytes: write it again.")
    if kind.kind == "U":
        codes = np.frombuffer(content, UNICODE[kind.byteorder], offset=stream.tell())
        if ((codes > LAST_CHARACTER) | ((codes >= 0xD800) & (codes <= 0xDFFF))).any():
            raise InputError(f"{path} holds texts with codes that are no characters: write it again.")
    return np.frombuffer(content, kind, offset=stream.tell()).reshape(shape, order="F" if fortran else "C")


LARGEST_NUMBER = 1e9
"""Every number of a description in TOML is smaller, in SI units; limits of effort and stiffness included."""
LONGEST_TEXT = 200
"""Largest number of characters of a name or text of such a description [1]."""

Table = dict[str, Any]
"""A table of a TOML file."""
Keys = Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]
"""Required and optional keys by kind of table."""


class TomlTables:
    """Checks values of one file; each check returns the value, or raises an InputError that names the file.

    Args:
        path: of the file.
        known: keys that each kind of table has.
    """

    def __init__(self, path: Path, known: Keys) -> None:
        self.path, self._known = path, known

    def fail(self, text: str) -> InputError:
        """The error that says what is wrong in the file."""
        return InputError(f"{self.path}: {text}")

    def table(self, value: Any, where: str) -> Table:
        """A table."""
        if not isinstance(value, dict):
            raise self.fail(f"{where} must be a table.")
        return value

    def keys(self, value: Any, kind: str, where: str) -> Table:
        """A table of a kind, without unknown keys, and with those that are required."""
        required, optional = self._known[kind]
        table = self.table(value, where)
        for key in table:
            if key not in required + optional:
                raise self.fail(f"{where} has the unknown key {shown(key)}; known: {', '.join(required + optional)}.")
        for key in required:
            if key not in table:
                raise self.fail(f"{where} lacks the key {key!r}; add it.")
        return table

    def text(self, value: Any, where: str, printable: bool = False) -> str:
        """A text that is neither empty nor long, and can be printed if that is asked for."""
        if not isinstance(value, str) or not 0 < len(value) <= LONGEST_TEXT or (printable and not value.isprintable()):
            kind = "a text that can be printed," if printable else "a text"
            raise self.fail(f"{where} must be {kind} of 1 to {LONGEST_TEXT} characters.")
        return value

    def one_of(self, value: Any, known: tuple[str, ...], where: str) -> Any:
        """One of the known values."""
        if value not in known:
            raise self.fail(f"{where} is {shown(value)}; choose one of: {', '.join(known)}.")
        return value

    def numbers(self, value: Any, length: int, where: str) -> tuple[float, ...]:
        """Finite numbers in a list of this length."""
        if not isinstance(value, list) or len(value) != length:
            raise self.fail(f"{where} must be a list of {length} numbers.")
        if not all(isinstance(each, int | float) and not isinstance(each, bool) for each in value):
            raise self.fail(f"{where} must be numbers.")
        if not all(abs(each) < LARGEST_NUMBER for each in value):
            raise self.fail(f"{where} must be finite numbers below {LARGEST_NUMBER:g}.")
        return tuple(float(each) for each in value)

    def positive(self, value: Any, where: str) -> float:
        """A positive number."""
        if (number := self.numbers([value], 1, where)[0]) <= 0:
            raise self.fail(f"{where} is {number}; it must be positive.")
        return number
