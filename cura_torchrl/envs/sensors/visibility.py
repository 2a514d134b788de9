"""Which cells of a grid a planar scan has seen: pure batched geometry.

On a CPU, comparisons, masked writes and integer indices on large tensors cost 5 to 15 times as much as float
arithmetic. So the large masks here are float tensors, made by ``sign``, and the large lookups are nearest-neighbour
samples of a table at a float coordinate: that kernel reads no integers, uses all vector lanes and all threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch.nn import functional as F  # noqa: N812

if TYPE_CHECKING:
    from collections.abc import Iterator

_FAR = 1e6
"""Coordinate of the cells that stand for the outside [m]: beyond the reach of any ray."""

_NEAR = 1e-30
"""Stands for a distance of 0 where it is divided by [m]: its inverse times any distance is finite."""

_VECTOR_LANES = 16
"""Row lengths are multiples of this: no cell falls to a loop's scalar tail in one batch and not in another."""


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


class ScanView(NamedTuple):
    """A scan as the cells of a grid ask for it; everything is per sensor, so that a part of it is a view too.

    The bearings of a row of cells span half a turn, from -90 to 90 degrees around one of two directions, by which side
    of the sensor the row lies on. The table holds the rays of both half turns, one after the other.
    """

    table: torch.Tensor
    """Square of the distance at which a ray stops to see cells free [m^2], shape ``[N, K]``."""
    row_start: torch.Tensor
    """Coordinate in the table of a bearing of 0 in the row's half turn [1], shape ``[N, X, 1]``."""
    row_inverse: torch.Tensor
    """One over the row's distance ahead of the sensor [1/m], shape ``[N, X, 1]``."""
    row_square: torch.Tensor
    """Square of the row's distance [m^2], shape ``[N, X, 1]``."""
    column_offset: torch.Tensor
    """Column's distance to the left of the sensor [m], shape ``[N, 1, Y]``."""
    column_square: torch.Tensor
    """Its square [m^2], shape ``[N, 1, Y]``."""
    per_radian: float
    """Coordinate in the table per bearing [1/rad]."""

    def split(self, size: int) -> Iterator[ScanView]:
        """Go through the view in parts.

        Args:
            size: Sensors of a part [1].

        Yields:
            Views of that many sensors, the last one of those that are left; they alias this one.
        """
        for tensors in zip(*(tensor.split(size) for tensor in self[:-1]), strict=True):
            yield ScanView._make((*tensors, self.per_radian))


def view_scan(
    row_x: torch.Tensor, column_y: torch.Tensor, scan: torch.Tensor, sensor_pose: torch.Tensor, half_diagonal: float
) -> ScanView:
    """Prepare a scan for :func:`free_margin`.

    Args:
        row_x: World x of the cell centres of each row [m], shape ``[X]``.
        column_y: World y of the cell centres of each column [m], shape ``[Y]``.
        scan: Ranges as from :func:`clean_scan` [m], rays as in :func:`~cura_torchrl.envs.sensors.ray_angles`, shape
            ``[N, R]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        half_diagonal: Half of a cell's diagonal [m].

    Returns:
        The scan by cells.

    Examples:
        >>> view_scan(torch.ones(4), torch.ones(5), torch.ones(2, 8), torch.zeros(2, 3), 0.07).row_start.shape
        torch.Size([2, 4, 1])
    """
    num_rays = scan.shape[-1]
    rays_per_radian = num_rays / (2 * math.pi)
    # Nearest ray to world bearing b: floor((b - yaw + pi) R / 2 pi + 1/2) mod R. The table of a half turn starts at the
    # ray nearest to its first bearing, less one for rounding, and ends one after that nearest to its last.
    half = num_rays // 2 + 4
    turned = (math.pi - sensor_pose[:, 2:].double()) * rays_per_radian + 0.5 - num_rays / 4
    turned = torch.remainder(torch.cat([turned, turned + num_rays / 2], -1), num_rays)
    first = turned.floor()
    ray = (first.long()[..., None] + torch.arange(-1, half - 1, device=scan.device)).remainder(num_rays)
    reach = (scan - half_diagonal).clamp_(min=0.0).square_()
    # The table's coordinate runs from -1 to 1, as the sampling has it.
    start = turned.sub_(first).add_(num_rays / 4 + 1.0).div_(half)
    start[:, 0] -= 1.0
    dx = row_x - sensor_pose[:, :1]
    # On the row of the sensor itself the bearing is 90 or -90 degrees, and 0 at the sensor.
    dx = torch.where(dx == 0.0, _NEAR, dx)[..., None]
    dy = (column_y - sensor_pose[:, 1:2])[:, None]
    row_start = torch.where(dx < 0.0, start[:, 1, None, None], start[:, 0, None, None]).float()
    table = reach.gather(1, ray.flatten(1))
    return ScanView(table, row_start, dx.reciprocal(), dx.square(), dy, dy.square(), rays_per_radian / half)


