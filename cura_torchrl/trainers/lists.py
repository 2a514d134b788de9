"""Lists on the command line: one entry after the other, or joined by commas."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, TypeAlias

from tyro.constructors import PrimitiveConstructorSpec

if TYPE_CHECKING:
    from collections.abc import Iterable


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
