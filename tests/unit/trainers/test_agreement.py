"""Two files of outcomes agree where the same scenes end alike."""

from __future__ import annotations

import pytest

from cura_torchrl.trainers.agreement import agreement, pair
from tests.episodes import run_of


def test_scenes_are_paired_by_index_and_count_as_alike_by_how_they_end() -> None:
    """Catches pairs by place, and a time-out that passes for a collision: neither is a success.

    Common scenes are 2 to 6: there s c t s s, here s t t c s; three of five end alike.
    """
    found = agreement(pair(run_of("ccsctss"), run_of("sttcsc", first=2)))
    assert found is not None
    assert (found.scenes, found.alike, found.before, found.success) == (5, 0.6, 0.6, 0.4)
    assert found.low < -0.2 < found.high


def test_without_a_common_scene_there_is_nothing_to_tell() -> None:
    """Catches a division by zero, and full agreement on nothing."""
    assert agreement(pair(run_of("ss"), run_of("ss", first=2))) is None


def test_the_same_outcomes_agree_wholly() -> None:
    """Catches an interval that leaves out no difference."""
    found = agreement(pair(run_of("scts"), run_of("scts")))
    assert found is not None
    assert found.alike == 1.0
    assert found.low <= 0.0 <= found.high
    assert found.low == pytest.approx(-found.high)
