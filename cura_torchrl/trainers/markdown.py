"""The Markdown that this package writes, as HTML: headings, paragraphs, lists, tables, pictures, code."""

from __future__ import annotations

import re
from html import escape
from typing import TYPE_CHECKING

from cura_torchrl.trainers import markup

if TYPE_CHECKING:
    from collections.abc import Callable

_PICTURE = re.compile(r"!\[(?P<text>[^\]]*)\]\((?P<file>[^)\s]+)\)")
_LINK = re.compile(r"\[(?P<text>[^\]]+)\]\([^)\s]+\)")
_NUMBER = re.compile(r"[-+]?\d")
_RULE = re.compile(r"\|?[\s:|-]*-[\s:|-]*\|?")


def to_html(text: str, picture: Callable[[str, str], str], *, marked: str | None = None, below: int = 2) -> str:
    r"""Return Markdown as HTML.

    Args:
        text: Markdown. Links become their text, for a page refers to nothing outside; other HTML is shown as it is.
        picture: Returns the HTML of a picture, of its file's name and its text.
        marked: Rows of tables whose first cell is this stand out.
        below: Level of the heading that the text stands under [1]; its own first level is the next one.

    Returns:
        HTML.

    Examples:
        >>> to_html("# Rates\n\nOf *all* `cells`.\n\n- a\n- b", lambda file, text: "")
        '<h3>Rates</h3>\n<p>Of <em>all</em> <code>cells</code>.</p>\n<ul><li>a</li><li>b</li></ul>'
    """
    return "\n".join(_block(block, picture, marked, below) for block in _blocks(text))


def _blocks(text: str) -> list[str]:
    """Return paragraphs, lists, tables and headings; what is between fences stays together."""
    blocks = []
    for number, part in enumerate(re.split(r"^```.*$", text, flags=re.MULTILINE)):
        if number % 2 == 1:
            blocks.append(f"```{part.strip(chr(10))}")
            continue
        apart = re.sub(r"^(#+ .*)$", r"\n\1\n", part, flags=re.MULTILINE)
        blocks += [block.strip() for block in re.split(r"\n\s*\n", apart) if block.strip()]
    return blocks


def _block(block: str, picture: Callable[[str, str], str], marked: str | None, below: int) -> str:
    lines = block.splitlines()
    if block.startswith("```"):
        return f"<pre><code>{escape(block[3:])}</code></pre>"
    if heading := re.fullmatch(r"(#+) (.*)", block):
        level = min(6, below + len(heading[1]))
        return f"<h{level}>{_inline(heading[2], picture)}</h{level}>"
    if len(lines) > 1 and "|" in lines[0] and _RULE.fullmatch(lines[1].strip()):
        return _table(lines, marked)
    if lines[0].startswith(("- ", "* ")):
        entries = re.split(r"^[-*] ", block, flags=re.MULTILINE)[1:]
        return f"<ul>{''.join(f'<li>{_inline(entry.strip(), picture)}</li>' for entry in entries)}</ul>"
    return f"<p>{_inline(block, picture)}</p>"


def _table(lines: list[str], marked: str | None) -> str:
    rows = [[_plain(cell) for cell in re.split(r"(?<!\\)\|", line.strip().strip("|"))] for line in lines]
    head, body = rows[0], rows[2:]
    texts = [
        column
        for column in range(len(head))
        if column == 0 or not any(_NUMBER.match(row[column]) for row in body if column < len(row))
    ]
    stand_out = [number for number, row in enumerate(body) if row[0] == marked]
    return markup.table(head, body, texts=texts, marked=stand_out)


def _plain(cell: str) -> str:
    return re.sub(r"[*`]", "", _LINK.sub(r"\g<text>", cell)).replace("\\|", "|").strip()


def _inline(text: str, picture: Callable[[str, str], str]) -> str:
    """Return a line with its pictures, code and emphasis."""
    pictures = [picture(found["file"], found["text"]) for found in _PICTURE.finditer(text)]
    shown = escape(_LINK.sub(r"\g<text>", _PICTURE.sub("\0", text)), quote=False)
    shown = re.sub(r"`([^`]+)`", r"<code>\1</code>", shown)
    shown = re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", shown)
    shown = re.sub(r"(?<![\w*])\*([^*\s][^*]*)\*(?![\w*])", r"<em>\1</em>", shown)
    for found in pictures:
        shown = shown.replace("\0", found, 1)
    return shown
