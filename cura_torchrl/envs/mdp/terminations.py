"""What counts as success and what ends an episode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs import geometry

if TYPE_CHECKING:
    from cura_torchrl.envs.config import TaskConfig


def success_flags(task: TaskConfig, object_pose: torch.Tensor, goal_pose: torch.Tensor) -> torch.Tensor:
    """Return which tolerances the object meets at this moment.

    The last tolerance also asks for the yaw, modulo a quarter turn: the object is a cube.

    Args:
        task: Tolerances.
        object_pose: Object's (x [m], y [m], yaw [rad]) in the world, shape ``[N, 3]``.
        goal_pose: Goal's (x [m], y [m], yaw [rad]) in the world, shape ``[N, 3]``.

    Returns:
        Whether each tolerance is met, bool, shape ``[N, 3]``.

    Examples:
        >>> from cura_torchrl.envs.config import TaskConfig
        >>> success_flags(TaskConfig(), torch.tensor([[12.0, 0.2, 0.0]]), torch.tensor([[12.0, 0.0, 0.0]])).tolist()
        [[True, True, False]]
    """
    distance = geometry.norm(goal_pose[..., :2] - object_pose[..., :2])
    is_within = distance.unsqueeze(-1) <= distance.new_tensor(task.tolerances)
    is_aligned = geometry.quarter_turn(goal_pose[..., 2] - object_pose[..., 2]).abs() <= task.yaw_tolerance
    return torch.cat((is_within[..., :-1], is_within[..., -1:] & is_aligned.unsqueeze(-1)), -1)


def latch_success(
    success: torch.Tensor, steps_since_success: torch.Tensor, *, flags: torch.Tensor, contact: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Carry success over one policy step: a tolerance once met stays met.

    What is met in a step that collides does not count.

    Args:
        success: Tolerances met so far, bool, shape ``[N, 3]``.
        steps_since_success: Policy steps since the first tolerance was first met, int64, -1 before, shape ``[N]``.
        flags: Tolerances met at this moment, bool, shape ``[N, 3]``.
        contact: Whether base, arm, object touched an obstacle in this step, bool, shape ``[N, 3]``.

    Returns:
        New tensors: the tolerances met so far, shape ``[N, 3]``, and the steps since the first one was met, zero in the
        step itself, shape ``[N]``.
    """
    latched = success | (flags & ~contact.any(-1, keepdim=True))
    steps = torch.where(steps_since_success >= 0, steps_since_success + 1, latched[..., 0].to(torch.int64) - 1)
    return latched, steps


def endings(
    task: TaskConfig, *, contact: torch.Tensor, elapsed_steps: torch.Tensor, steps_since_success: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return which episodes end, and how.

    A collision terminates. The time limit truncates, and so does the time that an episode plays on after its first
    success; neither does in a step that terminates.

    Args:
        task: Time limits and policy period.
        contact: Whether base, arm, object touched an obstacle in this step, bool, shape ``[N, 3]``.
        elapsed_steps: Policy steps played, this one included, int64, shape ``[N]``.
        steps_since_success: Policy steps since the first success, int64, -1 before, shape ``[N]``.

    Returns:
        ``(terminated, truncated)``, bool, shape ``[N]`` each; never both true.
    """
    terminated = contact.any(-1)
    is_late = elapsed_steps >= task.max_steps
    is_over = steps_since_success >= round(task.success_time / task.policy_period)
    return terminated, (is_late | is_over) & ~terminated
