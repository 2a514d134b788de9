"""Episodes' draws, and obstacles that appear while an episode runs.

The draws are a pure function of (stream, seed, episode index): a fixed order of counter-based uniform numbers, so batch
size, worker count and reset order never change a scene. The most obstacles K scales the count alone, and the number of
fallbacks only adds places.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict

from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import STREAMS
from cura_torchrl.validation import require

if TYPE_CHECKING:
    from cura_torchrl.envs.config import ScenarioConfig, Stream

OBSTACLE_SLOTS = 6
"""Obstacles that are drawn for every episode [1]; the first ``num_obstacles`` of them appear."""

CHASSIS_HALF = (0.480, 0.3965)
"""Half extents of the base's chassis [m]; ridgeback_description: 0.960 m by 0.793 m."""

ARM_HALF_WIDTH = 0.15
"""Half width of the strip from the chassis' front to the TCP that stands for the arm seen from above [m]."""

ARM_LEAST_REACH = 1e-3
"""A TCP nearer to the chassis' front than this is the front's own: there is no arm [m]."""

CHASSIS_START_GAP = 0.1
"""Least distance of the chassis from the plane of the object's rear face at the start [m]."""

_DRAWS = (
    "object_edge", "object_mass", "floor_friction", "com_x", "com_y", "com_z", "object_y", "object_yaw",
    "goal_x", "goal_y", "goal_yaw", "start_gap", "start_lateral", "start_yaw", "num_obstacles", "adversarial",
    "face", "face_along", "face_height",
)  # fmt: skip
"""One uniform number each, in this order; then the obstacles' edges, times, yaws; then the places, fallback by
fallback."""


def sample_scenarios(
    config: ScenarioConfig,
    *,
    stream: Stream,
    seed: int,
    episodes: torch.Tensor,
    max_obstacles: int | torch.Tensor | None,
    tcp_reach: float,
) -> TensorDict:
    """Return what the given episodes look like.

    ======================  ================  ==========================================================================
    Leaf                    Shape             Meaning (float64 and world frame unless said otherwise)
    ======================  ================  ==========================================================================
    ``object_edge``         ``[B]``           object's edge [m]
    ``object_mass``         ``[B]``           object's mass [kg]
    ``floor_friction``      ``[B]``           Coulomb friction between object and floor [1]
    ``com_offset``          ``[B, 3]``        object's centre of mass in its own frame [m]
    ``object_pose``         ``[B, 3]``        object's start (x [m], y [m], yaw [rad])
    ``goal_pose``           ``[B, 3]``        goal (x [m], y [m], yaw [rad])
    ``robot_pose``          ``[B, 3]``        base's start (x [m], y [m], yaw [rad])
    ``num_obstacles``       ``[B]``           how many obstacles appear, int64
    ``obstacle_edge``       ``[B, 6]``        obstacles' edges [m]
    ``obstacle_time``       ``[B, 6]``        when they appear [s]
    ``obstacle_yaw``        ``[B, 6]``        obstacles' yaws [rad]
    ``obstacle_place``      ``[B, 6, F, 2]``  ordered places to try, uniform in [0, 1), see :func:`spawn_obstacles`
    ``adversarial``         ``[B]``           whether obstacles appear on the object-to-goal line, bool
    ``surface_point``       ``[B, 3]``        p_r, uniform on the object's vertical faces, in the object's frame [m]
    ======================  ================  ==========================================================================

    Args:
        config: Layout and ranges.
        stream: Which independent stream of scenarios.
        seed: Which family of scenarios within the stream, 0 to ``2**63``.
        episodes: Indices of the episodes, not negative, int64, shape ``[B]``.
        max_obstacles: Most obstacles K, 0 to 6, one number or int64 of shape ``[B]``; None takes the config's.
        tcp_reach: Distance of the TCP ahead of the base's centre at the start [m].

    Returns:
        The scenarios on the device of ``episodes``, batch size ``[B]``. A seed, an episode or a K out of range is
        refused with a ValueError.

    Examples:
        >>> from cura_torchrl.envs.config import ScenarioConfig
        >>> episodes = torch.tensor([3, 7])
        >>> scenario = sample_scenarios(
        ...     ScenarioConfig(), stream="eval", seed=0, episodes=episodes, max_obstacles=None, tcp_reach=0.9
        ... )
        >>> scenario["obstacle_place"].shape
        torch.Size([2, 6, 8, 2])
    """
    draw, slots, place = _uniforms(config, stream, seed, episodes)
    edge = _choose(config.object_edges, draw["object_edge"])
    object_pose = torch.stack(
        (
            torch.zeros_like(edge),
            _within(config.object_y, draw["object_y"]),
            _within(config.object_yaw, draw["object_yaw"]),
        ),
        -1,
    )
    goal_yaw = _within((-math.pi, math.pi), draw["goal_yaw"])
    goal = (_within(config.goal_x, draw["goal_x"]), _within(config.goal_y, draw["goal_y"]), goal_yaw)
    com = torch.stack((draw["com_x"], draw["com_y"], draw["com_z"]), -1)
    share = {"uniform": 0.0, "mixed": 0.5, "adversarial": 1.0}[config.kind]
    leaves = {
        "object_edge": edge,
        "object_mass": _within(config.object_mass, draw["object_mass"]),
        "floor_friction": _within(config.floor_friction, draw["floor_friction"]),
        "com_offset": _within((-config.com_shift, config.com_shift), com) * edge.unsqueeze(-1),
        "object_pose": object_pose,
        "goal_pose": torch.stack(goal, -1),
        "robot_pose": _robot_pose(config, draw, object_pose, edge, tcp_reach),
        "num_obstacles": _count(config, max_obstacles, draw["num_obstacles"]),
        "obstacle_edge": _choose(config.obstacle_edges, slots[..., 0]),
        "obstacle_time": _within(config.obstacle_time, slots[..., 1]),
        "obstacle_yaw": _within((-math.pi, math.pi), slots[..., 2]),
        "obstacle_place": place,
        "adversarial": draw["adversarial"] < share,
        "surface_point": _surface_point(draw, edge),
    }
    return TensorDict(leaves, batch_size=episodes.shape)


