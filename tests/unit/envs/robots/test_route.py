"""Routes on a grid with obstacles by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cura_torchrl.envs.robots import route

GOAL = torch.tensor([[12.1, 0.1]])
"""Centre of a cell."""


def octile(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the length of the shortest way between cells over eight neighbours, in cells."""
    apart = np.abs(first - second) / route.CELL
    return apart.max(-1) + (math.sqrt(2) - 1) * apart.min(-1)


def test_the_cost_to_go_of_an_empty_grid_is_the_octile_distance():
    """Catches diagonal steps that cost one, a loop that stops early, and a goal in the wrong cell."""
    cost = torch.ones(1, *route.cell_centres().shape[:2])
    value = route.cost_to_go(cost, GOAL)[0].numpy()
    expected = octile(route.cell_centres().numpy(), GOAL[0].numpy())
    np.testing.assert_allclose(value, expected, rtol=1e-4, atol=1e-4)
    assert value.argmin() == expected.argmin()


def test_points_are_in_the_cells_whose_centres_are_nearest():
    """Catches swapped axes or an offset of half a cell, and points outside that index beyond the grid."""
    centres = route.cell_centres()
    column, row = route.cell_of(torch.tensor([[0.13, -0.09], [-50.0, 50.0]]))
    assert centres[column[0], row[0]].tolist() == pytest.approx([0.1, -0.1], abs=1e-5)
    assert (column[1].item(), row[1].item()) == (0, centres.shape[1] - 1)


def test_step_costs_rise_towards_an_obstacle_and_forbid_its_margin():
    """Catches a distance from the centre in place of the surface, a yaw that is ignored, and ghosts of edge zero."""
    obstacles = torch.tensor([[[5.1, 0.1, math.pi / 4, 1.0], [8.1, 0.1, 0.0, 0.0]]])
    cost = route.step_cost(obstacles, torch.tensor([0.5]), soft_margin=0.6)[0]

    def at(x: float, y: float) -> float:
        column, row = route.cell_of(torch.tensor([x, y]))
        return cost[column, row].item()

    # Turned by 45 degrees its corner reaches to 5.1 + 0.7071 = 5.807 along x; the margin ends at 6.307.
    assert at(6.1, 0.1) > 60.0
    # At 6.5: 0.193 beyond the margin, 1 + 4 (1 - 0.193 / 0.6) = 3.71; at 7.1: 0.793 beyond, free.
    assert at(6.5, 0.1) == pytest.approx(1 + 4 * (1 - (6.5 - 5.1 - math.sqrt(0.5) - 0.5) / 0.6), abs=1e-4)
    assert at(7.1, 0.1) == 1.0
    assert at(8.1, 0.1) == 1.0


def test_a_free_route_is_straight():
    """Catches a route that wanders on an empty grid."""
    value = route.cost_to_go(torch.ones(1, *route.cell_centres().shape[:2]), GOAL)
    for cells in (1, 6, 20):
        point = route.follow(value, torch.tensor([[0.1, 0.1]]), cells)
        assert point[0].tolist() == pytest.approx([0.1 + 0.2 * cells, 0.1], abs=1e-4)
    assert route.follow(value, GOAL, 5)[0].tolist() == pytest.approx(GOAL[0].tolist(), abs=1e-4)


def test_a_route_goes_around_a_wall():
    """Catches a route through an obstacle, or around the longer end."""
    # Cubes side by side make a wall at x = 6 from y = -4 to 1; its shorter end is at y = 1.
    wall = [[6.0, y, 0.0, 1.0] for y in (-3.5, -2.5, -1.5, -0.5, 0.5)]
    radius = torch.tensor([0.6])
    value = route.cost_to_go(route.step_cost(torch.tensor([wall]), radius, soft_margin=0.6), GOAL)
    path = torch.stack([route.follow(value, torch.tensor([[0.1, 0.1]]), cells)[0] for cells in range(80)])
    assert path[-1].tolist() == pytest.approx(GOAL[0].tolist(), abs=1e-4)
    beside = (path[:, 0] - 6.0).abs() < 0.5
    assert beside.any()
    assert (path[beside, 1] >= 1.0 + 0.6 - 0.1).all()  # half a cell of rounding
    assert path[:, 1].max() < 3.0


def test_rows_are_routed_on_their_own():
    """Catches a leak between scenes of a batch."""
    obstacles = torch.tensor([[[6.0, 0.0, 0.0, 1.0]], [[6.0, 0.0, 0.0, 0.0]]])
    cost = route.step_cost(obstacles, torch.tensor([0.6, 0.6]), soft_margin=0.6)
    goals, starts = GOAL.repeat(2, 1), torch.tensor([[0.1, 0.1]]).repeat(2, 1)
    both = route.cost_to_go(cost, goals)
    for row in (0, 1):
        alone = route.cost_to_go(cost[row : row + 1], goals[row : row + 1])
        assert torch.equal(both[row], alone[0])
    points = route.follow(both, starts, 28)
    assert abs(points[0, 1].item()) > 0.8
    assert points[1, 1].item() == pytest.approx(0.1, abs=1e-4)
