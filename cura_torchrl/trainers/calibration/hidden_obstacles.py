"""Where obstacles may be that the robot has not seen: drawn from the scenario's prior, kept where they agree with it.

What is drawn is how many obstacles there are besides those that were seen, their sizes, yaws, times and places. A draw
is replayed beside the recorded paths of robot and object, by the rules by which obstacles appear, and kept if none of
its obstacles lies in a cell that was seen, or passed by the object, at or after its appearance: rejection sampling.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.mdp import scenarios
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.sensors import visibility

if TYPE_CHECKING:
    from tensordict import TensorDict

    from cura_torchrl.envs.config import ScenarioConfig
    from cura_torchrl.envs.sensors.visibility import MapGrid

_NEVER = 1e9
"""Time of an obstacle that is put in place by hand [s]."""
_SEED = 23
"""Seed of the draws within the stream of scenarios that no policy is trained or evaluated on."""
_TOUCH = 0.05
"""How much wider than the object its path is, on each side [m]: half a cell."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Past:
    """What has happened in an episode until step T, as the robot knows it. World frame."""

    base_pose: torch.Tensor
    """Base (x [m], y [m], yaw [rad]) at every step, float64, shape ``[T + 1, 3]``."""
    tcp_position: torch.Tensor
    """TCP in the plane [m], float64, shape ``[T + 1, 2]``."""
    object_pose: torch.Tensor
    """Object (x [m], y [m], yaw [rad]), float64, shape ``[T + 1, 3]``."""
    object_edge: float
    """Its edge [m]."""
    goal_pose: torch.Tensor
    """Goal (x [m], y [m], yaw [rad]), float64, shape ``[3]``."""
    seen: torch.Tensor
    """Obstacles that a ray has hit (x [m], y [m], yaw [rad], edge [m]), float64, shape ``[M, 4]``."""
    seen_since: torch.Tensor
    """Step at which each of them appeared [1], shape ``[M]``."""
    age: torch.Tensor
    """Steps since each cell was last observed, infinite for never, shape ``[num_rows, num_columns]``."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layouts:
    """A draws of the obstacles that are there, those that were seen first."""

    pose: torch.Tensor
    """Obstacles (x [m], y [m], yaw [rad]), float64, shape ``[A, 6, 3]``."""
    edge: torch.Tensor
    """Their edges [m], 0 where there is none, float64, shape ``[A, 6]``."""
    since: torch.Tensor
    """Steps at which they appeared [1], shape ``[A, 6]``."""
    adversarial: torch.Tensor
    """Whether obstacles appear on the object-to-goal line, bool, shape ``[A]``."""

    def take(self, rows: torch.Tensor) -> Layouts:
        """Return some of them.

        Args:
            rows: Indices, with repetition where need be, shape ``[B]``.

        Returns:
            B layouts.
        """
        return Layouts(
            pose=self.pose[rows], edge=self.edge[rows], since=self.since[rows], adversarial=self.adversarial[rows]
        )


def draw_layouts(
    config: ScenarioConfig, past: Past, grid: MapGrid, *, candidates: int, seed: int, period: float
) -> Layouts:
    """Return draws of the obstacles that are there, given what was seen.

    Args:
        config: The scenario's prior.
        past: What has happened.
        grid: Cells of the map.
        candidates: Draws from the prior [1].
        seed: Seed of the draws; the same seed gives the same.
        period: Time of a policy step [s].

    Returns:
        The draws that agree with what was seen, fewer than ``candidates``; there may be none.
    """
    generator = torch.Generator().manual_seed(seed)
    scene = _draw(config, past, candidates, seed, generator)
    active, pose, since = _replay(config, past, scene, period)
    is_extra = active.clone()
    is_extra[:, : len(past.seen)] = False
    clear = last_clear(past, grid)
    is_kept = ~contradicted(clear, grid, pose, scene["obstacle_edge"], since, is_extra).any(-1)
    return Layouts(
        pose=torch.where(active[..., None], pose, 0.0),
        edge=torch.where(active, scene["obstacle_edge"], 0.0),
        since=since,
        adversarial=scene["adversarial"],
    ).take(is_kept.nonzero().squeeze(-1))


def last_clear(past: Past, grid: MapGrid) -> torch.Tensor:
    """Return the last step at which each cell was certainly free of what has not been seen.

    Args:
        past: What has happened.
        grid: Cells of the map.

    Returns:
        Step, -1 for never [1], shape ``[num_rows, num_columns]``.
    """
    now = len(past.base_pose) - 1
    seen = torch.where(past.age.isfinite(), now - past.age, -1.0)
    x, y = torch.meshgrid(grid.row_x(), grid.column_y(), indexing="ij")
    size = torch.full((2,), past.object_edge)
    passed = torch.full_like(seen, -1.0)
    for step, pose in enumerate(past.object_pose.float()):
        inside = visibility.inside_rectangle(x.reshape(1, -1), y.reshape(1, -1), pose[None], size, _TOUCH)
        passed[inside.view_as(passed)] = step
    return torch.maximum(seen, passed)


def contradicted(
    clear: torch.Tensor,
    grid: MapGrid,
    pose: torch.Tensor,
    edge: torch.Tensor,
    since: torch.Tensor,
    is_there: torch.Tensor,
) -> torch.Tensor:
    """Tell which obstacles cannot be where they are: they cover the centre of a cell that was clear later.

    Args:
        clear: As :func:`last_clear` returns it, shape ``[num_rows, num_columns]``.
        grid: Cells of the map.
        pose: Obstacles (x [m], y [m], yaw [rad]), shape ``[A, 6, 3]``.
        edge: Their edges [m], shape ``[A, 6]``.
        since: Step at which each appeared [1], shape ``[A, 6]``.
        is_there: Which of them to look at, bool, shape ``[A, 6]``.

    Returns:
        Whether a cell whose centre the obstacle covers was clear at its appearance or later, bool, shape ``[A, 6]``.
    """
    result = torch.zeros_like(is_there)
    rows, slots = is_there.nonzero(as_tuple=True)
    flat_clear = clear.flatten()
    # The middle alone settles most of them.
    for reach in (0, math.ceil(float(edge.max()) / math.sqrt(2.0) / grid.resolution) + 1):
        centre, begin = pose[rows, slots].float(), since[rows, slots]
        steps = torch.arange(-reach, reach + 1) * grid.resolution
        x = (centre[:, 0, None, None] + steps[:, None]).expand(-1, -1, len(steps)).flatten(1)
        y = (centre[:, 1, None, None] + steps).expand(-1, len(steps), -1).flatten(1)
        cell, is_inside = visibility.cell_of_points(grid, x.clone(), y.clone())
        middle_x = grid.row_x()[cell // grid.num_columns]
        middle_y = grid.column_y()[cell % grid.num_columns]
        size = edge[rows, slots, None].float().expand(-1, 2)
        covered = visibility.inside_rectangle(middle_x, middle_y, centre, size) & is_inside
        is_wrong = (covered & (flat_clear[cell] >= begin[:, None])).any(-1)
        result[rows[is_wrong], slots[is_wrong]] = True
        rows, slots = rows[~is_wrong], slots[~is_wrong]
    return result


def adversarial_share(config: ScenarioConfig, past: Past) -> float:
    """Return how likely obstacles appear on the object-to-goal line, given where those appeared that were seen.

    Clearances, which shrink both regions a little, are left out of the densities.

    Args:
        config: The scenario's prior.
        past: What has happened.

    Returns:
        Probability [1].
    """
    if config.kind != "mixed":
        return float(config.kind == "adversarial")
    (left, right), (low, high), jitter = config.obstacle_x, config.obstacle_y, config.adversarial_jitter
    odds = 1.0
    for place, step in zip(past.seen[:, :2], past.seen_since.long().tolist(), strict=True):
        start = past.object_pose[step, :2]
        line = past.goal_pose[:2] - start
        length = float(geometry.norm(line))
        along, across = geometry.rotate(place - start, -geometry.angle_of(line)).tolist()
        if not (0.0 <= along <= length and abs(across) <= jitter + 1e-4):
            return 0.0
        shares = (torch.tensor([left, right]) - start[0]) / line[0]
        inside = float(shares.clamp(0.0, 1.0).diff())
        odds *= (right - left) * (high - low) / (2.0 * jitter * length * inside)
    return odds / (1.0 + odds)


def _draw(config: ScenarioConfig, past: Past, candidates: int, seed: int, generator: torch.Generator) -> TensorDict:
    """Return scenarios whose first obstacles are those that were seen."""
    episodes = torch.arange(candidates) + seed * candidates
    scene = scenarios.sample_scenarios(
        config, stream="vae", seed=_SEED, episodes=episodes, max_obstacles=None, tcp_reach=model.HOME_TCP[0]
    )
    known = len(past.seen)
    # The M that were seen may be any of the n that there are: n is likely in proportion to C(n, M).
    ways = torch.tensor([math.comb(total, known) for total in range(known, config.max_obstacles + 1)])
    extra = torch.multinomial(ways.double(), candidates, replacement=True, generator=generator)
    share = adversarial_share(config, past)
    scene["adversarial"] = torch.rand(candidates, generator=generator, dtype=torch.float64) < share
    scene["num_obstacles"] = known + extra
    scene["obstacle_time"][:, :known] = _NEVER
    scene["obstacle_edge"][:, :known], scene["obstacle_yaw"][:, :known] = past.seen[:, 3], past.seen[:, 2]
    scene["object_edge"] = torch.full_like(scene["object_edge"], past.object_edge)
    scene["goal_pose"] = past.goal_pose.expand(candidates, 3).clone()
    return scene


def _replay(
    config: ScenarioConfig, past: Past, scene: TensorDict, period: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return which obstacles have appeared by now, ``[A, 6]``, where, ``[A, 6, 3]``, and at which step, ``[A, 6]``."""
    shape, known = scene["obstacle_edge"].shape, len(past.seen)
    active, since = torch.zeros(shape, dtype=torch.bool), torch.zeros(shape)
    pose = torch.zeros(*shape, 3, dtype=torch.float64)
    pose[:, :known], since[:, :known] = past.seen[:, :3], past.seen_since.to(since)
    for step in range(len(past.base_pose)):
        active[:, :known] = past.seen_since <= step
        time = torch.full(shape[:1], step * period, dtype=torch.float64)
        rows = scenarios.due_obstacles(scene, active, time).any(-1).nonzero().squeeze(-1)
        if len(rows) == 0:
            continue
        count = len(rows)
        is_there, where = scenarios.spawn_obstacles(
            config, scene[rows], active[rows], pose[rows],
            time=time[rows], base_pose=past.base_pose[step].expand(count, 3),
            tcp_position=past.tcp_position[step].expand(count, 2),
            object_pose=past.object_pose[step].expand(count, 3),
        )  # fmt: skip
        since[rows] = torch.where(is_there & ~active[rows], float(step), since[rows])
        active[rows], pose[rows] = is_there, where
    return active, pose, since
