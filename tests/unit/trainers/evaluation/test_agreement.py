"""Two files of outcomes agree where the same scenes end alike."""

from __future__ import annotations

from cura_torchrl.trainers.evaluation.agreement import agreement, pair
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
    assert found.low == found.high == 0.0


def test_a_scene_that_many_policies_play_counts_once() -> None:
    """Catches an interval that takes the policies on a scene for independent: ten times the pairs say no more."""
    once = pair(run_of("st" * 10), run_of("ss" * 10))
    one, ten = agreement(once), agreement(once * 10)
    assert one is not None
    assert ten is not None
    assert (ten.low, ten.high) == (one.low, one.high)
    assert one.high - one.low > 0.3  # 20 scenes in half of which the difference is 1: 4 sqrt(0.25 / 20) = 0.45