def free_margin(view: ScanView, scratch: torch.Tensor | None = None) -> torch.Tensor:
    """Return by how much cells are nearer than what has been measured at their bearing, in squares.

    A cell is seen free if its centre is nearer to the sensor than the range of the ray nearest to its bearing, less
    half a cell's diagonal. This leaves no gaps between few rays and needs one lookup a cell. Bearings are exact to
    1e-4 of the angle between rays: nearer than that to the middle between two rays, either may be asked.

    Args:
        view: The scan, from :func:`view_scan`.
        scratch: Memory to overwrite, shape ``[N, X, Y]``; None allocates it.

    Returns:
        Difference of the squares of range and distance [m^2], positive where seen free, shape ``[N, X, Y]``. Does not
        alias the scratch.

    Examples:
        >>> view = view_scan(torch.tensor([1.0, 3.0]), torch.zeros(1), torch.full((1, 8), 2.0), torch.zeros(1, 3), 0.0)
        >>> free_margin(view).flatten().tolist()
        [3.0, -5.0]
    """
    coordinate = torch.mul(view.row_inverse, view.column_offset, out=scratch).atan_()
    coordinate = torch.add(view.row_start, coordinate, alpha=view.per_radian, out=scratch)
    return sample_table(view.table, coordinate).sub_(view.row_square).sub_(view.column_square)


def seen_free(
    row_x: torch.Tensor,
    column_y: torch.Tensor,
    scan: torch.Tensor,
    sensor_pose: torch.Tensor,
    half_diagonal: float,
    scratch: torch.Tensor | None = None,
) -> torch.Tensor:
    """Tell which cells a scan has seen to be free, as :func:`free_margin` defines it.

    Args:
        row_x: World x of the cell centres of each row [m], shape ``[X]``.
        column_y: World y of the cell centres of each column [m], shape ``[Y]``.
        scan: Ranges as from :func:`clean_scan` [m], rays as in :func:`~cura_torchrl.envs.sensors.ray_angles`, shape
            ``[N, R]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[N, 3]``.
        half_diagonal: Half of a cell's diagonal [m].
        scratch: Memory to overwrite, shape ``[N, X, Y]``; None allocates it.

    Returns:
        1 where the cell is seen free, else 0, float32, shape ``[N, X, Y]``.

    Examples:
        >>> centres = torch.tensor([1.0, 2.0, 3.0])
        >>> scan = torch.full((1, 8), 2.5)
        >>> seen_free(centres, torch.zeros(1), scan, torch.zeros(1, 3), half_diagonal=0.07).flatten().tolist()
        [1.0, 1.0, 0.0]
    """
    view = view_scan(row_x, column_y, scan, sensor_pose, half_diagonal)
    return free_margin(view, scratch).sign_().relu_()


def sample_table(table: torch.Tensor, coordinate: torch.Tensor) -> torch.Tensor:
    """Look up the nearest entry of a table per row of the batch.

    Args:
        table: Entries, shape ``[N, K]``.
        coordinate: Where to look [1]: entry k lies at ``(2 k + 1) / K - 1``, shape ``[N, H, W]``.

    Returns:
        Entries, 0 where the coordinate is outside of -1 to 1, shape ``[N, H, W]``.

    Examples:
        >>> sample_table(torch.tensor([[5.0, 6.0]]), torch.tensor([[[-0.9, -0.1, 0.1, 1.1]]])).tolist()
        [[[5.0, 5.0, 6.0, 0.0]]]
    """
    # The table is an image of height 1, of which any second coordinate within -1 to 1 finds the only row: the first one
    # serves, and saves a tensor.
    points = coordinate[..., None].expand(*coordinate.shape, 2)
    return F.grid_sample(table[:, None, None], points, mode="nearest", align_corners=False)[:, 0]


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
