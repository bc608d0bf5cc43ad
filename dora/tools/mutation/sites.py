"""Where a source can be mutated, and how: a table of operators over its syntax tree, edits by position in its text."""

import ast
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from dora.digests import digest_of

Edit = tuple[int, int, str]
"""First byte, end and new text of what is replaced in a source."""

COMPARISONS: dict[type[ast.AST], tuple[str, tuple[str, ...]]] = {
    ast.Lt: ("<", (">", "<=")), ast.Gt: (">", ("<", ">=")), ast.LtE: ("<=", (">=", "<")), ast.GtE: (">=", ("<=", ">")),
    ast.Eq: ("==", ("!=",)), ast.NotEq: ("!=", ("==",)), ast.Is: ("is", ("is not",)), ast.IsNot: ("is not", ("is",)),
    ast.In: ("in", ("not in",)), ast.NotIn: ("not in", ("in",)),
}  # fmt: skip
"""Symbol of a comparison and what replaces it: its opposite, then its neighbour, for whole numbers alone."""
ARITHMETIC: dict[type[ast.AST], tuple[str, str]] = {
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
}  # fmt: skip
"""Symbol of an operation on numbers and what replaces it."""
LOGIC: dict[type[ast.AST], tuple[str, str]] = {
    ast.And: ("and", "or"), ast.Or: ("or", "and"), ast.BitAnd: ("&", "|"), ast.BitOr: ("|", "&"),
}  # fmt: skip
"""Symbol of an operation on truth values and what replaces it."""
UNARY: dict[type[ast.AST], tuple[str, str]] = {
    ast.Not: ("not", "dropped not"), ast.Invert: ("~", "dropped ~"), ast.USub: ("-", "dropped sign")
}  # fmt: skip
"""Symbol of an operation that is dropped, and the operator's name."""
PAIRS = (
    ("min", "max"), ("amin", "amax"), ("minimum", "maximum"), ("argmin", "argmax"), ("any", "all"),
    ("logical_and", "logical_or"),
)  # fmt: skip
"""Functions that take each other's place."""
SWAPPED = dict(PAIRS) | {second: first for first, second in PAIRS}
"""Name of a function and of the one that replaces it."""
BOUNDS = {"min": "max", "max": "min"}
"""Bound of `clamp` and the one that replaces it."""
RETURNS = {"bool": ("True", "False"), "int": ("0",), "float": ("0.0",), "str": ('""',)}
"""What a function returns instead, by its annotation."""

SKIPPED_FIELDS = {"decorator_list", "annotation", "returns", "bases"}
"""Parts of a node that are never mutated."""
SKIPPED_NODES = (ast.Import, ast.ImportFrom, ast.Raise, ast.Assert, ast.JoinedStr)
"""Nodes that are never mutated: what they say is no behaviour, or a check of types."""
SKIPPED_CALLS = {
    "print", "warn", "debug", "info", "warning", "error", "exception", "say", "cast", "isinstance", "TypeVar",
    "get_close_matches",
}  # fmt: skip
"""Functions whose calls are never mutated."""
LOOKS = re.compile("visual|light|camera")
"""What the names of functions contain that only change how a scene looks."""
SKIPPED_KEYWORDS = {
    "doc", "strict", "stable", "parents", "exist_ok", "missing_ok", "text", "check", "capture_output", "force",
    "timeout", "indent", "daemon", "kw_only", "num_sub_threads", "auto_register_policy_transforms",
}  # fmt: skip
"""Arguments that are never mutated: most often no behaviour depends on them."""
SMALLEST, LARGEST = 1e-5, 10_000
"""Numbers below are guards against a division by zero, larger ones masks and seeds: changing them shows nothing [1]."""


@dataclass(frozen=True)
class Mutant:
    """A fault of a module.

    Attributes:
        module: path of the module, below the repository's root.
        line: of the fault, from 1.
        before: this line as it is, stripped.
        after: this line with the fault, stripped.
        operator: what has been done.
        edit: where it is done.
        digest: of the whole source without the fault.
    """

    module: str
    line: int
    before: str
    after: str
    operator: str
    edit: Edit
    digest: str

    @property
    def key(self) -> str:
        """Tells the mutant from all others, also from those of another state of the module."""
        return digest_of((self.module, self.edit, self.digest))

    def applied(self, source: str) -> str:
        """The module's source with the fault."""
        return _edited(source.encode(), self.edit)


