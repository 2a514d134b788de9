"""What a window that moves and turns with the sensor shows of a grid, and of rectangles: pure batched geometry."""

from __future__ import annotations

import torch
from torch.nn import functional as F  # noqa: N812

from cura_torchrl.envs.sensors.visibility import MapGrid, unit_vector

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


def window_points(
    grid: MapGrid, offsets: torch.Tensor, sensor_pose: torch.Tensor, scratch: torch.Tensor | None = None
) -> torch.Tensor:
    """Return where the cells of a window lie that is centred on, and turned with, the sensor.

    Window row ``i`` lies at base-frame x = ``offsets[i]`` (forward as ``i`` grows), column ``j`` at base-frame
    y = ``offsets[j]`` (to the left as ``j`` grows).

    Args:
        grid: The map's cells.
        offsets: Window offsets as from :func:`window_offsets` [m], shape ``[W]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        scratch: Memory to overwrite, shape ``[2, N, W, W]``; None allocates it.

    Returns:
        World y and x of the centres of the window's cells, of which the extent spans -1 to 1 [1], shape
        ``[N, W, W, 2]``; aliases the scratch.

    Examples:
        >>> grid = MapGrid(extent_x=(0.0, 0.4), extent_y=(0.0, 0.8), resolution=0.1)
        >>> points = window_points(grid, window_offsets(2, 0.2), torch.tensor([[0.2, 0.2, 0.0]]))
        >>> [[round(value, 3) for value in point] for point in points[0, :, 0].tolist()]
        [[-0.75, -0.5], [-0.75, 0.5]]
    """
    pose = sensor_pose[:, None, None].double()
    cos, sin = pose[..., 2].cos(), pose[..., 2].sin()
    ahead, left = offsets[:, None].double(), offsets.double()
    per_x, per_y = 2.0 / (grid.num_x * grid.resolution), 2.0 / (grid.num_y * grid.resolution)
    shape = (len(sensor_pose), len(offsets), len(offsets))
    points = offsets.new_empty(2, *shape) if scratch is None else scratch
    # Only the sums run over the window's cells; their terms cost next to nothing, and double.
    row = (pose[..., 1] - grid.extent_y[0] + sin * ahead).mul_(per_y).sub_(1.0).float()
    torch.add(row, (cos * left).mul_(per_y).float(), out=points[0])
    row = (pose[..., 0] - grid.extent_x[0] + cos * ahead).mul_(per_x).sub_(1.0).float()
    torch.add(row, (sin * left).mul_(-per_x).float(), out=points[1])
    return points.permute(1, 2, 3, 0)


def sample_map(grid: MapGrid, maps: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return what maps hold in the cells that points lie in.

    Args:
        grid: The maps' cells.
        maps: Stored maps, shape ``[N, num_rows, num_columns]``.
        points: Points as from :func:`window_points` [1], shape ``[N, H, W, 2]``.

    Returns:
        Values, 0 outside of the extent, shape ``[N, H, W]``.

    Examples:
        >>> grid = MapGrid(extent_x=(0.0, 0.2), extent_y=(0.0, 0.1), resolution=0.1)
        >>> maps = torch.arange(64.0).view(1, 4, 16)
        >>> sample_map(grid, maps, torch.tensor([[[[0.0, -0.5], [0.0, 0.5], [0.0, 1.5]]]])).tolist()
        [[[16.0, 32.0, 0.0]]]
    """
    return F.grid_sample(grid.inside(maps)[:, None], points, mode="nearest", align_corners=False)[:, 0]


def outside_footprint(
    offsets: torch.Tensor,
    sensor_pose: torch.Tensor,
    pose: torch.Tensor,
    size: torch.Tensor,
    scratch: torch.Tensor | None = None,
) -> torch.Tensor:
    """Tell which cells of the sensor's window have their centre outside of a rectangle.

    Args:
        offsets: Window offsets as from :func:`window_offsets` [m], shape ``[W]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        pose: Rectangle's centre (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        size: Rectangle's (length, width) [m], shape ``[N, 2]`` or ``[2]``.
        scratch: Memory to overwrite, shape ``[2, N, W, W]``; None allocates it.

    Returns:
        1 outside, 0 inside or on the edge, float32, shape ``[N, W, W]``; aliases the scratch.

    Examples:
        >>> sensor, box = torch.zeros(1, 3), torch.tensor([[0.5, 0.5, 0.0]])
        >>> outside_footprint(window_offsets(2, 1.0), sensor, box, torch.ones(2)).tolist()
        [[[1.0, 1.0], [1.0, 0.0]]]
    """
    yaw = sensor_pose[:, 2, None, None]
    cos, sin = unit_vector(yaw)
    shift_x, shift_y = (pose[:, :2] - sensor_pose[:, :2])[..., None, None].unbind(1)
    ahead = offsets[:, None] - (shift_x * cos + shift_y * sin)
    left = offsets - (shift_y * cos - shift_x * sin)
    cos, sin = unit_vector(pose[:, 2, None, None] - yaw)
    half = (size / 2)[..., None, None]
    shape = (len(sensor_pose), len(offsets), len(offsets))
    along, across = offsets.new_empty(2, *shape) if scratch is None else scratch
    torch.add(cos * ahead, sin * left, out=along).abs_().sub_(half[..., 0, :, :])
    torch.add(-sin * ahead, cos * left, out=across).abs_().sub_(half[..., 1, :, :])
    return torch.maximum(along, across, out=along).sign_().relu_()
