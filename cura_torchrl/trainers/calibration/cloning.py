"""Copy one world of an environment into all worlds of another: simulator, task, controller, LiDAR and map.

The two environments must have different numbers of worlds: the axis along which two tensors differ is that of the
worlds. So nothing here names a part of the state, and what is added to it is copied too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase

from cura_torchrl.envs.mdp import scenarios
from cura_torchrl.envs.robots import ridgeback_franka as model
from cura_torchrl.envs.sensors.noise import noise_key

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

_OWN = {"_all_rows", "_next_episode"}
"""Attributes that number the worlds and stay as they are."""
_NEVER = 1e9
"""Time of appearance of an obstacle that does not appear [s]."""


def copy_world(source: EnvBase, row: int, target: EnvBase) -> None:
    """Copy the state of a world into every world of another environment, noise included.

    Args:
        source: Environment with its transforms.
        row: Its world to copy.
        target: The same environment with another number of worlds, stepped at least once.

    Raises:
        ValueError: If both have as many worlds.
    """
    if source.batch_size == target.batch_size:
        msg = f"both environments have {target.batch_size[0]} worlds; accepted: different numbers"
        raise ValueError(msg)
    seen: set[int] = set()
    for part, other in zip([source.base_env, *source.transform], [target.base_env, *target.transform], strict=True):
        _merge(part, other, row, seen)


def _merge(source: Any, target: Any, row: int, seen: set[int]) -> Any:
    """Return the target with the source's row in place of its rows."""
    if isinstance(target, torch.Tensor):
        return _spread(source, target, row)
    if isinstance(target, TensorDictBase):
        return source[row].expand(target.batch_size).clone()
    if isinstance(target, (tuple, list)) and type(target) is not torch.Size:
        values = [_merge(one, other, row, seen) for one, other in zip(source, target, strict=True)]
        return type(target)(*values) if hasattr(target, "_fields") else type(target)(values)
    is_ours = type(target).__module__.startswith("cura_torchrl") and hasattr(target, "__dict__")
    if id(target) in seen or not (is_ours or isinstance(target, dict)):
        return target
    seen.add(id(target))
    inside, other = (x if isinstance(x, dict) else vars(x) for x in (target, source))
    for name in inside.keys() & other.keys() - _OWN:
        inside[name] = _merge(other[name], inside[name], row, seen)
    return target


def _spread(source: torch.Tensor, target: torch.Tensor, row: int) -> torch.Tensor:
    if source.shape == target.shape:
        return target  # does not depend on the world
    axes = [axis for axis in range(target.ndim) if source.shape[axis] != target.shape[axis]]
    if len(axes) != 1:
        msg = f"shapes {tuple(source.shape)} and {tuple(target.shape)} differ along axes {axes}; accepted: one"
        raise ValueError(msg)
    value = source.narrow(axes[0], row, 1).expand_as(target)
    if 0 in target.stride():
        return value.clone()
    return target.copy_(value)  # in place: parts of the environment hold views of one another's arrays


def vary(env: EnvBase, seeds: torch.Tensor) -> None:
    """Give every world its own noise of the LiDAR and its own obstacles still to come, drawn given the past.

    Obstacles appear at independent, uniform times and their number is uniform in 0..K, so given that ``a`` have
    appeared by time t, another ``f`` will with probability proportional to C(a + f, a) (1 - t / T)^f. Their times,
    sizes, yaws and places are drawn anew. Those that have appeared stay, also where no ray has met them yet.

    Args:
        env: Environment whose worlds are all at the same time, as :func:`copy_world` leaves them.
        seeds: One seed a world, int64, shape ``[N]``.
    """
    base = env.base_env
    config = base.config.task.scenario
    base._lidar.reset(torch.arange(len(seeds)), noise_key(17, 0, seeds))
    fresh = scenarios.sample_scenarios(
        config, stream="vae", seed=17, episodes=seeds, max_obstacles=None, tcp_reach=model.HOME_TCP[0]
    )
    present = base.obstacles[0]
    time = float(base._elapsed[0]) * base.config.task.policy_period
    last = config.obstacle_time[1]
    more = _draw_more(present.sum(-1), max(0.0, 1.0 - time / last), config.max_obstacles, fresh["goal_pose"][:, 2])
    order = fresh["obstacle_yaw"].masked_fill(present, torch.inf).argsort(-1).argsort(-1)
    share = (fresh["obstacle_time"] - config.obstacle_time[0]) / (last - config.obstacle_time[0])
    appears = torch.where(order < more[:, None], time + share * (last - time), _NEVER)
    scene = base.scenario
    scene["obstacle_time"] = torch.where(present, scene["obstacle_time"], appears)
    scene["num_obstacles"] = torch.full_like(scene["num_obstacles"], scenarios.OBSTACLE_SLOTS)
    for name in ("obstacle_edge", "obstacle_yaw"):
        scene[name] = torch.where(present, scene[name], fresh[name])
    scene["obstacle_place"] = torch.where(present[..., None, None], scene["obstacle_place"], fresh["obstacle_place"])


def put_obstacles(env: EnvBase, pose: torch.Tensor, edge: torch.Tensor, adversarial: torch.Tensor) -> None:
    """Put obstacles in place of those that have appeared, without telling the robot: nothing is scanned.

    Args:
        env: Environment on the planar simulator.
        pose: Obstacles (x [m], y [m], yaw [rad]), world frame, float64, shape ``[N, 6, 3]``.
        edge: Their edges [m], 0 where there is none, float64, shape ``[N, 6]``.
        adversarial: Whether those still to come appear on the object-to-goal line, bool, shape ``[N]``.
    """
    base, is_there = env.base_env, edge > 0
    base._obstacle_active, base._obstacle_pose = is_there.clone(), pose.clone()
    base.scenario["obstacle_edge"] = torch.where(is_there, edge, base.scenario["obstacle_edge"])
    base.scenario["adversarial"] = adversarial.clone()
    base._worlds.place_obstacles(torch.ones_like(is_there), pose, edge)


def remove_obstacles(env: EnvBase, rows: torch.Tensor) -> None:
    """Leave worlds without obstacles, now and until their reset: what goes on after a collision drives through them.

    Args:
        env: Environment on the planar simulator.
        rows: Which worlds, bool, shape ``[N]``.
    """
    base = env.base_env
    base._obstacle_active = base._obstacle_active & ~rows[:, None]
    base.scenario["num_obstacles"] = base.scenario["num_obstacles"].masked_fill(rows, 0)
    edge = torch.where(base._obstacle_active, base.scenario["obstacle_edge"], 0.0)
    base._worlds.place_obstacles(rows[:, None].expand_as(edge), base._obstacle_pose, edge)


def _draw_more(there: torch.Tensor, left: float, most: int, angle: torch.Tensor) -> torch.Tensor:
    """Return how many obstacles are still to come, drawn from its distribution by uniform angles, int64, ``[N]``."""
    more = torch.arange(most + 1, dtype=torch.float64)
    total = there[:, None] + more
    ways = torch.lgamma(total + 1) - torch.lgamma(more + 1)
    ways = ways - ways[:, :1]  # C(a + f, a) up to a factor of the row, which must not overflow
    weight = torch.where(total <= most, torch.exp(ways) * left**more, 0.0)
    uniform = (angle / (2 * torch.pi) + 0.5).clamp(0.0, 1.0 - 1e-12)[:, None]
    return torch.searchsorted((weight / weight.sum(-1, keepdim=True)).cumsum(-1), uniform).squeeze(-1)
