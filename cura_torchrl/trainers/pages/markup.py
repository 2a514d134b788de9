"""HTML that pages share: one file with its style, and the pictures, tables and facts in it."""

from __future__ import annotations

import base64
from html import escape
from string import Template
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence

_DOCUMENT = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light dark; --ink: #1f2328; --soft: #59636e; --paper: #ffffff; --card: #f6f8fa; --line: #d1d9e0;
  --robot: #1a9850; --object: #c51b8a; --good: #11763c; --bad: #b42318; --slow: #8a6100;
  --link: #0b57a4; --mark: #fff3c4; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6edf3; --soft: #9da7b1; --paper: #0d1117; --card: #161b22; --line: #30363d;
    --robot: #3fbf76; --object: #f06abf; --good: #4cc38a; --bad: #ff8f85; --slow: #e0b04b;
    --link: #79b8ff; --mark: #3a3212; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 1080px; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .75rem; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .5rem; }
h3 { font-size: 1rem; margin: 0 0 .6rem; }
p { max-width: 74ch; margin: .5rem 0; }
.robot { color: var(--robot); font-weight: 600; } .object { color: var(--object); font-weight: 600; }
.soft, figcaption, caption { color: var(--soft); font-size: .875rem; }
article { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 1rem; margin: 1rem 0; }
img { display: block; width: 100%; height: auto; background: #fff; border-radius: 6px; }
details { margin-top: .75rem; } summary { cursor: pointer; font-weight: 600; margin-bottom: .5rem; }
.table { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; margin: .75rem 0 0; font-size: .9rem;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; caption-side: bottom; padding-top: .4rem; }
th, td { padding: .35rem .5rem; border-bottom: 1px solid var(--line); text-align: right; }
td { white-space: nowrap; } th { font-weight: 600; vertical-align: bottom; }
th:first-child, td:first-child, .word { text-align: left; }
.success { color: var(--good); } .collision { color: var(--bad); } .time-out { color: var(--slow); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1rem; font-size: .9rem; margin: .5rem 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
nav ul { display: flex; flex-wrap: wrap; gap: .3rem 1.25rem; list-style: none; margin: 1rem 0; padding: 0; }
a { color: var(--link); }
.text { text-align: left; white-space: normal; overflow-wrap: anywhere; min-width: 6rem; }
.marked td { font-weight: 600; background: var(--mark); }
.changed { font-weight: 600; } .changed::before { content: "\\2260\\00a0"; }
details details { margin-left: 1rem; }
pre { overflow-x: auto; background: var(--card); padding: .6rem; border-radius: 6px; }
@media print {
  body { max-width: none; padding: 0; font-size: 11px; }
  article, figure, img, tr { break-inside: avoid; } h2, h3 { break-after: avoid; }
  nav { display: none; } details::details-content { content-visibility: visible; block-size: auto; }
  .table { overflow: visible; } td { white-space: normal; } }
</style>
</head>
<body>
<header>
<h1>$title</h1>
$introduction
</header>
<main>
$main
</main>
<footer>
<h2>How this was made</h2>
$facts
</footer>
</body>
</html>
""")


def document(*, title: str, introduction: str, main: str, facts: Mapping[str, str]) -> str:
    """Return a page.

    Args:
        title: Title, plain text.
        introduction: HTML below the title.
        main: HTML of the page's sections.
        facts: What the page was made with, by name, plain text.

    Returns:
        HTML of a whole document; it refers to nothing outside if its parts do not.
    """
    return _DOCUMENT.substitute(title=escape(title), introduction=introduction, main=main, facts=definitions(facts))


def definitions(facts: Mapping[str, str]) -> str:
    """Return a list of facts.

    Args:
        facts: Texts by name, plain.

    Returns:
        An HTML list.

    Examples:
        >>> definitions({"Seed": "<3>"})
        '<dl><dt>Seed</dt><dd>&lt;3&gt;</dd></dl>'
    """
    entries = (f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items())
    return f"<dl>{''.join(entries)}</dl>"


def image(content: bytes, kind: str, text: str) -> str:
    """Return a picture that lies in the page itself.

    Args:
        content: Content of the picture's file.
        kind: Its media type after ``image/``, such as png.
        text: What it shows, for those who do not see it; plain text.

    Returns:
        An HTML element.

    Examples:
        >>> image(b"abc", "png", 'a "b"')
        '<img src="data:image/png;base64,YWJj" alt="a &quot;b&quot;">'
    """
    data = base64.b64encode(content).decode("ascii")
    return f'<img src="data:image/{kind};base64,{data}" alt="{escape(text, quote=True)}">'


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    caption: str = "",
    texts: Collection[int] = (0,),
    marked: Collection[int] = (),
) -> str:
    """Return a table.

    Args:
        head: Names of the columns, plain text.
        rows: Cells of each row, plain text.
        caption: What the table holds, plain text; nothing leaves it out.
        texts: Columns that hold words, set from the left and wrapped; the others hold numbers.
        marked: Rows that stand out.

    Returns:
        An HTML table in a box that scrolls sideways where there is no room.

    Examples:
        >>> table(["a"], [["1 < 2"]], texts=()).partition("<tbody>")[2]
        '<tr><td>1 &lt; 2</td></tr></tbody></table></div>'
    """
    lines = []
    for number, row in enumerate(rows):
        cells = "".join(f"<td{_text_class(column in texts)}>{escape(cell)}</td>" for column, cell in enumerate(row))
        start = '<tr class="marked">' if number in marked else "<tr>"
        lines.append(f"{start}{cells}</tr>")
    names = "".join(f"<th{_text_class(column in texts)}>{escape(name)}</th>" for column, name in enumerate(head))
    told = f"<caption>{escape(caption)}</caption>" if caption else ""
    body = f"<thead><tr>{names}</tr></thead><tbody>{''.join(lines)}</tbody>"
    return f'<div class="table"><table>{told}{body}</table></div>'


def _text_class(is_text: bool) -> str:
    return ' class="text"' if is_text else ""
