"""The policy's vector observation: robot, object and goal in the base frame, after the paper's o_p, o_o and p_g."""

from __future__ import annotations

import torch

from cura_torchrl.envs import geometry

_SIZES = {
    "tcp_position": 3,
    "hand_axes": 6,
    "tcp_velocity": 3,
    "base_velocity": 3,
    "object_position": 3,
    "object_heading": 2,
    "object_velocity": 2,
    "object_yaw_rate": 1,
    "goal_position": 2,
    "goal_heading": 2,
    "previous_action": 6,
}

OBSERVATION_SLICES: dict[str, slice] = {
    name: slice(sum(list(_SIZES.values())[:index]), sum(list(_SIZES.values())[: index + 1]))
    for index, name in enumerate(_SIZES)
}
"""Where each part of the observation lies; all in the base frame.

========================  =============================================================================
``tcp_position``          TCP relative to the base [m]; without an arm the TCP is the front face's centre
``hand_axes``             x axis, then y axis, of the hand: the first two columns of its rotation matrix [1]; without
                          an arm those of the base
``tcp_velocity``          velocity of the TCP relative to the world [m/s]
``base_velocity``         base's (x [m/s], y [m/s], yaw rate [rad/s])
``object_position``       object's centre, its height included, which tells the edge [m]
``object_heading``        cosine, sine of four times its yaw relative to the base: quarter turns are alike [1]
``object_velocity``       object's planar velocity relative to the world [m/s]
``object_yaw_rate``       object's yaw rate [rad/s]
``goal_position``         goal's centre in the plane [m]
``goal_heading``          cosine, sine of four times its yaw relative to the base [1]
``previous_action``       last action [1]; last, so that a robot with fewer actions only shortens the vector
========================  =============================================================================
"""

OBSERVATION_SIZE: int = sum(_SIZES.values())
"""Length of the observation for a 6-dimensional action [1]."""


def observation_size(action_size: int) -> int:
    """Return the length of the observation.

    Args:
        action_size: Numbers of an action [1].

    Returns:
        Numbers of an observation [1].

    Examples:
        >>> observation_size(6) == OBSERVATION_SIZE, observation_size(3)
        (True, 30)
    """
    return OBSERVATION_SIZE - _SIZES["previous_action"] + action_size


def _heading(yaw: torch.Tensor) -> torch.Tensor:
    return torch.stack(((4 * yaw).cos(), (4 * yaw).sin()), -1)


def observe(  # noqa: PLR0913 - one argument per measured quantity
    *,
    base_pose: torch.Tensor,
    base_velocity: torch.Tensor,
    tcp_position_b: torch.Tensor,
    hand_rotation_b: torch.Tensor,
    tcp_velocity_b: torch.Tensor,
    previous_action: torch.Tensor,
    object_position: torch.Tensor,
    object_yaw: torch.Tensor,
    object_velocity: torch.Tensor,
    object_yaw_rate: torch.Tensor,
    goal_pose: torch.Tensor,
) -> torch.Tensor:
    """Return the observation in the order of :data:`OBSERVATION_SLICES`.

    Args:
        base_pose: Base (x [m], y [m], yaw [rad]) in the world, shape ``[N, 3]``.
        base_velocity: Base velocity (x [m/s], y [m/s], yaw [rad/s]) in the world, shape ``[N, 3]``.
        tcp_position_b: TCP in the base frame [m], shape ``[N, 3]``.
        hand_rotation_b: Rotation matrix from the hand to the base frame [1], shape ``[N, 3, 3]``.
        tcp_velocity_b: Velocity of the TCP relative to the world, in the base frame [m/s], shape ``[N, 3]``.
        previous_action: Last action [1], shape ``[N, A]``.
        object_position: Object's centre in the world [m], shape ``[N, 3]``.
        object_yaw: Object's yaw in the world [rad], shape ``[N]``.
        object_velocity: Object's velocity in the world [m/s], shape ``[N, 3]``.
        object_yaw_rate: Object's yaw rate [rad/s], shape ``[N]``.
        goal_pose: Goal's (x [m], y [m], yaw [rad]) in the world, shape ``[N, 3]``.

    Returns:
        Observations, float32, shape ``[N, D]``; D is :func:`observation_size` of A.

    Source:
        Paper, section "Policy Architecture": o_p, o_o, p_g.
    """
    base_yaw = base_pose[..., 2]
    parts = (
        tcp_position_b,
        hand_rotation_b[..., 0],
        hand_rotation_b[..., 1],
        tcp_velocity_b,
        geometry.rotate(base_velocity[..., :2], -base_yaw),
        base_velocity[..., 2:],
        geometry.to_frame(base_pose, object_position[..., :2]),
        object_position[..., 2:],
        _heading(object_yaw - base_yaw),
        geometry.rotate(object_velocity[..., :2], -base_yaw),
        object_yaw_rate.unsqueeze(-1),
        geometry.to_frame(base_pose, goal_pose[..., :2]),
        _heading(goal_pose[..., 2] - base_yaw),
        previous_action,
    )
    return torch.cat([part.to(torch.float32) for part in parts], -1)
