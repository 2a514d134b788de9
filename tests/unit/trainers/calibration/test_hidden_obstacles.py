"""Redrawn obstacles lie only where they can be, in the numbers that Bayes' rule gives."""

from __future__ import annotations

import math
from contextlib import closing

import pytest
import torch
from torchrl.envs import TransformedEnv

from cura_torchrl.envs.config import MapConfig, PushEnvConfig, ScenarioConfig, TaskConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.sensors.visibility import MapGrid
from cura_torchrl.envs.transforms import ConfidenceMap
from cura_torchrl.trainers.calibration.futures import _Source
from cura_torchrl.trainers.calibration.hidden_obstacles import (
    Past,
    adversarial_share,
    contradicted,
    draw_layouts,
    last_clear,
)

GRID = MapGrid(extent_x=(-6.0, 18.0), extent_y=(-8.0, 8.0), resolution=0.1)
PERIOD = 0.2


def _past(steps: int = 50, seen: tuple[tuple[float, ...], ...] = (), age: torch.Tensor | None = None) -> Past:
    """Return a robot and an object that stand still far behind the region of obstacles."""
    count = steps + 1
    return Past(
        base_pose=torch.tensor([[-1.5, 0.0, 0.0]], dtype=torch.float64).expand(count, 3),
        tcp_position=torch.tensor([[-0.6, 0.0]], dtype=torch.float64).expand(count, 2),
        object_pose=torch.zeros(count, 3, dtype=torch.float64),
        object_edge=0.5,
        goal_pose=torch.tensor([13.0, 0.0, 0.0], dtype=torch.float64),
        seen=torch.tensor(seen, dtype=torch.float64).reshape(-1, 4),
        seen_since=torch.zeros(len(seen)),
        age=torch.full((GRID.num_rows, GRID.num_columns), torch.inf) if age is None else age,
    )


def _draw(past: Past, config: ScenarioConfig | None = None, candidates: int = 2000):
    return draw_layouts(config or ScenarioConfig(), past, GRID, candidates=candidates, seed=4, period=PERIOD)


def test_nothing_seen_leaves_the_prior():
    """Catches a count that is not uniform, or times that are not: 3 of 6 on average, two thirds there after 10 s."""
    layouts = _draw(_past(steps=50))
    assert len(layouts.pose) == 2000
    number = (layouts.edge > 0).sum(-1).double()
    assert number.mean().item() == pytest.approx(2.0, abs=0.15)
    assert layouts.adversarial.double().mean().item() == pytest.approx(0.5, abs=0.04)
    since = layouts.since[layouts.edge > 0]
    assert since.mean().item() == pytest.approx(25.0, abs=1.5)


def test_all_seen_just_now_leaves_nothing_hidden():
    """Catches a draw that ignores what was seen."""
    layouts = _draw(_past(age=torch.zeros(GRID.num_rows, GRID.num_columns)))
    assert (layouts.edge == 0).all()
    # Of 0 to 6 obstacles with equal chance, all have to be still to come after 10 of 15 s: mean of (1/3)^n.
    expected = sum((1 / 3) ** number for number in range(7)) / 7
    assert len(layouts.pose) / 2000 == pytest.approx(expected, abs=0.03)


def test_the_half_that_was_seen_halves_the_odds():
    """Catches weights that do not follow Bayes: one obstacle at most, at once, anywhere, half of its region seen."""
    age = torch.full((GRID.num_rows, GRID.num_columns), torch.inf)
    age[GRID.row_x() > 7.0] = 0.0  # the far half of x = 3 to 11 m
    config = ScenarioConfig(kind="uniform", max_obstacles=1, obstacle_time=(0.0, 0.0), obstacle_edges=(0.4,))
    layouts = _draw(_past(age=age), config)
    # P(hidden) = 0.5 q / (0.5 + 0.5 q) with q the chance of not reaching into the far half, (3.8 of 8 m, roughly).
    q = (7.0 - 0.25 - 3.0) / 8.0
    assert (layouts.edge > 0).any(-1).double().mean().item() == pytest.approx(q / (1 + q), abs=0.03)
    assert layouts.pose[..., 0].max() < 7.0


