"""Lists on the command line: one entry after the other, or joined by commas."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, Annotated, TypeAlias

from tyro.constructors import PrimitiveConstructorSpec

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable


def split_names(names: Iterable[str]) -> tuple[str, ...]:
    """Return names, each once, those that are joined by commas apart.

    Args:
        names: Entries of the command line.

    Returns:
        The names in the order in which they were given.

    Examples:
        >>> split_names(["push,cura-ppo", "push"])
        ('push', 'cura-ppo')
    """
    return tuple(dict.fromkeys(part.strip() for name in names for part in name.split(",") if part.strip()))


def require_known(what: str, name: str, names: Collection[str], *, otherwise: str = "") -> None:
    """Raise a one-line error, with the name that was probably meant, unless a name is one of those that are accepted.

    Args:
        what: What is named.
        name: What was given.
        names: What is accepted.
        otherwise: What is accepted beside the names, in words.

    Raises:
        ValueError: If ``name`` is not one of ``names``.

    Examples:
        >>> require_known("method", "cura-pro", ["push", "cura-ppo"])
        Traceback (most recent call last):
        ValueError: method is 'cura-pro' (did you mean cura-ppo?); accepted: push, cura-ppo
    """
    if name not in names:
        close = difflib.get_close_matches(name, names, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        msg = f"{what} is {name!r}{hint}; accepted: {', '.join(names)}{otherwise}"
        raise ValueError(msg)


def _numbers(entries: list[str]) -> tuple[int, ...]:
    return tuple(int(part) for part in split_names(entries))


Numbers: TypeAlias = Annotated[
    tuple[int, ...],
    PrimitiveConstructorSpec(
        nargs="*",
        metavar="INT [INT ...]",
        instance_from_str=_numbers,
        is_instance=lambda value: isinstance(value, tuple) and all(isinstance(entry, int) for entry in value),
        str_from_instance=lambda value: [str(entry) for entry in value],
    ),
]
"""Whole numbers, each once."""
