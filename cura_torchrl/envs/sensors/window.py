"""What a window that moves and turns with the sensor shows of a grid, and of rectangles: pure batched geometry."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch.nn import functional as F  # noqa: N812

if TYPE_CHECKING:
    from cura_torchrl.envs.sensors.visibility import MapGrid


def window_offsets(window: int, resolution: float) -> torch.Tensor:
    """Return the distance of each window row (or column) from the window's centre.

    Args:
        window: Cells along the window's edge [1].
        resolution: Edge of a cell [m].

    Returns:
        Base-frame x of the window's rows, which is the y of its columns too [m], shape ``[W]``.

    Examples:
        >>> window_offsets(4, 0.5).tolist()
        [-0.75, -0.25, 0.25, 0.75]
    """
    return ((torch.arange(window, dtype=torch.float64) - (window - 1) / 2) * resolution).float()


class WindowFrame(NamedTuple):
    """Coordinates of the cells of a window as sums of a row's and a column's terms: the cells cost one addition."""

    rows: torch.Tensor
    """Terms of the rows, shape ``[2, N, W, 1]``."""
    columns: torch.Tensor
    """Terms of the columns, shape ``[2, N, 1, W]``."""

    def points(self) -> torch.Tensor:
        """Return the two coordinates of each cell, shape ``[N, W, W, 2]``."""
        return (self.rows + self.columns).permute(1, 2, 3, 0)


def map_frame(grid: MapGrid, offsets: torch.Tensor, sensor_pose: torch.Tensor) -> WindowFrame:
    """Return where the cells of a window that is centred on, and turned with, the sensor lie on a grid.

    Window row ``i`` lies at base-frame x = ``offsets[i]`` (forward as ``i`` grows), column ``j`` at base-frame
    y = ``offsets[j]`` (to the left as ``j`` grows).

    Args:
        grid: The map's cells.
        offsets: Window offsets as from :func:`window_offsets` [m], shape ``[W]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.

    Returns:
        World y and x of the centres of the window's cells, of which the extent spans -1 to 1 [1].

    Examples:
        >>> from cura_torchrl.envs.sensors import MapGrid
        >>> grid = MapGrid(extent_x=(0.0, 0.4), extent_y=(0.0, 0.8), resolution=0.1)
        >>> frame = map_frame(grid, window_offsets(2, 0.2), torch.tensor([[0.2, 0.2, 0.0]]))
        >>> [[round(value, 3) for value in point] for point in frame.points()[0, :, 0].tolist()]
        [[-0.75, -0.5], [-0.75, 0.5]]
    """
    x, y, yaw = sensor_pose.double().unbind(-1)
    corner = torch.tensor([grid.extent_y[0], grid.extent_x[0]], dtype=torch.float64, device=offsets.device)
    half = torch.tensor([grid.num_y, grid.num_x], dtype=torch.float64, device=offsets.device) * (grid.resolution / 2)
    centre = torch.stack([y, x]) - corner[:, None]
    ahead, left = torch.stack([yaw.sin(), yaw.cos()]), torch.stack([yaw.cos(), -yaw.sin()])
    return _frame(offsets, centre / half[:, None] - 1.0, ahead / half[:, None], left / half[:, None])


def footprint_frame(
    offsets: torch.Tensor, sensor_pose: torch.Tensor, pose: torch.Tensor, size: torch.Tensor
) -> WindowFrame:
    """Return where the cells of the sensor's window lie on a rectangle.

    Args:
        offsets: Window offsets as from :func:`window_offsets` [m], shape ``[W]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        pose: Rectangle's centre (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        size: Rectangle's (length, width) [m], shape ``[N, 2]`` or ``[2]``.

    Returns:
        Place of the cells' centres along and across the rectangle, which spans -1 to 1 [1].

    Examples:
        >>> frame = footprint_frame(torch.tensor([0.0, 1.0]), torch.zeros(1, 3), torch.zeros(1, 3), torch.ones(2))
        >>> frame.points()[0, 1].tolist()
        [[2.0, 0.0], [2.0, 2.0]]
    """
    shift_x, shift_y, turn = (sensor_pose.double() - pose.double()).unbind(-1)
    yaw, half = pose[:, 2].double(), (size.double() / 2).expand(len(pose), 2).T
    centre = torch.stack([shift_x * yaw.cos() + shift_y * yaw.sin(), shift_y * yaw.cos() - shift_x * yaw.sin()])
    ahead, left = torch.stack([turn.cos(), turn.sin()]), torch.stack([-turn.sin(), turn.cos()])
    return _frame(offsets, centre / half, ahead / half, left / half)


def _frame(offsets: torch.Tensor, centre: torch.Tensor, ahead: torch.Tensor, left: torch.Tensor) -> WindowFrame:
    # The terms are few, so double costs nothing. All have shape [2, N].
    rows = torch.addcmul(centre[..., None], ahead[..., None], offsets.double())
    return WindowFrame(rows[..., None].float(), (left[..., None] * offsets.double())[..., None, :].float())


def sample_map(maps: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return what maps hold in the cells that points lie in.

    Args:
        maps: The extent of stored maps, as from ``MapGrid.inside``, shape ``[N, num_x, num_y]``.
        points: Points as from :func:`map_frame` [1], shape ``[N, H, W, 2]``.

    Returns:
        Values, 0 outside of the extent, shape ``[N, H, W]``.

    Examples:
        >>> from cura_torchrl.envs.sensors import MapGrid
        >>> grid = MapGrid(extent_x=(0.0, 0.2), extent_y=(0.0, 0.1), resolution=0.1)
        >>> maps = torch.arange(64.0).view(1, 4, 16)
        >>> sample_map(grid.inside(maps), torch.tensor([[[[0.0, -0.5], [0.0, 0.5], [0.0, 1.5]]]])).tolist()
        [[[16.0, 32.0, 0.0]]]
    """
    return F.grid_sample(maps[:, None], points, mode="nearest", align_corners=False)[:, 0]


def inside_footprint(points: torch.Tensor) -> torch.Tensor:
    """Tell which points lie inside of a rectangle that spans -1 to 1.

    Args:
        points: Points as from :func:`footprint_frame` [1], shape ``[N, H, W, 2]``.

    Returns:
        1 inside or on the edge, 0 outside, float32, shape ``[N, H, W]``.

    Examples:
        >>> inside_footprint(torch.tensor([[[[0.0, 0.9], [1.1, 0.0]]]])).tolist()
        [[[1.0, 0.0]]]
    """
    # The rectangle is an image of one pixel, and what is not found in an image is 0.
    pixel = points.new_ones(1, 1, 1, 1).expand(len(points), 1, 1, 1)
    return F.grid_sample(pixel, points, mode="nearest", align_corners=False)[:, 0]
