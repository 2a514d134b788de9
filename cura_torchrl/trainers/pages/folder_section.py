"""A folder that a command wrote, as part of a page: its Markdown, with its pictures in it."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.pages import markup
from cura_torchrl.trainers.pages.markdown import to_html

_KINDS = {".png": "png", ".svg": "svg+xml", ".webp": "webp", ".gif": "gif", ".jpg": "jpeg", ".jpeg": "jpeg"}


@dataclass(frozen=True, kw_only=True)
class Folder:
    """What a command wrote."""

    path: Path
    """The folder."""
    text: str
    """Its page, Markdown."""


def read_folder(path: Path, name: str, command: str) -> Folder:
    """Return what a command wrote to a folder.

    Args:
        path: The folder.
        name: The page in it.
        command: The command that writes it.

    Returns:
        The folder with the page's text.

    Raises:
        RunError: If the page is not there or cannot be read.
    """
    try:
        text = (path / name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        msg = f"no {name} in {path}; accepted: a folder that `cura-torchrl {command}` wrote to"
        raise RunError(msg) from None
    return Folder(path=path, text=text)


def folder_html(folder: Folder, *, marked: str | None = None) -> str:
    """Return a folder's page with its pictures; those that the page does not name come last.

    Args:
        folder: The folder.
        marked: Rows of tables whose first cell is this stand out.

    Returns:
        HTML that refers to nothing outside.
    """
    named: set[str] = set()

    def picture(file: str, text: str) -> str:
        path = (folder.path / file).resolve()
        is_inside = path.is_relative_to(folder.path.resolve())
        if not is_inside or path.suffix not in _KINDS or not path.is_file():
            return f"({escape(text)})"
        named.add(path.stem)
        return _inlined(path, text)

    page = to_html(folder.text, picture, marked=marked)
    return page + "".join(
        f"<figure>{_inlined(path, _words(path.stem))}</figure>" for path in _others(folder.path, named)
    )


def _others(folder: Path, named: set[str]) -> list[Path]:
    """Return the pictures that are not named; of one in several formats the smallest file."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        is_new = path.suffix in _KINDS and path.stem not in named
        if is_new and (path.stem not in found or path.stat().st_size < found[path.stem].stat().st_size):
            found[path.stem] = path
    return list(found.values())


def _inlined(path: Path, text: str) -> str:
    return markup.image(path.read_bytes(), _KINDS[path.suffix], text or _words(path.stem))


def _words(stem: str) -> str:
    return stem.replace("_", " ").replace("-", " ").capitalize()
