"""Configurations as frozen dataclasses: overriding fields by name, and reading them back from plain data, checked."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import dacite

from dora.errors import InputError, shown, suggestion

C = TypeVar("C")
"""A frozen dataclass whose fields are numbers, texts, tuples or such dataclasses."""


LARGEST = 1e12
"""Every number of a configuration is smaller."""
LARGEST_WHOLE = 10**300
"""Largest whole number that stands for a float."""


def _number(value: Any) -> Any:
    """Whole numbers are floats as well, if they are not too large for one; a bool is neither."""
    whole = isinstance(value, int) and not isinstance(value, bool) and abs(value) <= LARGEST_WHOLE
    return float(value) if whole else value


RULES = dacite.Config(strict=True, cast=[tuple], type_hooks={float: _number})
"""How plain data become dataclasses: unknown names and wrong types are refused, lists become tuples."""


def plain(config: Any) -> dict[str, Any]:
    """A configuration as nested dicts of plain data, for YAML and JSON; tuples become lists."""
    return {f.name: _plain(getattr(config, f.name)) for f in dataclasses.fields(config)}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return plain(value)
    return [_plain(item) for item in value] if isinstance(value, tuple | list) else value


def flat(values: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Names with dots, as on the command line, and values of nested plain data; `before` stands before every name."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{before}{name}.")
        else:
            yield before + name, value


def overridden(config: C, changes: Any, what: str) -> C:
    """A configuration with some fields replaced.

    Args:
        config: has the other values.
        changes: new values by name, nested for nested configurations; or a whole configuration of the same class.
        what: how messages call it, such as "config".

    Raises:
        InputError: naming the first field that is unknown (with the nearest known name) or of the wrong type.
    """
    if isinstance(changes, type(config)):
        return changes
    if not isinstance(changes, Mapping):
        name = type(config).__name__
        raise InputError(f"{what} must be a mapping of names to values or a {name}, not {shown(changes)}.")
    try:
        return dacite.from_dict(type(config), _merged(plain(config), changes, what), RULES)
    except (dacite.DaciteError, TypeError, ValueError) as error:
        raise _refusal(error, what) from error


def _merged(values: dict[str, Any], changes: Mapping[str, Any], where: str) -> dict[str, Any]:
    merged = dict(values)
    for name, value in changes.items():
        if name not in values:
            raise InputError(f"{where} has no field {shown(str(name))}: {suggestion(name, values)}")
        if isinstance(value, bool) and not isinstance(values[name], bool | None):
            raise InputError(f"{where}.{name} must be a number or a text, not {value}.")
        if isinstance(value, str) and isinstance(values[name], list):
            raise InputError(f"{where}.{name} must be a list, not {shown(value)}.")
        if isinstance(values[name], dict) and isinstance(value, Mapping):
            merged[name] = _merged(values[name], value, f"{where}.{name}")
        else:
            merged[name] = _plain(value)
    return merged


def _refusal(error: Exception, what: str) -> InputError:
    """What is wrong with plain data; casts raise errors of their own."""
    if isinstance(error, InputError):
        return error
    if isinstance(error, dacite.DaciteError):
        return InputError(f"{what}: {_sentence(error)}.")
    return InputError(f"{what} has a value of the wrong type ({error}): correct it.")


def _sentence(error: dacite.DaciteError) -> str:
    """What is wrong with a field, without a full stop."""
    if isinstance(error, dacite.WrongTypeError):
        wanted = getattr(error.field_type, "__name__", str(error.field_type))
        if get_origin(error.field_type) is tuple and Ellipsis not in get_args(error.field_type):
            kinds = ", ".join(getattr(kind, "__name__", str(kind)) for kind in get_args(error.field_type))
            wanted = f"{len(get_args(error.field_type))} values ({kinds})"
        return f"{error.field_path} must be {wanted}, not {shown(error.value)}"
    return str(error).rstrip(".")


def built(cls: type[C], values: Mapping[str, Any], what: str = "settings") -> C:
    """A configuration of plain data, its types checked; fields of generic types are taken as they are.

    Args:
        cls: class of the configuration.
        values: by the names of its fields.
        what: how messages call them.

    Raises:
        InputError: a name is missing or unknown, or a value has the wrong type.
    """
    known = {f.name: f for f in dataclasses.fields(cls)}  # pyright: ignore[reportArgumentType]
    hints = {name: Any if isinstance(hint, TypeVar) else hint for name, hint in get_type_hints(cls).items()}
    loose = dataclasses.make_dataclass(cls.__name__, [(n, hints[n], f) for n, f in known.items()], kw_only=True)
    for name in values:
        if name not in known:
            raise InputError(f"{what} has no field {shown(name)}: {suggestion(name, known)}")
    try:
        checked = dacite.from_dict(loose, values, RULES)
    except (dacite.DaciteError, TypeError, ValueError) as error:
        raise _refusal(error, what) from error
    return cls(**{name: getattr(checked, name) for name in known})


def check_ranges(
    config: Any, ranges: Mapping[str, tuple[int | float, int | float]], name_of: Callable[[str], str]
) -> None:
    """Refuses numbers of a configuration outside their ranges; NaN is outside of all, and None is no number.

    Args:
        config: a configuration; a field that it does not have is left out.
        ranges: lowest and highest value by field.
        name_of: how messages call a field.

    Raises:
        InputError: naming the first such number and its range.
    """
    for name, (low, high) in ranges.items():
        value = getattr(config, name, None)
        if value is not None and not low <= value <= high:
            raise InputError(f"{name_of(name)} is {shown(value)} and has to be from {low:.12g} to {high:.12g}.")


def check_finite(config: Any, what: str) -> None:
    """Refuses a configuration that holds NaN, infinity or a number as large as `LARGEST`.

    Args:
        config: a configuration, or a value of one.
        what: how messages call it.

    Raises:
        InputError: naming the first such number.
    """
    if dataclasses.is_dataclass(config):
        for f in dataclasses.fields(config):
            check_finite(getattr(config, f.name), f"{what}.{f.name}")
    elif isinstance(config, tuple | list):
        for value in config:
            check_finite(value, what)
    elif isinstance(config, int | float) and not isinstance(config, bool) and not abs(config) < LARGEST:
        raise InputError(f"{what} is {shown(config)}; it has to be a finite number below {LARGEST:g}.")


def check_not_negative(config: Any, what: str) -> None:
    """Refuses negative numbers among the fields of a configuration; tuples and nested configurations may have them.

    Raises:
        InputError: naming the first such field.
    """
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if isinstance(value, int | float) and value < 0:
            raise InputError(f"{what}.{f.name} is {value}; it cannot be negative.")