def test_an_obstacle_may_lie_where_it_was_clear_before_it_appeared_and_not_where_it_was_clear_since():
    """Catches a comparison of times that is off by one or the wrong way round, and cells beside the obstacle."""
    clear = torch.full((GRID.num_rows, GRID.num_columns), -1.0)
    row = int((5.0 + 6.0) / 0.1) + 1
    clear[row, :] = 10.0  # the cells from x = 5.0 to 5.1 m
    pose = torch.tensor([[[5.0, 0.0, 0.0], [5.0, 0.0, 0.0], [4.7, 0.0, 0.0], [4.7, 0.0, math.pi / 4]]])
    edge = torch.full((1, 4), 0.6)
    since = torch.tensor([[10.0, 11.0, 0.0, 0.0]])
    found = contradicted(clear, GRID, pose, edge, since, torch.ones(1, 4, dtype=torch.bool))
    # The third ends at 5.0 m, short of the cells' centres; turned by 45 degrees it reaches 5.12 m.
    assert found.tolist() == [[True, False, False, True]]


def test_the_objects_way_is_clear():
    """Catches an obstacle that the object has passed through unharmed, out of sight of every ray."""
    clear = last_clear(_past(steps=3), GRID)
    x, y = GRID.row_x(), GRID.column_y()
    under = clear[(x.abs() < 0.2).nonzero().squeeze(-1)][:, (y.abs() < 0.2).nonzero().squeeze(-1)]
    assert (under == 3).all()
    assert clear[x > 1.0].max() == -1


def test_an_obstacle_off_the_line_rules_out_the_adversarial_scenario_and_one_on_it_speaks_for_it():
    """Catches odds that are turned round: on the line 48 m^2 against 0.6 m times 8 m, so 10 to 1."""
    config = ScenarioConfig()
    assert adversarial_share(config, _past()) == 0.5
    assert adversarial_share(config, _past(seen=((5.0, 1.0, 0.0, 0.4),))) == 0.0
    assert adversarial_share(config, _past(seen=((5.0, 0.1, 0.0, 0.4),))) == pytest.approx(10 / 11)
    assert adversarial_share(ScenarioConfig(kind="uniform"), _past(seen=((5.0, 0.1, 0.0, 0.4),))) == 0.0


def test_in_real_episodes_what_is_drawn_is_hidden_and_what_is_hidden_could_be_drawn():
    """Catches clocks of map, spawning and paths that do not agree: real hidden obstacles would contradict the map."""
    config = PushEnvConfig(simulator="planar", task=TaskConfig(stream="eval", privileged=True))
    hidden = 0
    with closing(TransformedEnv(PushEnv(12, config, seed=5))) as env:
        env.append_transform(ConfidenceMap(MapConfig(), num_rays=360, max_range=10.0))
        source = _Source(env)
        for _ in range(45):
            source.step(lambda state: state.set("action", torch.tensor([0.6, 0.0, 0.3, 0.0, 0.0, 0.0]).expand(12, 6)))
        for row in range(12):
            past = source.past(row)
            clear = last_clear(past, source.grid)
            active, pose, edge = env.base_env.obstacles
            unknown = active[row] & ~source._sightings.is_known[row]
            hidden += int(unknown.sum())
            since = source._sightings.appeared[row]
            assert not contradicted(
                clear, source.grid, pose[row, None], edge[row, None], since[None], unknown[None]
            ).any()
        layouts = draw_layouts(config.task.scenario, past, source.grid, candidates=500, seed=1, period=PERIOD)
        extra = layouts.edge > 0
        extra[:, : len(past.seen)] = False
        assert torch.allclose(layouts.pose[:, : len(past.seen)], past.seen[:, :3].expand(len(extra), -1, -1))
        # The cell in an obstacle's middle must not have been observed since it appeared.
        row_, slot = extra.nonzero(as_tuple=True)
        x, y = layouts.pose[row_, slot, 0], layouts.pose[row_, slot, 1]
        observed = 45 - past.age[((x + 6.0) / 0.1).long() + 1, ((y + 8.0) / 0.1).long()]
        assert (observed < layouts.since[row_, slot]).all()
    assert hidden > 0