def due_obstacles(scenario: TensorDict, active: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """Return which obstacles' time has come and which are not there yet, as far as the episode has them.

    Args:
        scenario: From :func:`sample_scenarios`, batch size ``[B]``.
        active: Whether each obstacle is there already, bool, shape ``[B, 6]``.
        time: Time since the start of the episode [s], shape ``[B]``.

    Returns:
        Mask, bool, shape ``[B, 6]``.
    """
    slots = torch.arange(active.shape[1], device=active.device)
    comes = slots < scenario["num_obstacles"].unsqueeze(-1)
    return comes & ~active & (scenario["obstacle_time"] <= time.unsqueeze(-1))


def spawn_obstacles(
    config: ScenarioConfig,
    scenario: TensorDict,
    active: torch.Tensor,
    pose: torch.Tensor,
    *,
    time: torch.Tensor,
    base_pose: torch.Tensor,
    tcp_position: torch.Tensor,
    object_pose: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Let the obstacles appear whose time has come and which find room.

    From its time on, an obstacle takes the first of its places that is at least ``obstacle_clearance`` from the
    surfaces of chassis, arm and object, and clear of the obstacles that are there, those of lower slots in the same
    call included; if there is none it waits for the next call. A uniform scenario spreads the places over the region;
    an adversarial one puts them on the line from where the object is now to the goal, and only those with an x in the
    region count.

    Args:
        config: Region, clearances and jitter.
        scenario: From :func:`sample_scenarios`, batch size ``[B]``.
        active: Whether each obstacle is there already, bool, shape ``[B, 6]``; not mutated.
        pose: Obstacles' (x [m], y [m], yaw [rad]), any value where not active, shape ``[B, 6, 3]``; not mutated.
        time: Time since the start of the episode [s], shape ``[B]``.
        base_pose: Base (x [m], y [m], yaw [rad]), shape ``[B, 3]``.
        tcp_position: TCP in the plane [m], shape ``[B, 2]``.
        object_pose: Object (x [m], y [m], yaw [rad]), shape ``[B, 3]``.

    Returns:
        New ``(active, pose)``, same shapes. What was active is unchanged.
    """
    # Rectangle distances are the costly part and few obstacles are due in a step: only those are computed.
    rows, slots = due_obstacles(scenario, active, time).nonzero(as_tuple=True)
    if len(rows) == 0:
        return active.clone(), pose.clone()
    place = torch.zeros_like(scenario["obstacle_place"])
    has_room = torch.zeros(place.shape[:-1], dtype=torch.bool, device=place.device)
    uniform, goal = scenario["obstacle_place"][rows, slots], scenario["goal_pose"][rows, :2]
    due_place, is_allowed = _places(config, uniform, scenario["adversarial"][rows], object_pose[rows, :2], goal)
    surfaces = bodies(base_pose[rows], tcp_position[rows], object_pose[rows], scenario["object_edge"][rows])
    yaw, edge = scenario["obstacle_yaw"][rows, slots], scenario["obstacle_edge"][rows, slots]
    place[rows, slots] = due_place
    has_room[rows, slots] = is_allowed & (_clearance(due_place, yaw, edge, surfaces) >= config.obstacle_clearance)
    return _take_places(config, scenario, active, pose, place=place, has_room=has_room)


def _take_places(
    config: ScenarioConfig,
    scenario: TensorDict,
    active: torch.Tensor,
    pose: torch.Tensor,
    *,
    place: torch.Tensor,
    has_room: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return new (active, pose): each slot in turn takes its first place with room and clear of other obstacles."""
    active, pose = active.clone(), pose.clone()
    radius = scenario["obstacle_edge"] / math.sqrt(2.0)
    row = torch.arange(len(active), device=active.device)
    for slot in range(active.shape[1]):
        distance = geometry.norm(place[:, slot, :, None] - pose[:, None, :, :2])
        needed = radius[:, slot, None] + radius + config.obstacle_gap
        is_clear = ((distance >= needed.unsqueeze(-2)) | ~active.unsqueeze(-2)).all(-1)
        is_free = has_room[:, slot] & is_clear
        chosen = place[row, slot, is_free.to(torch.int64).argmax(-1)]
        new_pose = torch.cat((chosen, scenario["obstacle_yaw"][:, slot, None]), -1)
        is_placed = is_free.any(-1)
        pose[:, slot] = torch.where(is_placed.unsqueeze(-1), new_pose, pose[:, slot])
        active[:, slot] = active[:, slot] | is_placed
    return active, pose


def _places(
    config: ScenarioConfig,
    uniform: torch.Tensor,
    is_adversarial: torch.Tensor,
    object_position: torch.Tensor,
    goal_position: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the places that one obstacle per row may try, ``[M, F, 2]``, and whether each is allowed, ``[M, F]``."""
    along, across = uniform.unbind(-1)
    region = torch.stack((_within(config.obstacle_x, along), _within(config.obstacle_y, across)), -1)
    line = goal_position - object_position
    length = geometry.norm(line).unsqueeze(-1)
    direction = line / torch.where(length == 0, 1.0, length)
    left = torch.stack((-direction[..., 1], direction[..., 0]), -1).unsqueeze(-2)
    jitter = _within((-config.adversarial_jitter, config.adversarial_jitter), across).unsqueeze(-1)
    on_line = object_position.unsqueeze(-2) + along.unsqueeze(-1) * line.unsqueeze(-2) + jitter * left
    is_inside = (on_line[..., 0] >= config.obstacle_x[0]) & (on_line[..., 0] <= config.obstacle_x[1])
    is_adversarial = is_adversarial.unsqueeze(-1)
    return torch.where(is_adversarial.unsqueeze(-1), on_line, region), is_inside | ~is_adversarial


def bodies(
    base_pose: torch.Tensor, tcp_position: torch.Tensor, object_pose: torch.Tensor, object_edge: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return chassis, arm and object as rectangles, the arm as a strip from the chassis's front to the TCP.

    Args:
        base_pose: Base (x [m], y [m], yaw [rad]), world frame, shape ``[N, 3]``.
        tcp_position: TCP in the plane, world frame [m], shape ``[N, 2]``.
        object_pose: Object (x [m], y [m], yaw [rad]), world frame, shape ``[N, 3]``.
        object_edge: Its edge [m], shape ``[N]``.

    Returns:
        Their (x [m], y [m], yaw [rad]), shape ``[N, 3, 3]``, and half extents [m], shape ``[N, 3, 2]``.
    """
    chassis_half = base_pose.new_tensor(CHASSIS_HALF).expand(len(base_pose), 2)
    front = geometry.from_frame(base_pose, base_pose.new_tensor((CHASSIS_HALF[0], 0.0)).expand(len(base_pose), 2))
    arm = tcp_position - front
    arm_pose = torch.cat(((front + tcp_position) / 2, geometry.angle_of(arm).unsqueeze(-1)), -1)
    arm_length = geometry.norm(arm)
    arm_half = torch.stack((arm_length / 2, _arm_half_width(arm_length)), -1)
    object_half = (object_edge / 2).unsqueeze(-1).expand(-1, 2)
    return torch.stack((base_pose, arm_pose, object_pose), -2), torch.stack((chassis_half, arm_half, object_half), -2)


def _arm_half_width(reach: torch.Tensor) -> torch.Tensor:
    """Return half the width of the strip that stands for the arm, 0 where there is none.

    Args:
        reach: Distance from the chassis' front to the TCP [m], shape ``[*]``.

    Returns:
        Half widths [m], shape ``[*]``.
    """
    return torch.where(reach < ARM_LEAST_REACH, 0.0, torch.full_like(reach, ARM_HALF_WIDTH))


def _clearance(
    place: torch.Tensor, yaw: torch.Tensor, edge: torch.Tensor, surfaces: tuple[torch.Tensor, torch.Tensor]
) -> torch.Tensor:
    """Return each place's distance from the nearest surface [m], ``[M, F]``."""
    pose = torch.cat((place, yaw[:, None, None].expand(-1, place.shape[1], 1)), -1)
    half = (edge / 2)[:, None].expand(-1, 2)
    surface_pose, surface_half = surfaces
    distance = geometry.rectangle_distance(
        pose.unsqueeze(1), half[:, None, None], surface_pose.unsqueeze(2), surface_half.unsqueeze(2)
    )
    return distance.amin(1)


def _uniforms(
    config: ScenarioConfig, stream: Stream, seed: int, episodes: torch.Tensor
) -> tuple[dict[str, torch.Tensor], torch.Tensor, torch.Tensor]:
    """Return named draws ``[B]``, the obstacles' (edge, time, yaw) ``[B, 6, 3]`` and places ``[B, 6, F, 2]``."""
    require(0 <= seed <= 2**63, "seed", seed, "0 to 2**63")
    index = episodes.detach().cpu().numpy()
    require(not (index < 0).any(), "episodes", episodes, "indices that are not negative")
    num_slot_draws = 3 * OBSTACLE_SLOTS
    count = len(_DRAWS) + num_slot_draws + 2 * OBSTACLE_SLOTS * config.num_fallbacks
    key = np.array([seed, STREAMS.index(stream)], dtype=np.uint64)
    # The counter's first word counts the blocks of an episode's draws: the episode is the second.
    streams = [np.random.Philox(key=key, counter=[0, episode, 0, 0]) for episode in index.tolist()]
    draws = np.array([np.random.Generator(bits).random(count) for bits in streams]).reshape(len(index), count)
    uniform = torch.from_numpy(draws).to(episodes.device)
    num_named = len(_DRAWS)
    named, slots, place = uniform.tensor_split((num_named, num_named + num_slot_draws), -1)
    return (
        dict(zip(_DRAWS, named.unbind(-1), strict=True)),
        slots.reshape(-1, 3, OBSTACLE_SLOTS).transpose(-1, -2),
        place.reshape(-1, config.num_fallbacks, OBSTACLE_SLOTS, 2).transpose(-2, -3).contiguous(),
    )


def _within(interval: tuple[float, float], uniform: torch.Tensor) -> torch.Tensor:
    return interval[0] + (interval[1] - interval[0]) * uniform


def _choose(options: tuple[float, ...], uniform: torch.Tensor) -> torch.Tensor:
    return uniform.new_tensor(options)[(uniform * len(options)).long()]


def _count(config: ScenarioConfig, max_obstacles: int | torch.Tensor | None, uniform: torch.Tensor) -> torch.Tensor:
    """Return a count that is uniform in 0..K, int64, ``[B]``."""
    most = torch.as_tensor(config.max_obstacles if max_obstacles is None else max_obstacles, device=uniform.device)
    is_valid = bool(((most >= 0) & (most <= OBSTACLE_SLOTS)).all())
    require(is_valid, "max_obstacles", max_obstacles, f"0 to {OBSTACLE_SLOTS}")
    return (uniform * (most + 1)).long()


def _robot_pose(
    config: ScenarioConfig,
    draw: dict[str, torch.Tensor],
    object_pose: torch.Tensor,
    edge: torch.Tensor,
    tcp_reach: float,
) -> torch.Tensor:
    """Return the base's pose behind the object, ``[B, 3]``.

    The TCP lies ``start_gap`` behind the plane of the face that looks backwards most, ``start_lateral`` along that face
    from its middle. Where the chassis would come too near that plane the robot is moved back along the face's normal.
    """
    yaw = _within(config.start_yaw, draw["start_yaw"])
    face_yaw = geometry.quarter_turn(object_pose[..., 2])
    face = torch.cat((object_pose[..., :2], face_yaw.unsqueeze(-1)), -1)
    heading = yaw - face_yaw
    x = -edge / 2 - _within(config.start_gap, draw["start_gap"]) - tcp_reach * heading.cos()
    y = _within(config.start_lateral, draw["start_lateral"]) - tcp_reach * heading.sin()
    foremost = x + CHASSIS_HALF[0] * heading.cos().abs() + CHASSIS_HALF[1] * heading.sin().abs()
    x = x - (foremost + edge / 2 + CHASSIS_START_GAP).clamp(min=0.0)
    return torch.cat((geometry.from_frame(face, torch.stack((x, y), -1)), yaw.unsqueeze(-1)), -1)


def _surface_point(draw: dict[str, torch.Tensor], edge: torch.Tensor) -> torch.Tensor:
    """Return a uniform point on the vertical faces in the object's frame [m], ``[B, 3]``."""
    side = (draw["face"] * 4).long()
    along = (draw["face_along"] - 0.5) * edge
    height = (draw["face_height"] - 0.5) * edge
    sign = (1 - 2 * (side % 2)).to(edge.dtype)
    normal = sign * edge / 2
    is_x_face = side < 2
    return torch.stack((torch.where(is_x_face, normal, along), torch.where(is_x_face, along, normal), height), -1)
