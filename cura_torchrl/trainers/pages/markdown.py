"""The Markdown that this package writes, as HTML for a page that refers to nothing outside."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from markdown_it import MarkdownIt
from markdown_it.token import Token

from cura_torchrl.trainers.pages import markup

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_NUMBER = re.compile(r"[-+]?\d")


def to_html(text: str, picture: Callable[[str, str], str], *, marked: str | None = None, below: int = 2) -> str:
    r"""Return Markdown as HTML.

    Args:
        text: CommonMark with tables. Links become their text; other HTML is shown as it is.
        picture: Returns the HTML of a picture, of its file's name and its text.
        marked: Rows of tables whose first cell is this stand out.
        below: Level of the heading that the text stands under [1]; its own first level is the next one.

    Returns:
        HTML.

    Examples:
        >>> to_html("# Rates\n\nOf *all* `cells`.", lambda file, text: "")
        '<h3>Rates</h3>\n<p>Of <em>all</em> <code>cells</code>.</p>'
    """
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    for name in ("link_open", "link_close"):
        parser.add_render_rule(name, lambda *_: "")
    parser.add_render_rule("image", _picture)
    parser.add_render_rule("whole_table", lambda _, tokens, index, *__: f"{tokens[index].content}\n")
    tokens = _with_tables(parser.parse(text), marked)
    for token in tokens:
        if token.type.startswith("heading"):
            token.tag = f"h{min(6, below + int(token.tag[1]))}"
    page: str = parser.renderer.render(tokens, parser.options, {"picture": picture})
    return page.rstrip("\n")


def _picture(_: Any, tokens: Sequence[Token], index: int, __: Any, env: dict[str, Any]) -> str:
    token = tokens[index]
    drawn: str = env["picture"](str(token.attrs["src"]), token.content)
    return drawn


def _with_tables(tokens: Sequence[Token], marked: str | None) -> list[Token]:
    """Return the tokens with each table as one, in the form that all tables of a page have."""
    bounds = [index for index, token in enumerate(tokens) if token.type in {"table_open", "table_close"}]
    result: list[Token] = []
    end = 0
    for first, last in pairwise(bounds):
        if tokens[first].type == "table_open":
            result += tokens[end:first]
            result.append(Token("whole_table", "", 0, content=_table(tokens[first:last], marked)))
            end = last + 1
    return [*result, *tokens[end:]]


def _table(tokens: Sequence[Token], marked: str | None) -> str:
    rows: list[list[str]] = []
    for token in tokens:
        if token.type == "tr_open":
            rows.append([])
        elif token.type == "inline":
            rows[-1].append("".join(child.content for child in token.children or ()))
    head, body = rows[0], rows[1:]
    texts = [
        column for column in range(len(head)) if column == 0 or not any(_NUMBER.match(row[column]) for row in body)
    ]
    stand_out = [number for number, row in enumerate(body) if row[0] == marked]
    return markup.table(head, body, texts=texts, marked=stand_out)
