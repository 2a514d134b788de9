"""Strict, typed conversion between frozen dataclasses and JSON values.

An error is one line: the path of the key, the value, and what is accepted. No class is ever looked up by name, so
that a file can only fill fields in.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")


def encode(value: Any) -> Any:
    """Return a dataclass as JSON-compatible values.

    Args:
        value: A dataclass instance, or a value one of its fields may hold.

    Returns:
        Dictionaries, lists, strings, numbers, booleans and None.

    Examples:
        >>> encode((Path("a"), 1.5))
        ['a', 1.5]
    """
    if dataclasses.is_dataclass(value):
        return {item.name: encode(getattr(value, item.name)) for item in dataclasses.fields(value)}
    if isinstance(value, (tuple, list)):
        return [encode(entry) for entry in value]
    if isinstance(value, Path):
        return value.as_posix()
    return value


def changed_fields(before: Any, now: Any, path: str = "") -> dict[str, tuple[Any, Any]]:
    """Return the fields, nested ones included, in which two configurations of a class differ.

    Args:
        before: A dataclass instance.
        now: Another one of the same class.
        path: Key path of the two.

    Returns:
        Both values as in JSON, by the path of the key.

    Examples:
        >>> from cura_torchrl.trainers.config import CURAConfig, TrainConfig
        >>> changed_fields(TrainConfig(), TrainConfig(cura=CURAConfig(gamma=0.5)))
        {'cura.gamma': (0.9, 0.5)}
    """
    found: dict[str, tuple[Any, Any]] = {}
    for item in dataclasses.fields(before):
        one, two, name = getattr(before, item.name), getattr(now, item.name), f"{path}{item.name}"
        if dataclasses.is_dataclass(one) and type(one) is type(two):
            found |= changed_fields(one, two, f"{name}.")
        elif one != two:
            found[name] = (encode(one), encode(two))
    return found


def decode(cls: type[T], data: object, path: str = "") -> T:
    """Build a dataclass from JSON values.

    Args:
        cls: A dataclass whose fields are numbers, strings, booleans, paths, literals, tuples or dataclasses.
        data: A dictionary; keys that are missing take their default.
        path: Key path of ``data``, for error messages.

    Returns:
        The instance.

    Raises:
        ValueError: If a key is unknown, or a value has the wrong type or is refused by the dataclass.

    Examples:
        >>> @dataclasses.dataclass(frozen=True)
        ... class Point:
        ...     x: float = 0.0
        >>> decode(Point, {"y": 1.0})
        Traceback (most recent call last):
        ValueError: y is an unknown key; accepted: x
    """
    if not isinstance(data, dict):
        raise ValueError(_refusal(path or cls.__name__, data, "an object with keys"))  # noqa: TRY004 - it is a value
    names = [item.name for item in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for key in data:
        if key not in names:
            close = difflib.get_close_matches(str(key), names, n=3) or names
            msg = f"{_join(path, str(key))} is an unknown key; accepted: {', '.join(close)}"
            raise ValueError(msg)
    hints = get_type_hints(cls)
    values = {key: _decode_value(hints[key], value, _join(path, key)) for key, value in data.items()}
    try:
        return cls(**values)
    except ValueError as error:
        msg = f"{path}: {error}" if path else str(error)
        raise ValueError(msg) from None


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _refusal(path: str, value: object, accepted: str) -> str:
    text = repr(value)
    shown = text if len(text) <= 60 else text[:57] + "..."
    return f"{path} is {shown}; accepted: {accepted}"


def _decode_value(hint: Any, value: object, path: str) -> Any:
    origin = get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return decode(hint, value, path)  # type: ignore[arg-type]
    if origin is Literal:
        return _decode_literal(get_args(hint), value, path)
    if origin is tuple:
        return _decode_tuple(get_args(hint), value, path)
    if origin in (Union, types.UnionType):
        options = [option for option in get_args(hint) if option is not type(None)]
        return None if value is None else _decode_value(options[0], value, path)
    return _decode_scalar(hint, value, path)


def _decode_literal(options: tuple[Any, ...], value: object, path: str) -> Any:
    if value not in options:
        raise ValueError(_refusal(path, value, ", ".join(map(str, options))))
    return value


def _decode_tuple(hints: tuple[Any, ...], value: object, path: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise ValueError(_refusal(path, value, "a list"))  # noqa: TRY004 - it is a value
    if hints[-1] is Ellipsis:
        hints = (hints[0],) * len(value)
    if len(hints) != len(value):
        raise ValueError(_refusal(path, value, f"a list of {len(hints)}"))
    return tuple(
        _decode_value(hint, entry, f"{path}[{i}]") for i, (hint, entry) in enumerate(zip(hints, value, strict=True))
    )


def _decode_scalar(hint: Any, value: object, path: str) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is float and is_number and math.isfinite(value):  # type: ignore[arg-type]
        return float(value)  # type: ignore[arg-type]
    if hint is int and is_number and not isinstance(value, float):
        return value
    if hint in (bool, str) and isinstance(value, hint):
        return value
    if hint is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(_refusal(path, value, _ACCEPTED.get(hint, str(hint))))


_ACCEPTED = {float: "a finite number", int: "a whole number", bool: "true or false", str: "a string", Path: "a path"}
