"""One-line errors that say what was wrong, what was given and what is accepted."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, Literal, get_args, get_origin, get_type_hints


def require(condition: bool, what: str, value: object, accepted: str) -> None:
    """Raise a one-line error unless a configuration value is acceptable.

    Args:
        condition: Whether the value is acceptable.
        what: Name of the field.
        value: The value that was given.
        accepted: The values that are accepted, in words.

    Raises:
        ValueError: If ``condition`` is false.

    Examples:
        >>> require(-1 > 0, "episode_time", -1, "a positive number of seconds")
        Traceback (most recent call last):
        ValueError: episode_time is -1; accepted: a positive number of seconds
    """
    if not condition:
        msg = f"{what} is {value!r}; accepted: {accepted}"
        raise ValueError(msg)


def require_choice(name: str, value: str, accepted: tuple[str, ...]) -> None:
    """Raise unless a value is one of several.

    Args:
        name: What it is.
        value: The value.
        accepted: The values that are accepted; any other is refused with a ValueError.
    """
    require(value in accepted, name, value, ", ".join(map(repr, accepted)))


def require_finite(**values: float) -> None:
    """Raise unless numbers are finite.

    Args:
        **values: Numbers by name; NaN or an infinite one is refused with a ValueError.
    """
    for name, value in values.items():
        require(math.isfinite(value), name, value, "a finite number")


def require_unit(**values: float) -> None:
    """Raise unless numbers lie between 0 and 1, both included.

    Args:
        **values: Numbers by name; any other is refused with a ValueError.
    """
    for name, value in values.items():
        require(0.0 <= value <= 1.0, name, value, "0 to 1")


def require_positive(**values: float) -> None:
    """Raise unless numbers are positive.

    Args:
        **values: Numbers by name; any other is refused with a ValueError.
    """
    for name, value in values.items():
        require(value > 0.0, name, value, "a positive number")


def require_fields(config: object) -> None:
    """Raise unless every number in a dataclass is finite, and every choice is one that its type names.

    Args:
        config: A dataclass instance; nested tuples are looked into, nested dataclasses look after themselves.

    Raises:
        ValueError: If a number is NaN or infinite, or a field whose type is a ``Literal`` has another value.

    Examples:
        >>> from cura_torchrl.envs.config import PushEnvConfig
        >>> PushEnvConfig(simulator="Planar")
        Traceback (most recent call last):
        ValueError: PushEnvConfig.simulator is 'Planar'; accepted: bullet, planar
    """  # noqa: DOC502 - raised by what this calls
    choices = _choices(type(config))  # type: ignore[arg-type]
    for item in dataclasses.fields(config):  # type: ignore[arg-type]
        value, name = getattr(config, item.name), f"{type(config).__name__}.{item.name}"
        for number in _leaves(value):
            if isinstance(number, float):
                require(math.isfinite(number), name, value, "finite numbers")
        accepted = choices.get(item.name, ())
        if accepted and value is not None:
            is_known = all(leaf in accepted for leaf in _leaves(value))
            require(is_known, name, value, ", ".join(map(str, accepted)))


@functools.cache
def _choices(config: Any) -> dict[str, tuple[Any, ...]]:
    """Return what is accepted by the name of the field, where its type names it."""
    return {name: found for name, hint in get_type_hints(config).items() if (found := _literals(hint))}


def _literals(hint: Any) -> tuple[Any, ...]:
    if get_origin(hint) is Literal:
        return get_args(hint)
    return tuple(value for part in get_args(hint) for value in _literals(part))


def _leaves(value: object) -> list[object]:
    return [leaf for entry in value for leaf in _leaves(entry)] if isinstance(value, tuple) else [value]
