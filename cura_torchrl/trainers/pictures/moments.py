"""Which moments of a recording are shown, and which obstacle's appearance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from cura_torchrl.envs import geometry
from cura_torchrl.trainers.evaluation.active_perception import obstacles_hit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cura_torchrl.trainers.pictures.recording import Recording

_APART = 1.5
"""Least time between telling moments, where there is room for it [s]."""


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """How an obstacle came into view. Moments are indices into a recording's ``frame_steps``."""

    slot: int
    """Which of the obstacles [1]."""
    time: float
    """When it appeared [s]."""
    seen_free: float
    """Share of its place that had been seen, and seen free, just before, in the window of the map [1]."""
    confidence: float
    """Mean confidence of its place just before [1]."""
    before: int
    """The last frame without it."""
    appeared: int
    """The first frame with it."""
    first_seen: int | None
    """The first frame in which a ray ends on it; None if none does until the end."""
    nearest: int
    """The frame from then on in which robot or object are nearest to any obstacle."""


def telling_frames(recording: Recording) -> list[int]:
    """Return three frames: the first obstacle's appearance, the highest uncertainty, and the end.

    Args:
        recording: What was played.

    Returns:
        Indices into ``frame_steps``, in order of time; the highest uncertainty is looked for between the other two and
        some way from both, so that three different moments are shown wherever there is room for them.
    """
    last = len(recording.frame_steps) - 1
    times = recording.times[recording.frame_steps]
    end = min(int(np.searchsorted(times, recording.end_time)), last)
    appeared = recording.appearances[np.isfinite(recording.appearances)]
    first = min(int(np.searchsorted(times, appeared.min())), end) if appeared.size else 0
    low, high = int(np.searchsorted(times, times[first] + _APART)), int(np.searchsorted(times, times[end] - _APART))
    if low > high:
        return [first, (first + end) // 2, end]
    between = recording.uncertainty[recording.frame_steps[low : high + 1]]
    return [first, low + int(between.argmax()), end]


def frames_at(recording: Recording, times: Sequence[float]) -> list[int]:
    """Return the frames at some times.

    Args:
        recording: What was played.
        times: The times [s]; none takes the telling ones.

    Returns:
        Indices into ``frame_steps``: the nearest frame to each time, the last one for what is later.
    """
    if not times:
        return telling_frames(recording)
    known = recording.times[recording.frame_steps]
    return [int(np.abs(known - time).argmin()) for time in times]


def find_appearance(recording: Recording) -> Appearance | None:
    """Return the appearance of the obstacle whose place had been seen free most.

    Args:
        recording: What was played.

    Returns:
        How it came into view; None if no obstacle appeared after the start.
    """
    found = [
        _appearance(recording, slot)
        for slot, time in enumerate(recording.appearances.tolist())
        if time > 0.0  # not for NaN
    ]
    return max(found, key=lambda one: (one.seen_free, one.confidence), default=None)


def _appearance(recording: Recording, slot: int) -> Appearance:
    time = float(recording.appearances[slot])
    times = recording.times[recording.frame_steps]
    last = len(times) - 1
    appeared = min(int(np.searchsorted(times, time - 1e-6)), last)
    before = max(appeared - 1, 0)
    seen_free, confidence = _knowledge(recording, slot, before)
    steps = recording.frame_steps
    hit = obstacles_hit(
        torch.from_numpy(recording.scans),
        torch.from_numpy(recording.base_pose[steps]),
        torch.from_numpy(recording.obstacles[steps]),
        float(recording.scans.max()),
    )[:, slot]
    seen = np.flatnonzero(hit.numpy()[appeared:])
    return Appearance(
        slot=slot,
        time=time,
        seen_free=seen_free,
        confidence=confidence,
        before=before,
        appeared=appeared,
        first_seen=appeared + int(seen[0]) if seen.size else None,
        nearest=appeared + int(recording.clearance[steps][appeared:].argmin()),
    )


def _knowledge(recording: Recording, slot: int, frame: int) -> tuple[float, float]:
    """Return which share of an obstacle's place the map shows as free, and with which confidence."""
    window = recording.maps[frame].astype(np.float64) / 255.0
    size = window.shape[-1]
    centres = (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * recording.resolution
    cells = torch.stack(torch.meshgrid(centres, centres, indexing="ij"), -1).reshape(-1, 2)
    base = torch.from_numpy(recording.base_pose[recording.frame_steps[frame]]).double()
    obstacle = torch.from_numpy(recording.obstacles[-1, slot]).double()
    in_world = geometry.from_frame(base.expand(len(cells), 3), cells)
    local = geometry.to_frame(obstacle[:3].expand(len(cells), 3), in_world).abs().amax(-1)
    inside = (local < obstacle[3] / 2).numpy().reshape(size, size)
    # Cells of the place that lie outside of the window are unknown.
    num_cells = max(int(inside.sum()), float(obstacle[3] / recording.resolution) ** 2)
    is_free = (window[0] > 0.0) & (window[-1] < 0.5)
    return min(1.0, float((is_free & inside).sum() / num_cells)), float(window[0][inside].sum() / num_cells)