def _edited(raw: bytes, edit: Edit) -> str:
    start, end, new = edit
    return (raw[:start] + new.encode() + raw[end:]).decode()


class _Text:
    """A source as bytes, in which the tree's positions are counted."""

    def __init__(self, source: str):
        self.raw = source.encode()
        self._lines = [0]
        for line in self.raw.split(b"\n"):
            self._lines.append(self._lines[-1] + len(line) + 1)

    def start(self, node: ast.AST) -> int:
        return self._lines[node.lineno - 1] + node.col_offset  # pyright: ignore[reportAttributeAccessIssue]

    def end(self, node: ast.AST) -> int:
        return self._lines[node.end_lineno - 1] + node.end_col_offset  # pyright: ignore[reportAttributeAccessIssue]

    def between(self, left: ast.AST, right: ast.AST, symbol: str) -> tuple[int, int]:
        """Where an operation's symbol stands between its operands, besides brackets and comments."""
        first = self.end(left)
        gap = re.sub(rb"#[^\n]*", lambda found: b" " * len(found[0]), self.raw[first : self.start(right)])
        found = re.search(rb"\s+".join(re.escape(part.encode()) for part in symbol.split()), gap)
        assert found is not None
        return first + found.start(), first + found.end()


@dataclass(frozen=True)
class _Place:
    """Where a node is: inside a function, and what that returns by its annotation."""

    inside: bool = False
    returns: str = ""


Finder = Callable[[_Text, ast.AST, _Place], Iterator[tuple[str, Edit]]]
"""Faults that an operator makes of a node: name and edit."""


def _whole(node: ast.AST) -> bool:
    """Whether a value is surely a whole number, so that a bound is met exactly; of 0 that is unknown."""
    if isinstance(node, ast.Call):
        return _called(node) == "len"
    return isinstance(node, ast.Constant) and type(node.value) is int and node.value != 0


def _comparisons(text: _Text, node: ast.AST, place: _Place) -> Iterator[tuple[str, Edit]]:
    assert isinstance(node, ast.Compare)
    for left, kind, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
        symbol, others = COMPARISONS[type(kind)]
        where = text.between(left, right, symbol)
        yield "comparison", (*where, others[0])
        if len(others) > 1 and (_whole(left) or _whole(right)):
            yield "boundary", (*where, others[1])


def _binary(text: _Text, node: ast.AST, place: _Place) -> Iterator[tuple[str, Edit]]:
    """Operations inside functions alone, as numbers; texts and lists have no other operation."""
    assert isinstance(node, ast.BinOp | ast.AugAssign)
    left, right = (node.left, node.right) if isinstance(node, ast.BinOp) else (node.target, node.value)
    sequences = ast.List | ast.Tuple | ast.ListComp | ast.JoinedStr | ast.Dict | ast.Set
    for side in (left, right):
        if isinstance(side, sequences) or (isinstance(side, ast.Constant) and isinstance(side.value, str | None)):
            return
    for name, table in (("arithmetic", ARITHMETIC), ("logic", LOGIC)):
        if type(node.op) in table and place.inside:
            symbol, other = table[type(node.op)]
            yield name, (*text.between(left, right, symbol), other)


def _boolean(text: _Text, node: ast.AST, place: _Place) -> Iterator[tuple[str, Edit]]:
    assert isinstance(node, ast.BoolOp)
    symbol, other = LOGIC[type(node.op)]
    for left, right in zip(node.values, node.values[1:], strict=False):
        yield "logic", (*text.between(left, right, symbol), other)


def _unary(text: _Text, node: ast.AST, place: _Place) -> Iterator[tuple[str, Edit]]:
    assert isinstance(node, ast.UnaryOp)
    if type(node.op) in UNARY and not isinstance(node.operand, ast.Constant):
        symbol, name = UNARY[type(node.op)]
        start = text.start(node)
        rest = text.raw[start + len(symbol) :]
        yield name, (start, start + len(symbol) + len(rest) - len(rest.lstrip(b" ")), "")


