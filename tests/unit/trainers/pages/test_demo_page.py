"""The page holds everything it shows, and its numbers are those of the recordings."""

from __future__ import annotations

import base64
import io
import re

import pytest
from PIL import Image

from cura_torchrl.trainers.pages.demo_page import Card, make_page, summary_table
from tests.pages import Reader
from tests.recordings import make_episode, make_recording


def picture(kind: str) -> bytes:
    """Return a small picture."""
    buffer = io.BytesIO()
    Image.new("RGB", (4, 3), "red").save(buffer, kind)
    return buffer.getvalue()


def card(first: str, second: str, *, index: int, adversarial: bool = True, **changes: object) -> Card:
    """Return a scene that two policies end in two ways."""
    recordings = (
        make_recording(outcome=first, index=index, adversarial=adversarial, **changes),
        make_recording(outcome=second, index=index, adversarial=adversarial, label="Second"),
    )
    return Card(recordings=recordings, paths=picture("PNG"), animation=picture("WEBP"))


@pytest.fixture(scope="module")
def page() -> str:
    """A page of two scenes with curves."""
    telling = [card("success", "collision", index=7)]
    others = [card("success", "time-out", index=9, adversarial=False)]
    return make_page(telling, others, curve=picture("PNG"), facts={"Commit": "abc", "Versions": "<none>"})


def test_page_refers_to_nothing_outside(page: str) -> None:
    """Catches a script, style, font or picture that is fetched: the page is sent around as one file."""
    reader = Reader(page)
    assert all(reference.startswith("data:image/") for reference in reader.references)
    assert {"script", "link", "iframe", "object"}.isdisjoint(reader.tags)
    without_pictures = re.sub(r"data:image/\w+;base64,[A-Za-z0-9+/=]+", "", page)
    assert re.search(r"https?:|file:|url\(|@import|//\w", without_pictures) is None


def test_all_pictures_can_be_decoded(page: str) -> None:
    """Catches a picture under the wrong type or cut off: paths and animation of two scenes, and the curves."""
    sources = Reader(page).references
    assert len(sources) == 5
    for source in sources:
        kind, data = re.fullmatch(r"data:image/(\w+);base64,(.*)", source).groups()
        with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as image:
            assert image.format == kind.upper()
            assert image.size == (4, 3)


def test_tags_are_balanced(page: str) -> None:
    """Catches a section that is swallowed by the one before it."""
    for tag in ("article", "table", "tr", "td", "details", "main", "dl", "h2"):
        assert len(re.findall(rf"<{tag}[ >]", page)) == page.count(f"</{tag}>"), tag


def test_numbers_are_those_of_the_recordings(page: str) -> None:
    """Catches a column that is shifted, of the other policy or of another scene."""
    rows = Reader(page).rows
    # 6 steps of 0.2 s; from (4.5, 0) to (12, 1) 7.57 m; clearance 7.8 - 5.0 = 2.80 m; R and U of half 0, half 1.
    assert ["First", "goal reached after 1.2 s", "6", "7.57", "2.80", "0.50", "0.250"] in rows
    assert ["Second", "collision of the object after 1.2 s", "6", "7.57", "2.80", "0.50", "0.250"] in rows


def test_summary_counts_every_scene_once(page: str) -> None:
    """Catches rates over the wrong scenes."""
    rows = Reader(page).rows
    # Wilson for 1 of 1, z^2 = 3.841459: from 1 / (1 + z^2) = 0.2065; for 0 of 2: up to z^2 / (2 + z^2) = 0.6576.
    assert ["adversarial", "First", "1 of 1 (100%)", "21% to 100%", "0", "0", "0%", "0%", "6"] in rows
    assert ["all scenes", "Second", "0 of 2 (0%)", "0% to 66%", "1", "1", "0%", "0%", "6"] in rows


def test_summary_has_no_row_for_a_kind_that_was_not_played() -> None:
    """Catches a division by no scenes."""
    table = summary_table([card("success", "success", index=1)])
    assert "uniform" not in table
    assert table.count("<tr>") == 5  # head, adversarial and all scenes for both policies


def test_text_is_escaped(page: str) -> None:
    """Catches a label or version that breaks the page."""
    assert "&lt;none&gt;" in page
    odd = make_page([card("success", "success", index=1, label="<b>A&B")], [], curve=None, facts={})
    assert "<b>A" not in odd
    assert "&lt;b&gt;A&amp;B" in odd


def test_only_telling_scenes_are_open(page: str) -> None:
    """Catches a page that plays all animations at once."""
    assert page.count("<details open>") == 1
    assert page.count("<details>") == 1
    assert page.index('id="scene-7"') < page.index('id="scene-9"')


def test_no_obstacle_means_no_clearance() -> None:
    """Catches an infinity in a table."""
    alone = make_recording(episode=make_episode(), obstacles=make_recording().obstacles * 0)
    shown = make_page([Card(recordings=(alone, alone), paths=b"", animation=b"")], [], curve=None, facts={})
    assert ["First", "goal reached after 1.2 s", "6", "7.57", "none", "0.50", "0.250"] in Reader(shown).rows
    assert "inf" not in shown


def test_a_page_without_scenes_is_refused() -> None:
    """Catches an empty page that looks like a success."""
    with pytest.raises(ValueError, match="number of scenes is 0; accepted: 1 or more"):
        make_page([], [], curve=None, facts={})
