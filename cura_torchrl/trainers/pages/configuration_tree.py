"""A configuration as a tree to read: every field with its value, its default, and what it means."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import textwrap
from html import escape
from typing import Any

from cura_torchrl.trainers.decoding import changed_fields, encode
from cura_torchrl.trainers.pages import markup


def field_docstrings(cls: type[Any]) -> dict[str, str]:
    """Return the docstrings of a dataclass's own fields, which Python itself does not keep.

    Args:
        cls: A dataclass whose source can be read.

    Returns:
        Docstrings in one line by field; empty where the source is not there.

    Examples:
        >>> from cura_torchrl.trainers.config import PPOConfig
        >>> field_docstrings(PPOConfig)["clip_epsilon"]
        'Clip of the probability ratio [1].'
    """
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(cls)))
    except (OSError, TypeError):
        return {}
    body = tree.body[0].body if isinstance(tree.body[0], ast.ClassDef) else []
    found = {}
    for node, after in itertools.pairwise(body):
        name = node.target.id if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) else None
        if name is not None and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            found[name] = " ".join(str(after.value.value).split()).replace("``", "")
    return found


def count_differences(config: Any, other: Any) -> int:
    """Return in how many fields, nested ones included, two configurations of a class differ.

    Args:
        config: A dataclass instance.
        other: Another one of the same class.

    Returns:
        Number of fields [1].

    Examples:
        >>> from cura_torchrl.trainers.config import CURAConfig, TrainConfig
        >>> count_differences(TrainConfig(cura=CURAConfig(gamma=0.5), seed=1), TrainConfig())
        2
    """
    return len(changed_fields(config, other))


def configuration_tree(config: Any, preset: Any) -> str:
    """Return a configuration as nested parts that open at a click; parts that differ from the preset are open.

    Args:
        config: A dataclass instance.
        preset: What it is compared with, of the same class.

    Returns:
        HTML.
    """
    return _part("", config, preset)


def _part(path: str, config: Any, preset: Any) -> str:
    docstrings = field_docstrings(type(config))
    rows, parts = [], []
    for item in dataclasses.fields(config):
        value, other = getattr(config, item.name), getattr(preset, item.name)
        name = f"{path}{item.name}"
        if dataclasses.is_dataclass(value) and type(value) is type(other):
            parts.append(_folded(name, docstrings.get(item.name, ""), value, other))
        else:
            shown = _text(value)
            differs = "" if value == other else _text(other)
            rows.append((item.name, shown, differs, docstrings.get(item.name, "")))
    changed = [number for number, row in enumerate(rows) if row[2]]
    head = ("Field", "Value", "In the preset", "Meaning [unit]")
    table = markup.table(head, rows, texts=range(4), marked=changed) if rows else ""
    return table + "".join(parts)


def _folded(name: str, docstring: str, config: Any, preset: Any) -> str:
    count = count_differences(config, preset)
    note = f", {count} unlike the preset" if count else ""
    start = "<details open>" if count else "<details>"
    title = f"<code>{escape(name)}</code> <span class='soft'>{escape(docstring)}{note}</span>"
    return f"{start}<summary>{title}</summary>{_part(f'{name}.', config, preset)}</details>"


def _text(value: Any) -> str:
    """Return a value as it stands in config.json, numbers short."""
    plain = encode(value)
    if plain is None:
        return "none"
    if isinstance(plain, list):
        return f"({', '.join(_text(entry) for entry in plain)})"
    return f"{plain:,}" if isinstance(plain, int) and not isinstance(plain, bool) else str(plain)
