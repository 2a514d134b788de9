"""The paper's reward (Table I): one pure function per term, weighted and stacked by :func:`reward_terms`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs import geometry

if TYPE_CHECKING:
    from cura_torchrl.envs.config import RewardConfig

REWARD_TERM_NAMES: tuple[str, ...] = ("keypoint", "progress", "velocity", "contact", "action_rate", "acceleration")
"""Names of the terms r1 to r6 in the order of :func:`reward_terms`."""


def keypoint_reward(config: RewardConfig, object_corners: torch.Tensor, goal_corners: torch.Tensor) -> torch.Tensor:
    """Return r1 = w1 exp(-0.25 ||G_goal - G_object||), the goal's corners relabelled by the best of four quarter turns.

    Args:
        config: Weight and decay.
        object_corners: Object's corners in the order of :func:`~cura_torchrl.envs.geometry.cube_corners` [m], shape
            ``[N, 8, 3]``.
        goal_corners: Goal's corners, same order [m], shape ``[N, 8, 3]``.

    Returns:
        Weighted term [1], shape ``[N]``.

    Source:
        Paper, Table I, r1.
    """
    difference = geometry.quarter_turn_corners(goal_corners) - object_corners.unsqueeze(-3)
    distance = geometry.norm(difference.flatten(-2)).amin(-1)
    return config.keypoint_weight * torch.exp(-config.keypoint_scale * distance)


def progress_reward(
    config: RewardConfig, object_velocity: torch.Tensor, object_position: torch.Tensor, goal_position: torch.Tensor
) -> torch.Tensor:
    """Return r2 = w2 exp(5 (v . p - 1)), v and p the directions of the object's motion and of the goal in the plane.

    A direction is the zero vector, so the term is w2 exp(-5), where the object is slower than ``slow_speed`` or the
    goal nearer than ``near_goal``.

    Args:
        config: Weight, sharpness and the two thresholds.
        object_velocity: Object's velocity in the world [m/s], shape ``[N, 2]`` or ``[N, 3]``; only the plane is read.
        object_position: Object's centre in the world [m], shape ``[N, 2]`` or ``[N, 3]``.
        goal_position: Goal's centre in the world [m], shape ``[N, 2]`` or ``[N, 3]``.

    Returns:
        Weighted term [1], shape ``[N]``.

    Source:
        Paper, Table I, r2.
    """
    motion = _direction(object_velocity[..., :2], config.slow_speed)
    to_goal = _direction(goal_position[..., :2] - object_position[..., :2], config.near_goal)
    return config.progress_weight * torch.exp(config.progress_scale * (geometry.dot(motion, to_goal) - 1))


def _direction(vector: torch.Tensor, threshold: float) -> torch.Tensor:
    length = geometry.norm(vector).unsqueeze(-1)
    is_zero = (length < threshold) | (length == 0)
    return torch.where(is_zero, 0.0, vector / torch.where(is_zero, 1.0, length))


def velocity_reward(config: RewardConfig, object_velocity: torch.Tensor) -> torch.Tensor:
    """Return r3 = w3 ||v|| / v_max.

    Args:
        config: Weight and v_max.
        object_velocity: Object's velocity in the world [m/s], shape ``[N, 2]`` or ``[N, 3]``; only the plane is read,
            so that a fall earns nothing.

    Returns:
        Weighted term [1], shape ``[N]``.

    Source:
        Paper, Table I, r3.
    """
    return config.velocity_weight * (geometry.norm(object_velocity[..., :2]) / config.max_speed)


def contact_reward(config: RewardConfig, surface_point_w: torch.Tensor, tcp_position: torch.Tensor) -> torch.Tensor:
    """Return r4 = w4 exp(-0.1 ||p_r - p_e||).

    Args:
        config: Weight and decay.
        surface_point_w: Point p_r on the object's surface, in the world [m], shape ``[N, 3]``.
        tcp_position: TCP p_e in the world [m], shape ``[N, 3]``.

    Returns:
        Weighted term [1], shape ``[N]``.

    Source:
        Paper, Table I, r4.
    """
    return config.contact_weight * torch.exp(-config.contact_scale * geometry.norm(surface_point_w - tcp_position))


def action_rate_reward(config: RewardConfig, action: torch.Tensor, previous_action: torch.Tensor) -> torch.Tensor:
    """Return r5 = w5 ||a_t - a_{t-1}||, on normalised actions.

    Args:
        config: Weight, negative for a penalty.
        action: Action of this step in [-1, 1] [1], shape ``[N, A]``.
        previous_action: Action of the step before [1], shape ``[N, A]``.

    Returns:
        Weighted term [1], shape ``[N]``.

    Source:
        Paper, Table I, r5.
    """
    return config.action_rate_weight * geometry.norm(action - previous_action)


def acceleration_reward(config: RewardConfig, joint_acceleration: torch.Tensor) -> torch.Tensor:
    """Return r6 = w6 ||q''||.

    Args:
        config: Weight, negative for a penalty.
        joint_acceleration: Finite difference of the joint velocities over the policy step [rad/s^2, or m/s^2 for a
            sliding joint], shape ``[N, J]``.

    Returns:
        Weighted term [1], shape ``[N]``.

    Source:
        Paper, Table I, r6.
    """
    return config.acceleration_weight * geometry.norm(joint_acceleration)


def reward_terms(  # noqa: PLR0913 - one argument per quantity of Table I
    config: RewardConfig,
    *,
    object_corners: torch.Tensor,
    goal_corners: torch.Tensor,
    object_velocity: torch.Tensor,
    object_position: torch.Tensor,
    goal_position: torch.Tensor,
    surface_point_w: torch.Tensor,
    tcp_position: torch.Tensor,
    action: torch.Tensor,
    previous_action: torch.Tensor,
    joint_acceleration: torch.Tensor,
) -> torch.Tensor:
    """Return the weighted reward terms in the order of :data:`REWARD_TERM_NAMES`; their sum is the paper's R.

    Args:
        config: Weights and scales.
        object_corners: Object's corners in the world [m], shape ``[N, 8, 3]``.
        goal_corners: Goal's corners in the world, any of the four labellings [m], shape ``[N, 8, 3]``.
        object_velocity: Object's velocity in the world [m/s], shape ``[N, 2]`` or ``[N, 3]``.
        object_position: Object's centre in the world [m], shape ``[N, 2]`` or ``[N, 3]``.
        goal_position: Goal's centre in the world [m], shape ``[N, 2]`` or ``[N, 3]``.
        surface_point_w: Point p_r on the object's surface, in the world [m], shape ``[N, 3]``.
        tcp_position: TCP in the world [m], shape ``[N, 3]``.
        action: Action of this step in [-1, 1] [1], shape ``[N, A]``.
        previous_action: Action of the step before [1], shape ``[N, A]``.
        joint_acceleration: Joint accelerations [rad/s^2, or m/s^2 for a sliding joint], shape ``[N, J]``.

    Returns:
        Weighted terms [1], shape ``[N, 6]``.

    Source:
        Paper, Table I.
    """
    terms = (
        keypoint_reward(config, object_corners, goal_corners),
        progress_reward(config, object_velocity, object_position, goal_position),
        velocity_reward(config, object_velocity),
        contact_reward(config, surface_point_w, tcp_position),
        action_rate_reward(config, action, previous_action),
        acceleration_reward(config, joint_acceleration),
    )
    return torch.stack([term.to(object_velocity.dtype) for term in terms], -1)
