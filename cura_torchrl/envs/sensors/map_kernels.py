"""The confidence map's loops over cells, compiled for the CPU: what tensor operations do in several passes over memory.

One world after the other stays in the cache, and a row of cells is handled in short loops of which each but the lookup
runs on all vector lanes. The threads are torch's. On other devices :mod:`.map_tensors` does the same.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from cura_torchrl.compiled import Floats, Ints, compiled, run_rows
from cura_torchrl.envs.sensors import visibility

if TYPE_CHECKING:
    from cura_torchrl.envs.sensors.visibility import MapGrid
    from cura_torchrl.envs.sensors.window import WindowFrame

_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_HALF_TURN, _QUARTER_TURN = np.float32(math.pi), np.float32(0.5 * math.pi)
_NEAR = np.float32(1e-30)
"""Keeps the bearing of a cell in whose centre the sensor stands a number."""


@compiled
def _find_rays(
    ray: Ints, column_y: Floats, dx: np.float32, sensor_y: np.float32, per_radian: np.float32, start: np.float32
) -> None:
    # arctan on 0 to 1 to 2e-8: Abramowitz and Stegun, Handbook of Mathematical Functions, 4.4.49.
    ahead = abs(dx)
    for j in range(column_y.shape[0]):
        dy = column_y[j] - sensor_y
        left = abs(dy)
        ratio = min(ahead, left) / max(ahead, left, _NEAR)
        square = ratio * ratio
        value = np.float32(0.0028662257) * square - np.float32(0.0161657367)
        value = value * square + np.float32(0.0429096138)
        value = value * square - np.float32(0.0752896400)
        value = value * square + np.float32(0.1065626393)
        value = value * square - np.float32(0.1420889944)
        value = value * square + np.float32(0.1999355085)
        value = value * square - np.float32(0.3333314528)
        bearing = value * square * ratio + ratio
        bearing = _QUARTER_TURN - bearing if left > ahead else bearing
        bearing = _HALF_TURN - bearing if dx < _ZERO else bearing
        ray[j] = np.int32(math.copysign(bearing, dy) * per_radian + start)


@compiled
def _look_up(values: Floats, index: Ints, table: Floats) -> None:
    for j in range(index.shape[0]):
        values[j] = table[np.uint32(index[j])]


@compiled
def _mark(
    stamps: Floats, reach: Floats, column_y: Floats, dx: np.float32, sensor_y: np.float32, stamp: np.float32
) -> None:
    for j in range(column_y.shape[0]):
        dy = column_y[j] - sensor_y
        seen = stamp if dx * dx + dy * dy < reach[j] else _ZERO
        stamps[j] = max(stamps[j], seen)


@compiled
def _mark_free(
    stamps: Floats,
    steps: Floats,
    table: Floats,
    start: Floats,
    pose: Floats,
    row_x: Floats,
    column_y: Floats,
    per_radian: np.float32,
) -> None:
    ray, reach = np.empty(column_y.shape[0], np.int32), np.empty(column_y.shape[0], np.float32)
    for n in range(stamps.shape[0]):
        farthest, sensor_y = table[n].max(), pose[n, 1]
        for i in range(row_x.shape[0]):
            dx = row_x[i] - pose[n, 0]
            if dx * dx < farthest:
                _find_rays(ray, column_y, dx, sensor_y, per_radian, start[n])
                _look_up(reach, ray, table[n])
                _mark(stamps[n, i], reach, column_y, dx, sensor_y, steps[n])


@compiled
def _mark_hits(
    stamps: Floats,
    steps: Floats,
    scan: Floats,
    sensor: Floats,
    box: Floats,
    directions: Floats,
    longest: np.float32,
    cells: tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.int32],
) -> None:
    x_min, y_min, resolution, num_x, num_y, stride = cells
    for n in range(scan.shape[0]):
        x, y, cos, sin, length, width = sensor[n]
        box_x, box_y, box_cos, box_sin, box_length, box_width = box[n]
        for r in range(scan.shape[1]):
            if not _ZERO < scan[n, r] < longest:
                continue
            ahead, left = directions[0, r] * scan[n, r], directions[1, r] * scan[n, r]
            end_x, end_y = cos * ahead - sin * left + x, sin * ahead + cos * left + y
            i, j = np.floor((end_x - x_min) / resolution), np.floor((end_y - y_min) / resolution)
            if not (_ZERO <= i < num_x and _ZERO <= j < num_y):
                continue
            along, across = end_x - box_x, end_y - box_y
            along, across = along * box_cos + across * box_sin, across * box_cos - along * box_sin
            is_robot = abs(ahead) <= length and abs(left) <= width
            is_known = is_robot or (abs(along) <= box_length and abs(across) <= box_width)
            cell, stamp = (np.int32(i) + np.int32(1)) * stride + np.int32(j), steps[n] + (_ZERO if is_known else _HALF)
            stamps[n, cell] = max(stamps[n, cell], stamp)


@compiled
def _find_cells(
    cell: Ints,
    at_x: np.float32,
    at_y: np.float32,
    along_x: Floats,
    along_y: Floats,
    num_x: np.float32,
    num_y: np.float32,
    stride: np.int32,
) -> None:
    for j in range(cell.shape[0]):
        x = (at_x + along_x[j] + _ONE) * (_HALF * num_x)
        y = (at_y + along_y[j] + _ONE) * (_HALF * num_y)
        is_inside = (x >= _ZERO) & (x < num_x) & (y >= _ZERO) & (y < num_y)
        # Cell 0 lies outside of the extent: it is never seen.
        cell[j] = (np.int32(x) + np.int32(1)) * stride + np.int32(y) if is_inside else np.int32(0)


@compiled
def _find_ages(age: Ints, stamps: Floats, step: np.float32, oldest: np.float32) -> None:
    for j in range(age.shape[0]):
        age[j] = np.int32(min(step - np.floor(stamps[j]), oldest))


@compiled
def _occupy(
    occupancy: Floats,
    stamps: Floats,
    mask: Floats,
    at_x: np.float32,
    at_y: np.float32,
    along_x: Floats,
    along_y: Floats,
) -> None:
    for j in range(stamps.shape[0]):
        farthest = max(abs(at_x + along_x[j]), abs(at_y + along_y[j]))
        value = (stamps[j] - np.floor(stamps[j])) * mask[j]
        occupancy[j] = _ZERO if farthest <= _ONE else value


@compiled
def _fill(
    windows: Floats,
    maps: Floats,
    steps: Floats,
    rows: Floats,
    columns: Floats,
    mask: Floats,
    powers: Floats,
    size: tuple[int, int, int],
) -> None:
    num_cells = windows.shape[-1]
    cell, age, stamps = np.empty(num_cells, np.int32), np.empty(num_cells, np.int32), np.empty(num_cells, np.float32)
    num_x, num_y, oldest = np.float32(size[0]), np.float32(size[1]), np.float32(powers.shape[0] - 1)
    stride = np.int32(size[2])
    for n in range(windows.shape[0]):
        at, along = rows[n], columns[n]
        for i in range(num_cells):
            _find_cells(cell, at[1, i], at[0, i], along[1], along[0], num_x, num_y, stride)
            _look_up(stamps, cell, maps[n])
            _find_ages(age, stamps, steps[n], oldest)
            _look_up(windows[n, 0, i], age, powers)
            if windows.shape[1] > 1:
                _occupy(windows[n, 1, i], stamps, mask[i], at[2, i], at[3, i], along[2], along[3])


def mark_free(
    axes: tuple[torch.Tensor, torch.Tensor],
    stamps: torch.Tensor,
    steps: torch.Tensor,
    scan: torch.Tensor,
    sensor_pose: torch.Tensor,
    margin: float,
) -> None:
    """Do what :func:`.map_tensors.mark_free` does, with the same arguments, on the CPU.

    Examples:
        >>> stamps, centres = torch.zeros(1, 1, 3), torch.tensor([1.0, 2.0, 3.0])
        >>> axes = (torch.zeros(1), centres)
        >>> mark_free(axes, stamps, torch.ones(1), torch.full((1, 8), 2.5), torch.zeros(1, 3), 0.07)
        >>> stamps.flatten().tolist()
        [1.0, 1.0, 0.0]
    """
    num_rays = scan.shape[-1]
    # The table holds two turns, so that no bearing wraps: its entry k is ray k - shift, modulo a turn.
    shift, per_radian = num_rays // 2 + 1, num_rays / (2.0 * math.pi)
    rays = torch.arange(-shift, 2 * num_rays + 2 - shift).remainder(num_rays)
    table = (scan - margin).clamp_min(0.0).square()[:, rays]
    start = (math.pi - sensor_pose[:, 2].double()) * per_radian + 0.5
    start = (start.remainder(num_rays) + shift).float()
    batch = (stamps, steps, table, start, sensor_pose)
    run_rows(_mark_free, batch, *(axis.numpy() for axis in axes), np.float32(per_radian))


def mark_hits(
    grid: MapGrid,
    stamps: torch.Tensor,
    steps: torch.Tensor,
    scan: torch.Tensor,
    directions: torch.Tensor,
    rectangles: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
    longest: float,
) -> None:
    """Do what :func:`.map_tensors.mark_hits` does, with the same arguments, on the CPU."""
    pose, robot_size, object_pose, object_size = rectangles
    batch = (stamps.flatten(1), steps, scan, _placed(pose, robot_size), _placed(object_pose, object_size))
    numbers = (grid.extent_x[0], grid.extent_y[0], grid.resolution, grid.num_x, grid.num_y)
    cells = (*(np.float32(number) for number in numbers), np.int32(grid.num_columns))
    run_rows(_mark_hits, batch, directions.numpy(), np.float32(longest), cells)


def _placed(pose: torch.Tensor, size: torch.Tensor) -> torch.Tensor:
    """Return centre, cosine and sine of the yaw, and half of the size, shape ``[N, 6]``."""
    cos, sin = visibility.unit_vector(pose[:, 2])
    return torch.cat([pose[:, :2], cos[:, None], sin[:, None], size / 2.0], dim=-1)


def fill_windows(
    grid: MapGrid,
    windows: torch.Tensor,
    stamps: torch.Tensor,
    steps: torch.Tensor,
    frames: tuple[WindowFrame, WindowFrame],
    tables: tuple[torch.Tensor, torch.Tensor],
) -> None:
    """Do what :func:`.map_tensors.fill_windows` does, with the same arguments, on the CPU."""
    rows = torch.cat([frame.rows[..., 0] for frame in frames]).movedim(1, 0).contiguous()
    columns = torch.cat([frame.columns[..., 0, :] for frame in frames]).movedim(1, 0).contiguous()
    size = (grid.num_x, grid.num_y, grid.num_columns)
    batch = (windows, stamps.flatten(1), steps, rows, columns)
    run_rows(_fill, batch, *(table.numpy() for table in tables), size)
