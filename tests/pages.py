"""Reading pages back."""

from __future__ import annotations

from html.parser import HTMLParser


class Reader(HTMLParser):
    """Collects what a page refers to, its pictures, the cells of its tables, and tags that are not balanced."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.references: list[str] = []
        self.tags: list[str] = []
        self.rows: list[list[str]] = []
        self.open: list[str] = []
        self.misnested: list[str] = []
        self.without_text: list[str] = []
        self.ids: list[str] = []
        self._is_cell = False
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note references and the start of rows and cells."""
        self.tags.append(tag)
        if tag not in {"meta", "img", "br"}:
            self.open.append(tag)
        given = dict(attrs)
        self.ids += [given["id"]] if given.get("id") else []
        if tag == "img" and not given.get("alt"):
            self.without_text.append(given.get("src") or "")
        self.references += [value or "" for name, value in attrs if name in {"src", "href", "srcset", "data", "poster"}]
        if tag == "tr":
            self.rows.append([])
        self._is_cell = tag in {"td", "th"}
        if self._is_cell:
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        """Note the end of a cell, and of what was not begun last."""
        if not self.open or self.open.pop() != tag:
            self.misnested.append(tag)
        self._is_cell &= tag not in {"td", "th"}

    def handle_data(self, data: str) -> None:
        """Add text to the cell."""
        if self._is_cell:
            self.rows[-1][-1] += data
