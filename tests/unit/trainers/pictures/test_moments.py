"""The moments that are shown are those that are meant."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cura_torchrl.trainers.pictures.moments import find_appearance, frames_at, telling_frames
from tests.recordings import NUM_STATES, make_episode, make_recording


def test_telling_frames_are_appearance_peak_and_end() -> None:
    """Catches moments by index and not by time: frames are 0.6 s apart here, the obstacle appears after 2.4 s."""
    num_states = 61
    atoms = np.zeros((num_states, 2), dtype=np.float32)
    atoms[33, 1] = 1.0  # the highest uncertainty, 6.6 s: frame 11
    obstacles = np.zeros((num_states, 6, 4), dtype=np.float32)
    obstacles[12:, 0, 3] = 0.4
    still = np.zeros((num_states, 3), dtype=np.float32)
    recording = make_recording(
        base_pose=still,
        object_pose=still,
        tcp=still[:, :2],
        atoms=atoms,
        obstacles=obstacles,
        frame_steps=np.arange(0, num_states, 3),
        episode=make_episode(steps=57),
    )
    # 57 steps of 0.2 s are 11.4 s: frame 19. The appearance, state 12, is frame 4.
    assert telling_frames(recording) == [4, 11, 19]
    # An episode that ends after 3.6 s, in frame 6, has no room for the peak: the moment in the middle is shown.
    assert telling_frames(dataclasses.replace(recording, episode=make_episode(steps=18))) == [4, 5, 6]


@pytest.mark.parametrize("outcome", ["success", "collision", "time-out"])
def test_telling_frames_exist_however_short_the_episode_is(outcome: str) -> None:
    """Catches an index beyond a recording of three frames."""
    moments = telling_frames(make_recording(outcome=outcome))
    assert moments == sorted(moments)
    assert 0 <= moments[0] <= moments[-1] <= NUM_STATES // 3


def test_frames_at_times_are_the_nearest_and_end_with_the_recording() -> None:
    """Catches indices of states: frames are at 0, 0.6 and 1.2 s."""
    recording = make_recording()
    assert frames_at(recording, [0.25, 0.5, 99.0]) == [0, 1, 2]
    assert frames_at(recording, []) == telling_frames(recording)


def test_an_appearance_knows_what_had_been_seen_of_its_place() -> None:
    """Catches a window that is read with x and y swapped, and a base that is left out.

    In frame 1 the base stands at x = 1.5 m. All that is ahead has been seen; obstacle 1 appears at x = 3 m, ahead,
    half a second later than obstacle 0, which appears behind. In frame 2 the base stands at 3 m.
    """
    obstacles = np.zeros((NUM_STATES, 6, 4), dtype=np.float32)
    obstacles[4:, 0] = (0.0, 2.0, 0.0, 0.4)
    obstacles[6:, 1] = (5.0, 2.0, 0.0, 0.4)
    steps = np.arange(NUM_STATES)
    maps = np.zeros((NUM_STATES, 2, 100, 100), dtype=np.uint8)
    maps[:, 0, 50:] = 204  # ahead: 0.8
    scans = np.full((NUM_STATES, 360), 5.0, dtype=np.float32)
    # The face of obstacle 1 that looks at the base, 1.8 m ahead and 2 m aside of it: atan2(2, 1.8) = 48 degrees.
    scans[6, 180 + 48] = np.hypot(1.8, 2.0)
    recording = make_recording(obstacles=obstacles, frame_steps=steps, maps=maps, scans=scans)
    found = find_appearance(recording)
    assert found is not None
    assert (found.slot, found.before, found.appeared, found.first_seen) == (1, 5, 6, 6)
    assert found.time == pytest.approx(1.2)
    assert found.seen_free == pytest.approx(1.0)
    assert found.confidence == pytest.approx(0.8)
    maps[:, 1] = 255  # known as occupied: nothing appears in what was seen free
    other = find_appearance(recording)
    assert other is not None
    assert other.seen_free == 0.0


def test_an_obstacle_that_is_there_from_the_start_does_not_appear() -> None:
    """Catches a snapshot of a state before the first one."""
    obstacles = np.zeros((NUM_STATES, 6, 4), dtype=np.float32)
    obstacles[:, 0] = (8.0, 0.0, 0.0, 0.4)
    assert find_appearance(make_recording(obstacles=obstacles)) is None
