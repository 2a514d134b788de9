"""Markdown as HTML: what the package's own pages use."""

from __future__ import annotations

from cura_torchrl.trainers.pages.markdown import to_html
from tests.pages import Reader


def no_picture(file: str, text: str) -> str:
    """Return nothing for a picture."""
    return ""


def test_tables_keep_their_cells_and_mark_a_row() -> None:
    """Catches a table that is shown as text, its rule shown as a row, and a method that does not stand out."""
    page = to_html("| Method | p |\n|---|---:|\n| `a` | 0.5 |\n| b \\| c | - |", no_picture, marked="a")
    assert Reader(page).rows == [["Method", "p"], ["a", "0.5"], ["b | c", "-"]]
    assert page.count('<tr class="marked">') == 1


def test_headings_stand_below_the_sections_own() -> None:
    """Catches two headings of one level, and a heading that swallows the paragraph after it."""
    page = to_html("# One\ntext\n## Two", no_picture, below=2)
    assert page == "<h3>One</h3>\n<p>text</p>\n<h4>Two</h4>"


def test_text_is_escaped_and_links_lead_nowhere() -> None:
    """Catches HTML that comes through, and a page that refers to something outside."""
    page = to_html("1 < 2 & [**here**](https://example.org) `a<b`", no_picture)
    assert page == "<p>1 &lt; 2 &amp; <strong>here</strong> <code>a&lt;b</code></p>"


def test_code_is_kept_line_by_line() -> None:
    """Catches a command whose lines are joined, or whose hash sign becomes a heading."""
    page = to_html("```bash\n# a\n\nb\n```", no_picture)
    assert page == '<pre><code class="language-bash"># a\n\nb\n</code></pre>'


def test_pictures_are_asked_for_by_file_and_text() -> None:
    """Catches a picture that is shown by its name only."""
    page = to_html("![Risk *r*](a.png)\n\n![Two](b.svg)", lambda file, text: f"[{file}: {text}]")
    assert page == "<p>[a.png: Risk *r*]</p>\n<p>[b.svg: Two]</p>"
