"""Geometry of seeing, against scenes worked out by hand."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from cura_torchrl.envs.sensors import (
    MapGrid,
    cell_of_points,
    clean_scan,
    footprint_frame,
    inside_footprint,
    inside_rectangle,
    map_frame,
    map_kernels,
    map_tensors,
    ray_angles,
    sample_map,
    scan_points,
    unit_vector,
    window_offsets,
)

if TYPE_CHECKING:
    from collections.abc import Callable

GRID = MapGrid(extent_x=(-2.0, 2.0), extent_y=(-1.5, 1.5), resolution=0.1)


def window_cells(offsets: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """Return which cell of GRID each window cell shows, by its index in the flattened map; 0 outside of the extent."""
    indices = torch.arange(float(GRID.num_rows * GRID.num_columns)).view(1, GRID.num_rows, GRID.num_columns)
    return sample_map(GRID.inside(indices), map_frame(GRID, offsets, pose).points()).long()


def place(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> torch.Tensor:
    """Return a batch of one pose."""
    return torch.tensor([[x, y, yaw]])


class TestMapGrid:
    """Where the cells are."""

    def test_cells_are_where_the_extent_says(self) -> None:
        """Catches an offset by the border row or by half a cell."""
        # x: 40 cells and two border rows; first cell -2 + 0.05. y: 30 cells, padded to 32.
        assert (GRID.num_rows, GRID.num_columns) == (42, 32)
        assert GRID.row_x()[1].item() == pytest.approx(-1.95)
        assert GRID.row_x()[40].item() == pytest.approx(1.95)
        assert GRID.column_y()[[0, 29]].tolist() == pytest.approx([-1.45, 1.45])

    def test_everything_outside_is_far_away(self) -> None:
        """Catches border or padding cells that a ray could reach."""
        assert (GRID.row_x()[[0, 41]] > 1e5).all()
        assert (GRID.column_y()[30:] > 1e5).all()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"extent_x": (2.0, -2.0)}, "no cells"),
            ({"resolution": 0.0}, "no cells"),
            ({"extent_x": (0.0, 1000.0), "extent_y": (0.0, 1000.0)}, "at most"),
        ],
    )
    def test_impossible_grids_are_refused(self, change: dict, message: str) -> None:
        """Catches a grid that would fail later, or count cells wrongly in float32."""
        fields = {"extent_x": (0.0, 1.0), "extent_y": (0.0, 1.0), "resolution": 0.1} | change
        with pytest.raises((ValueError, ZeroDivisionError), match=message):
            MapGrid(**fields)


class TestScan:
    """What a scan says."""

    def test_bad_ranges_see_nothing(self) -> None:
        """Catches a NaN that reads as free space."""
        cleaned = clean_scan(torch.tensor([math.nan, math.inf, -1.0, 12.0, 3.0]), 10.0)
        assert cleaned.tolist() == [0.0, 10.0, 0.0, 10.0, 3.0]

    def test_rays_end_where_the_range_says(self) -> None:
        """Catches a wrong ray order or a yaw of the wrong sign."""
        directions = torch.stack(unit_vector(ray_angles(4)))
        # Sensor at (1, 2) turned left by 90 degrees; rays at -180, -90, 0, 90 degrees in the base frame point to world
        # -90, 0, 90, 180 degrees; ranges 1, 2, 3, 4.
        x, y = scan_points(torch.tensor([[1.0, 2.0, 3.0, 4.0]]), place(1.0, 2.0, math.pi / 2), directions)
        torch.testing.assert_close(x, torch.tensor([[1.0, 3.0, 1.0, -3.0]]))
        torch.testing.assert_close(y, torch.tensor([[1.0, 2.0, 5.0, 2.0]]))


@pytest.fixture(params=[map_kernels, map_tensors], ids=["kernels", "tensors"])
def see(request: pytest.FixtureRequest) -> Callable[..., torch.Tensor]:
    """Return which cells a scan has seen free, 1 or 0, by either implementation."""

    def function(grid: MapGrid, scan: torch.Tensor, pose: torch.Tensor, margin: float) -> torch.Tensor:
        stamps = torch.zeros(len(scan), grid.num_rows, grid.num_columns)
        request.param.mark_free((grid.row_x(), grid.column_y()), stamps, torch.ones(len(scan)), scan, pose, margin)
        return stamps

    return function


class TestSeenFree:
    """Which cells are seen free."""

    def test_a_wall_bounds_the_free_cells(self, see: Callable[..., torch.Tensor]) -> None:
        """Catches a wrong margin: cells up to half a diagonal in front of the wall are free, none behind it."""
        scan = torch.full((1, 360), 1.0)
        free = see(GRID, scan, place(), GRID.half_diagonal)[0]
        # Along y = 0.05, cells at x = 0.05, 0.15, ...: distance < 1 - 0.0707 up to x = 0.85 (0.8515), not 0.95.
        row = free[:, 15]
        assert row[21:30].tolist() == [1.0] * 9
        assert row[30:].sum() == 0.0
        # The disc of radius 0.9293 m: all cells by the definition, in float64.
        x, y = np.meshgrid(-2 + (np.arange(40) + 0.5) * 0.1, -1.5 + (np.arange(30) + 0.5) * 0.1, indexing="ij")
        expected = np.hypot(x, y) < 1.0 - 0.1 * math.sqrt(2) / 2
        np.testing.assert_array_equal(free[1:41, :30].numpy(), expected)

    @pytest.mark.parametrize("yaw", [0.0, 0.7, math.pi, -3.0, 7.0, -40.0])
    def test_each_cell_asks_the_ray_nearest_to_its_bearing(self, see: Callable[..., torch.Tensor], yaw: float) -> None:
        """Catches a bearing that ignores the yaw, its sign or its turns, or a table that does not wrap."""
        scan = torch.zeros(1, 8)
        scan[0, 3] = 5.0  # bearing -pi + 3 pi / 4 = -45 degrees in the base frame, sector from -67.5 to -22.5
        free = see(GRID, scan, place(0.01, 0.02, yaw), 0.0)[0, 1:41, :30]
        x, y = np.meshgrid(
            -2 + (np.arange(40) + 0.5) * 0.1 - 0.01, -1.5 + (np.arange(30) + 0.5) * 0.1 - 0.02, indexing="ij"
        )
        bearing = np.degrees((np.arctan2(y, x) - yaw + math.pi) % (2 * math.pi) - math.pi)
        np.testing.assert_array_equal(free.numpy(), (bearing > -67.5) & (bearing < -22.5))

    @pytest.mark.parametrize("num_rays", [1, 2, 7, 45])
    def test_any_number_of_rays_has_its_sectors(self, see: Callable[..., torch.Tensor], num_rays: int) -> None:
        """Catches tables of half a turn that hold for even numbers of rays only, or for many."""
        scan, yaw = torch.rand(1, num_rays, generator=torch.Generator().manual_seed(0)) * 2.0, 0.4
        free = see(GRID, scan, place(0.013, 0.021, yaw), 0.0)[0, 1:41, :30]
        x, y = np.meshgrid(
            -2 + (np.arange(40) + 0.5) * 0.1 - 0.013, -1.5 + (np.arange(30) + 0.5) * 0.1 - 0.021, indexing="ij"
        )
        ray = np.round((np.arctan2(y, x) - yaw + math.pi) * num_rays / (2 * math.pi)).astype(int) % num_rays
        np.testing.assert_array_equal(free.numpy(), np.hypot(x, y) < scan[0].numpy()[ray])

    def test_rows_and_columns_through_the_sensor_have_their_bearings(self, see: Callable[..., torch.Tensor]) -> None:
        """Catches a quotient of two zeros, and 90 degrees taken for -90 on the row whose distance is zero."""
        grid = MapGrid(extent_x=(-1.5, 1.5), extent_y=(-1.5, 1.5), resolution=1.0)  # centres at -1, 0, 1
        # Rays at -180, -90, 0 and 90 degrees, of which one sees.
        for ray, cell in enumerate([(0, 1), (1, 0), (2, 1), (1, 2)]):
            scan = torch.zeros(1, 4)
            scan[0, ray] = 1.2
            free = see(grid, scan, place(), 0.0)[0, 1:-1, :3]
            free[1, 1] = 0.0  # the sensor's own cell, whose bearing is a convention
            assert free.nonzero().tolist() == [list(cell)]

    def test_a_sensor_in_a_cell_centre_sees_its_cell(self, see: Callable[..., torch.Tensor]) -> None:
        """Catches a division by zero at the sensor itself."""
        free = see(GRID, torch.ones(1, 8), place(0.05, 0.05), GRID.half_diagonal)[0]
        assert free[21, 15] == 1.0

    def test_border_and_padding_are_never_seen(self, see: Callable[..., torch.Tensor]) -> None:
        """Catches a border cell that gets seen, which would show outside of the extent."""
        free = see(GRID, torch.full((1, 8), 10.0), place(1.9, 1.4), GRID.half_diagonal)[0]
        assert free[[0, 41]].sum() == 0.0
        assert free[:, 30:].sum() == 0.0
        assert free[1:41, :30].sum() == 1200.0


class TestRectangles:
    """Footprints."""

    def test_a_turned_rectangle_holds_what_it_should(self) -> None:
        """Catches a rotation by the wrong sign and swapped length and width."""
        # Centre (1, 0), turned left by 90 degrees, 2 m long, 0.5 m wide: |y| <= 1, |x - 1| <= 0.25.
        x, y = torch.tensor([[1.0, 1.0, 1.2, 1.3, 1.0]]), torch.tensor([[0.9, 1.1, 0.0, 0.0, -0.9]])
        box, size = place(1.0, 0.0, math.pi / 2), torch.tensor([[2.0, 0.5]])
        assert inside_rectangle(x, y, box, size).tolist() == [[True, False, True, False, True]]
        assert inside_rectangle(x, y, box, size, margin=0.15).all()

    def test_footprint_turns_with_the_window(self) -> None:
        """Catches a footprint that is computed in the wrong frame."""
        # Sensor at (1, 1) turned left by 90 degrees: the box centre (1, 3) is 2 m straight ahead of it.
        offsets = window_offsets(6, 1.0)  # -2.5 ... 2.5
        frame = footprint_frame(
            offsets, place(1.0, 1.0, math.pi / 2), place(1.0, 3.0, math.pi / 2), torch.tensor([1.2, 1.2])
        )
        inside = inside_footprint(frame.points())
        expected = torch.zeros(6, 6)
        expected[4:, 2:4] = 1.0  # rows at 1.5 and 2.5, columns at -0.5 and 0.5
        assert torch.equal(inside[0], expected)


class TestWindow:
    """Which cell a window shows where."""

    def test_cells_of_points_match_the_grid(self) -> None:
        """Catches an off-by-one at the extent's edges."""
        x = torch.tensor([-2.0, 1.999, 2.0, -2.001, 0.0, math.nan])
        y = torch.tensor([-1.5, 1.499, 0.0, 0.0, 1.5, 0.0])
        cell, is_inside = cell_of_points(GRID, x[:5], y[:5])
        assert is_inside.tolist() == [True, True, False, False, False]
        # Row 1 column 0, row 40 column 29.
        assert cell[:2].tolist() == [32, 40 * 32 + 29]

    @pytest.mark.parametrize("quarter", [0, 1, 2, 3])
    def test_a_quarter_turn_turns_the_window(self, quarter: int) -> None:
        """Catches a mirrored window or a rotation by the wrong sign."""
        offsets = window_offsets(10, 0.1)
        straight = window_cells(offsets, place(0.0, 0.0, 0.0))
        turned = window_cells(offsets, place(0.0, 0.0, quarter * math.pi / 2))
        # A quarter turn to the left: (ahead u, left v) is world (-v, u), so turned[i, j] = straight[W - 1 - j, i], or
        # torch.rot90 by -1: what was ahead (large i) is now to the right (small j).
        assert torch.equal(torch.rot90(straight, -quarter, (1, 2)), turned)

    def test_rows_look_ahead_and_columns_to_the_left(self) -> None:
        """Catches swapped axes."""
        cells = window_cells(window_offsets(4, 0.1), place())[0]
        rows, columns = cells // 32, cells % 32
        # x = 0.15 is in row 1 + floor(2.15 / 0.1) = 22, y = 0.15 in column floor(1.65 / 0.1) = 16.
        assert rows[:, 0].tolist() == [19, 20, 21, 22]
        assert columns[0].tolist() == [13, 14, 15, 16]

    @pytest.mark.parametrize("where", [(50.0, 0.0), (-50.0, 0.0), (0.0, 50.0), (0.0, -50.0), (1e4, 1e4), (500.0, 1.6)])
    def test_far_outside_shows_only_outside_cells(self, where: tuple[float, float]) -> None:
        """Catches an index that comes back into the map, from however far."""
        cells = window_cells(window_offsets(10, 0.1), place(*where, 0.3))
        assert torch.isin(cells // 32, torch.tensor([0, 41])).all()

    def test_half_outside_shows_both(self) -> None:
        """Catches a clamp that repeats the map's edge."""
        cells = window_cells(window_offsets(10, 0.1), place(0.0, 1.5, 0.0))[0]
        rows = cells // 32
        assert (rows[:, :5] >= 1).all()
        assert (rows[:, :5] <= 40).all()
        assert (rows[:, 5:] == 0).all()
