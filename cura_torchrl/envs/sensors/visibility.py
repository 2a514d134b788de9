"""Which cells of a grid a planar scan has seen: pure batched geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

_FAR = 1e6
"""Coordinate of the cells that stand for the outside [m]: beyond the reach of any ray."""

_VECTOR_LANES = 16
"""Row lengths are multiples of this: the loops over a row have no tails."""


@dataclass(frozen=True, kw_only=True)
class MapGrid:
    """A grid of square cells over a rectangle of the world, framed by cells that stand for everything outside.

    A stored map has shape ``[num_rows, num_columns]``: row ``i + 1`` and column ``j`` hold the cell whose lower corner
    is ``(x_min + i * resolution, y_min + j * resolution)``. The first and the last row, and the columns added to round
    up their number, lie outside of the extent: they are far away from everything and always unseen.

    Examples:
        >>> grid = MapGrid(extent_x=(0.0, 0.3), extent_y=(0.0, 0.2), resolution=0.1)
        >>> grid.num_rows, grid.num_columns, grid.num_x, grid.num_y
        (5, 16, 3, 2)
    """

    extent_x: tuple[float, float]
    """World x covered [m]."""
    extent_y: tuple[float, float]
    """World y covered [m]."""
    resolution: float
    """Edge of a cell [m]."""

    def __post_init__(self) -> None:
        if self.resolution <= 0 or self.num_x < 1 or self.num_y < 1:
            area = f"x {self.extent_x}, y {self.extent_y} at {self.resolution} m"
            msg = f"grid over {area} has no cells; accepted: a positive area"
            raise ValueError(msg)
        if self.num_rows * self.num_columns > 2**24:
            msg = f"grid has {self.num_rows * self.num_columns} cells; accepted: at most 2**24, which float32 can count"
            raise ValueError(msg)

    @property
    def num_x(self) -> int:
        """Cells along x."""
        return round((self.extent_x[1] - self.extent_x[0]) / self.resolution)

    @property
    def num_y(self) -> int:
        """Cells along y."""
        return round((self.extent_y[1] - self.extent_y[0]) / self.resolution)

    @property
    def num_rows(self) -> int:
        """Rows of a stored map."""
        return self.num_x + 2

    @property
    def num_columns(self) -> int:
        """Columns of a stored map."""
        return math.ceil(self.num_y / _VECTOR_LANES) * _VECTOR_LANES

    @property
    def half_diagonal(self) -> float:
        """Half of a cell's diagonal [m]."""
        return self.resolution * math.sqrt(0.5)

    def inside(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the cells of the extent.

        Args:
            maps: Stored maps, shape ``[*B, num_rows, num_columns]``.

        Returns:
            View without what stands for the outside, shape ``[*B, num_x, num_y]``.
        """
        return maps[..., 1:-1, : self.num_y]

    def row_x(self) -> torch.Tensor:
        """Return the world x of the cell centres of each row [m], far away outside, shape ``[num_rows]``."""
        centres = self.extent_x[0] + (torch.arange(-1, self.num_x + 1, dtype=torch.float64) + 0.5) * self.resolution
        centres[[0, -1]] = _FAR
        return centres.float()

    def column_y(self) -> torch.Tensor:
        """Return the world y of the cell centres of each column [m], far away outside, shape ``[num_columns]``."""
        centres = self.extent_y[0] + (torch.arange(self.num_columns, dtype=torch.float64) + 0.5) * self.resolution
        centres[self.num_y :] = _FAR
        return centres.float()


def unit_vector(angle: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return cosine and sine, free of the last-bit differences that an element's place in a batch can make.

    Args:
        angle: Angles [rad], any shape.

    Returns:
        Cosine and sine [1], float32, same shape.

    Examples:
        >>> [value.item() for value in unit_vector(torch.zeros(()))]
        [1.0, 0.0]
    """
    wide = angle.double()
    return torch.cos(wide).float(), torch.sin(wide).float()


def clean_scan(scan: torch.Tensor, max_range: float) -> torch.Tensor:
    """Bring ranges into [0, max_range].

    Args:
        scan: Ranges [m], any shape.
        max_range: What a miss reads [m].

    Returns:
        The ranges [m], same shape; not-a-number becomes 0 (a ray that has seen nothing), infinity ``max_range``.

    Examples:
        >>> clean_scan(torch.tensor([float("nan"), float("inf"), 3.0]), 10.0).tolist()
        [0.0, 10.0, 3.0]
    """
    return scan.nan_to_num(nan=0.0, posinf=max_range).clamp(0.0, max_range)


def seen_free(
    row_x: torch.Tensor, column_y: torch.Tensor, scan: torch.Tensor, sensor_pose: torch.Tensor, margin: float
) -> torch.Tensor:
    """Tell which cells a scan has seen to be free.

    A cell is seen free if its centre is nearer to the sensor than the range of the ray nearest to its bearing, less a
    margin. This leaves no gaps between few rays and needs one lookup a cell. Bearings are exact to 1e-4 of the angle
    between rays: nearer than that to the middle between two rays, either may be asked.

    Args:
        row_x: World x of the cell centres of each row [m], shape ``[X]``.
        column_y: World y of the cell centres of each column [m], shape ``[Y]``.
        scan: Ranges as from :func:`clean_scan` [m], rays as in :func:`~cura_torchrl.envs.sensors.ray_angles`, shape
            ``[N, R]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        margin: What is taken off each range [m].

    Returns:
        Whether the cell is seen free, bool, shape ``[N, X, Y]``.

    Examples:
        >>> centres = torch.tensor([1.0, 2.0, 3.0])
        >>> scan = torch.full((1, 8), 2.5)
        >>> seen_free(centres, torch.zeros(1), scan, torch.zeros(1, 3), margin=0.07).flatten().tolist()
        [True, True, False]
    """
    num_rays = scan.shape[-1]
    per_radian = num_rays / (2.0 * math.pi)
    dx, dy = (row_x - sensor_pose[:, :1])[..., None], (column_y - sensor_pose[:, 1:2])[:, None]
    start = (math.pi - sensor_pose[:, 2].double()) * per_radian + 0.5
    start = start.remainder(num_rays).float()[:, None, None]
    # From -R / 2 to 3 R / 2: three turns in a row cost less than a remainder.
    ray = torch.atan2(dy, dx).mul_(per_radian).add_(start).floor_().add_(num_rays).long()
    reach = (scan - margin).clamp_min(0.0).square().repeat(1, 3)
    return dx.square() + dy.square() < reach.gather(1, ray.flatten(1)).view(ray.shape)


def scan_points(
    scan: torch.Tensor, sensor_pose: torch.Tensor, directions: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return where rays end.

    Args:
        scan: Ranges [m], shape ``[N, R]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        directions: Unit vectors along the rays in the base frame [1], shape ``[2, R]``.

    Returns:
        World x and y of the end points [m], both of shape ``[N, R]``.

    Examples:
        >>> x, y = scan_points(torch.tensor([[2.0]]), torch.tensor([[1.0, 1.0, 0.0]]), torch.tensor([[1.0], [0.0]]))
        >>> x.tolist(), y.tolist()
        ([[3.0]], [[1.0]])
    """
    cos, sin = unit_vector(sensor_pose[:, 2, None])
    ahead, left = directions
    x = (cos * ahead - sin * left).mul_(scan).add_(sensor_pose[:, 0, None])
    y = (sin * ahead + cos * left).mul_(scan).add_(sensor_pose[:, 1, None])
    return x, y


def inside_rectangle(
    x: torch.Tensor, y: torch.Tensor, pose: torch.Tensor, size: torch.Tensor, margin: float = 0.0
) -> torch.Tensor:
    """Tell which points lie inside of a rectangle.

    Args:
        x: World x of the points [m], shape ``[N, K]``.
        y: World y of the points [m], shape ``[N, K]``.
        pose: Rectangle's centre (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        size: Rectangle's (length, width) [m], shape ``[N, 2]`` or ``[2]``.
        margin: Added on each side [m].

    Returns:
        Whether a point lies inside or on the edge, bool, shape ``[N, K]``.

    Examples:
        >>> inside_rectangle(torch.tensor([[0.4, 0.6]]), torch.zeros(1, 2), torch.zeros(1, 3), torch.ones(2)).tolist()
        [[True, False]]
    """
    cos, sin = unit_vector(pose[:, 2, None])
    x, y = x - pose[:, 0, None], y - pose[:, 1, None]
    half = size / 2 + margin
    along = (x * cos).add_(y * sin).abs_().sub_(half[..., 0, None])
    across = y.mul_(cos).sub_(x.mul_(sin)).abs_().sub_(half[..., 1, None])
    return torch.maximum(along, across) <= 0.0


def cell_of_points(grid: MapGrid, x: torch.Tensor, y: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the cell that each point lies in, as an index into the flattened stored map.

    Args:
        grid: The map's cells.
        x: World x of the points [m], any shape.
        y: World y of the points [m], same shape.

    Returns:
        Flat index, int64, and whether the point lies inside of the extent, bool, both of the points' shape. Points
        outside get the index of some cell.

    Examples:
        >>> grid = MapGrid(extent_x=(0.0, 0.3), extent_y=(0.0, 0.2), resolution=0.1)
        >>> cell, is_inside = cell_of_points(grid, torch.tensor([0.05, -1.0]), torch.tensor([0.15, 0.0]))
        >>> cell[0].item(), is_inside.tolist()
        (17, [True, False])
    """
    i = torch.floor((x - grid.extent_x[0]).div_(grid.resolution))
    j = torch.floor((y - grid.extent_y[0]).div_(grid.resolution))
    row, column = i.clamp(0, grid.num_x - 1), j.clamp(0, grid.num_y - 1)
    is_inside = i.sub_(row).abs_().add_(j.sub_(column).abs_()) == 0.0
    return torch.add(column, row.add_(1), alpha=grid.num_columns).long(), is_inside
