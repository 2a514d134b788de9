"""The confidence map's passes over cells as tensor operations on any device; :mod:`.map_kernels` is for the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs.sensors import visibility, window

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cura_torchrl.envs.sensors.visibility import MapGrid
    from cura_torchrl.envs.sensors.window import WindowFrame

_CHUNK_CELLS = 2**25
"""Cells handled together: bounds the work space."""


def mark_free(
    axes: tuple[torch.Tensor, torch.Tensor],
    stamps: torch.Tensor,
    steps: torch.Tensor,
    scan: torch.Tensor,
    sensor_pose: torch.Tensor,
    margin: float,
) -> None:
    """Write the time into the cells that a scan has seen free, as :func:`~.visibility.seen_free` defines them.

    Args:
        axes: World x of the rows' and world y of the columns' cell centres [m], shapes ``[X]`` and ``[Y]``.
        stamps: Stored maps, changed in place, shape ``[N, X, Y]``.
        steps: Time, no less than any stamp [1], shape ``[N]``.
        scan: Ranges as from :func:`~.visibility.clean_scan` [m], shape ``[N, R]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        margin: What is taken off each range [m].

    Examples:
        >>> stamps, centres = torch.zeros(1, 1, 3), torch.tensor([1.0, 2.0, 3.0])
        >>> axes = (torch.zeros(1), centres)
        >>> mark_free(axes, stamps, torch.ones(1), torch.full((1, 8), 2.5), torch.zeros(1, 3), 0.07)
        >>> stamps.flatten().tolist()
        [1.0, 1.0, 0.0]
    """
    for rows in _chunks(stamps):
        free = visibility.seen_free(*axes, scan[rows], sensor_pose[rows], margin)
        stamps[rows] = torch.where(free, steps[rows, None, None], stamps[rows])


def fill_windows(
    grid: MapGrid,
    windows: torch.Tensor,
    stamps: torch.Tensor,
    steps: torch.Tensor,
    frames: tuple[WindowFrame, WindowFrame],
    tables: tuple[torch.Tensor, torch.Tensor],
) -> None:
    """Write confidence, and occupancy if there is a channel for it, of windows on maps.

    Args:
        grid: The maps' cells.
        windows: Windows to write, shape ``[N, C, W, W]``.
        stamps: Stored maps: the time a cell was last seen, plus a half if it was occupied, shape
            ``[N, num_rows, num_columns]``.
        steps: Time now [1], shape ``[N]``.
        frames: Places of the windows' cells on the map and on the object.
        tables: Occupancy per half of a stamp, 0 where none is shown, shape ``[W, W]``; confidence by age, shape
            ``[K]``, its last entry for all ages beyond.
    """
    mask, powers = tables
    for rows in _chunks(windows[:, 0]):
        stamp = window.sample_map(grid, stamps[rows], frames[0].points(rows))
        last_seen = stamp.floor()
        age = (steps[rows, None, None] - last_seen).clamp_max(len(powers) - 1)
        windows[rows, 0] = powers[age.long()]
        if windows.shape[1] > 1:
            is_object = window.inside_footprint(frames[1].points(rows))
            windows[rows, 1] = (stamp - last_seen) * mask * (1.0 - is_object)


def _chunks(maps: torch.Tensor) -> Iterator[slice]:
    size = max(1, _CHUNK_CELLS // (maps.shape[1] * maps.shape[2]))
    return (slice(start, start + size) for start in range(0, len(maps), size))
