"""Shortest routes of the object around known obstacles: a cost-to-go on a grid, batched."""

from __future__ import annotations

import torch

from cura_torchrl.envs import geometry

CELL = 0.2
"""Edge of a cell [m]."""

X_RANGE, Y_RANGE = (-2.0, 16.0), (-5.0, 5.0)
"""World covered by the grid [m]."""

_SHAPE = (round((X_RANGE[1] - X_RANGE[0]) / CELL), round((Y_RANGE[1] - Y_RANGE[0]) / CELL))
_FAR = 1e3
_NEIGHBOURS = tuple((dx, dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if (dx, dy) != (0, 0))


def cell_centres() -> torch.Tensor:
    """Return the cells' centres in the world frame [m], shape ``[W, H, 2]``."""
    x = X_RANGE[0] + CELL * (torch.arange(_SHAPE[0]) + 0.5)
    y = Y_RANGE[0] + CELL * (torch.arange(_SHAPE[1]) + 0.5)
    return torch.stack(torch.meshgrid(x, y, indexing="ij"), dim=-1)


def cell_of(point: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the indices of the cells that points lie in, clamped to the grid.

    Args:
        point: World points [m], shape ``[*, 2]``.

    Returns:
        Indices along x and y, shape ``[*]`` each.
    """
    column = ((point[..., 0] - X_RANGE[0]) / CELL).long().clamp(0, _SHAPE[0] - 1)
    row = ((point[..., 1] - Y_RANGE[0]) / CELL).long().clamp(0, _SHAPE[1] - 1)
    return column, row


def step_cost(obstacles: torch.Tensor, radius: torch.Tensor, soft_margin: float) -> torch.Tensor:
    """Return what it costs to cross a cell: 1 in the open, more near obstacles, prohibitive inside their margin.

    Args:
        obstacles: (x [m], y [m], yaw [rad], edge [m]), edge 0 for none, shape ``[N, M, 4]``.
        radius: Distance from an obstacle's surface that the object's centre must keep [m], shape ``[N]``.
        soft_margin: Further distance over which the cost falls off [m].

    Returns:
        Cost per cell [1], shape ``[N, W, H]``.
    """
    centres = cell_centres().to(obstacles)
    point = centres.expand(*obstacles.shape[:2], *centres.shape)
    local = geometry.to_frame(obstacles[:, :, None, None, :3].expand(*point.shape[:-1], 3), point)
    outside = (local.abs() - obstacles[:, :, None, None, 3:] / 2).clamp_min(0.0)
    is_there = obstacles[:, :, 3, None, None] > 0
    distance = torch.where(is_there, geometry.norm(outside), torch.full_like(outside[..., 0], _FAR))
    clearance = distance.amin(1) - radius[:, None, None]
    return 1.0 + 4.0 * (1.0 - clearance / soft_margin).clamp(0.0, 1.0) + torch.where(clearance < 0, 60.0, 0.0)


def cost_to_go(cost: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """Return the cheapest way from every cell to the goal, over eight neighbours.

    Args:
        cost: Cost per cell [1], shape ``[N, W, H]``.
        goal: Goals in the world frame [m], shape ``[N, 2]``.

    Returns:
        Accumulated cost in cell lengths [1], shape ``[N, W, H]``.
    """
    value = torch.full_like(cost, _FAR * _FAR)
    column, row = cell_of(goal)
    value[torch.arange(len(cost)), column, row] = 0.0
    lengths = {True: cost * 2**0.5, False: cost}
    for _ in range(2 * (_SHAPE[0] + _SHAPE[1])):
        padded = torch.nn.functional.pad(value, (1, 1, 1, 1), value=_FAR * _FAR)
        relaxed, candidate = value.clone(), torch.empty_like(value)
        for dx, dy in _NEIGHBOURS:
            neighbour = padded[:, 1 + dx : 1 + dx + _SHAPE[0], 1 + dy : 1 + dy + _SHAPE[1]]
            torch.add(neighbour, lengths[dx != 0 and dy != 0], out=candidate)
            torch.minimum(relaxed, candidate, out=relaxed)
        if torch.equal(relaxed, value):
            break
        value = relaxed
    return value


def follow(value: torch.Tensor, start: torch.Tensor, cells: int) -> torch.Tensor:
    """Return the point that the cheapest route reaches after some cells.

    Args:
        value: From :func:`cost_to_go`, shape ``[N, W, H]``.
        start: Where the routes start, world frame [m], shape ``[N, 2]``.
        cells: How many cells to go.

    Returns:
        World points, cell centres [m], shape ``[N, 2]``.
    """
    rows = torch.arange(len(value))
    column, row = cell_of(start)
    for _ in range(cells):
        columns = torch.stack([(column + dx).clamp(0, _SHAPE[0] - 1) for dx, _ in _NEIGHBOURS] + [column])
        lines = torch.stack([(row + dy).clamp(0, _SHAPE[1] - 1) for _, dy in _NEIGHBOURS] + [row])
        best = value[rows, columns, lines].argmin(0)
        column, row = columns[best, rows], lines[best, rows]
    return cell_centres().to(start)[column, row]