def _constant(text: _Text, node: ast.AST, place: _Place) -> Iterator[tuple[str, Edit]]:
    """Truth values, and numbers inside functions: those outside are settings, which may have any value."""
    assert isinstance(node, ast.Constant)
    value, where = node.value, (text.start(node), text.end(node))
    if isinstance(value, bool):
        yield "truth value", (*where, str(not value))
    elif isinstance(value, int | float) and place.inside and (value == 0 or SMALLEST <= value <= LARGEST):
        new = value + 1 if isinstance(value, int) or value == 0 else 2 * value
        yield "number", (*where, repr(new))


def _called(node: ast.Call) -> str:
    """Name of the function that is called, without what it is a part of."""
    if isinstance(node.func, ast.Attribute):
        return node.func.attr
    return node.func.id if isinstance(node.func, ast.Name) else ""


def _calls(text: _Text, node: ast.AST, place: _Place) -> Iterator[tuple[str, Edit]]:
    assert isinstance(node, ast.Call)
    name = _called(node)
    if name in SWAPPED:
        end = text.end(node.func)
        yield "function", (end - len(name), end, SWAPPED[name])
    bounds = [word for word in node.keywords if word.arg in BOUNDS]
    if name.startswith("clamp") and len(bounds) == 1:
        word = bounds[0]
        assert word.arg is not None
        yield "bound", (text.start(word), text.start(word) + len(word.arg), BOUNDS[word.arg])


def _returned(text: _Text, node: ast.AST, place: _Place) -> Iterator[tuple[str, Edit]]:
    assert isinstance(node, ast.Return)
    if node.value is not None and not isinstance(node.value, ast.Constant):
        for constant in RETURNS.get(place.returns, ()):
            yield "returned constant", (text.start(node), text.end(node), f"return {constant}")


OPERATORS: dict[type[ast.AST], Finder] = {
    ast.Compare: _comparisons, ast.BinOp: _binary, ast.AugAssign: _binary, ast.BoolOp: _boolean, ast.UnaryOp: _unary,
    ast.Constant: _constant, ast.Call: _calls, ast.Return: _returned,
}  # fmt: skip
"""What finds the faults of a kind of node."""


def _skipped(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return _called(node) in SKIPPED_CALLS or LOOKS.search(_called(node)) is not None
    if isinstance(node, ast.keyword):
        return node.arg in SKIPPED_KEYWORDS
    if isinstance(node, ast.If):
        return any(isinstance(n, ast.Name) and n.id in ("TYPE_CHECKING", "__name__") for n in ast.walk(node.test))
    return isinstance(node, SKIPPED_NODES)


def _is_setting(node: ast.AST, place: _Place) -> bool:
    """Whether a node gives a field of a class its default, such as `stagger: bool = True`."""
    return isinstance(node, ast.AnnAssign) and isinstance(node.value, ast.Constant) and not place.inside


def _walk(node: ast.AST, place: _Place) -> Iterator[tuple[ast.AST, _Place]]:
    """All nodes that may be mutated, and where they are."""
    if _skipped(node) or _is_setting(node, place):
        return
    yield node, place
    for name, value in ast.iter_fields(node):
        if name in SKIPPED_FIELDS:
            continue
        there = place
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) and name == "body":
            annotation = getattr(node, "returns", None)
            there = _Place(True, annotation.id if isinstance(annotation, ast.Name) else "")
        elif isinstance(node, ast.arguments | ast.ClassDef):
            there = _Place()
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _walk(child, there)


def mutants_of(module: str, source: str) -> list[Mutant]:
    """All faults that the operators make of a module, in the order of its text."""
    text, digest, found = _Text(source), digest_of(source), []
    for node, place in _walk(ast.parse(source), _Place()):
        if type(node) in OPERATORS:
            for operator, edit in OPERATORS[type(node)](text, node, place):
                row = text.raw[: edit[0]].count(b"\n")
                before, after = (words.split("\n")[row].strip() for words in (source, _edited(text.raw, edit)))
                found.append(Mutant(module, row + 1, before, after, operator, edit, digest))
    return sorted(found, key=lambda mutant: (mutant.edit, mutant.operator))
