"""The confidence map's passes over cells as tensor operations on any device; :mod:`.map_kernels` is for the CPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from cura_torchrl.compiled import fused
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
        _mark_free(stamps[rows], steps[rows], *axes, scan[rows], sensor_pose[rows], margin)


@fused
def _mark_free(
    stamps: torch.Tensor,
    steps: torch.Tensor,
    row_x: torch.Tensor,
    column_y: torch.Tensor,
    scan: torch.Tensor,
    sensor_pose: torch.Tensor,
    margin: float,
) -> None:
    free = visibility.seen_free(row_x, column_y, scan, sensor_pose, margin)
    stamps.copy_(torch.where(free, steps[:, None, None], stamps))


def mark_hits(
    grid: MapGrid,
    stamps: torch.Tensor,
    steps: torch.Tensor,
    scan: torch.Tensor,
    directions: torch.Tensor,
    rectangles: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
    longest: float,
) -> None:
    """Write the time into the cells in which rays end, and half a step more where that is on an obstacle.

    Args:
        grid: The maps' cells.
        stamps: Stored maps, changed in place, shape ``[N, num_rows, num_columns]``.
        steps: Time, no less than any stamp [1], shape ``[N]``.
        scan: Ranges as from :func:`~.visibility.clean_scan` [m], shape ``[N, R]``.
        directions: Unit vectors along the rays in the base frame [1], shape ``[2, R]``.
        rectangles: Sensor's pose ``[N, 3]`` and the robot's (length, width) around it ``[N, 2]``, then the object's
            pose and size likewise (x [m], y [m], yaw [rad], world frame) [m]: what rays end on inside is no obstacle.
        longest: Ranges from here on have hit nothing [m].
    """
    pose, robot_size, object_pose, object_size = rectangles
    x, y = visibility.scan_points(scan, pose, directions)
    cells, is_inside = visibility.cell_of_points(grid, x, y)
    is_hit = is_inside & (scan > 0.0) & (scan < longest)
    is_obstacle = is_hit & ~visibility.inside_rectangle(x, y, pose, robot_size)
    is_obstacle &= ~visibility.inside_rectangle(x, y, object_pose, object_size)
    flat, now = stamps.flatten(1), steps[:, None]
    # What is not to be written goes to cell 0, outside of the extent, as the 0 that is there already. Obstacles come
    # second: a cell that holds the object and an obstacle is occupied, whatever the order of the rays.
    flat.scatter_(1, cells * is_hit, now * is_hit)
    flat.scatter_(1, cells * is_obstacle, (now + 0.5) * is_obstacle)


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
    for rows in _chunks(windows[:, 0]):
        on_map, on_object = (window.WindowFrame(frame.rows[:, rows], frame.columns[:, rows]) for frame in frames)
        _fill_windows(windows[rows], grid.inside(stamps[rows]), steps[rows], on_map, on_object, *tables)


@fused
def _fill_windows(
    windows: torch.Tensor,
    maps: torch.Tensor,
    steps: torch.Tensor,
    on_map: WindowFrame,
    on_object: WindowFrame,
    mask: torch.Tensor,
    powers: torch.Tensor,
) -> None:
    stamp = window.sample_map(maps, on_map.points())
    last_seen = stamp.floor()
    age = (steps[:, None, None] - last_seen).clamp_max(len(powers) - 1)
    windows[:, 0] = powers[age.long()]
    if windows.shape[1] > 1:
        windows[:, 1] = (stamp - last_seen) * mask * (1.0 - window.inside_footprint(on_object.points()))


def _chunks(maps: torch.Tensor) -> Iterator[slice]:
    size = max(1, _CHUNK_CELLS // (maps.shape[1] * maps.shape[2]))
    return (slice(start, start + size) for start in range(0, len(maps), size))
