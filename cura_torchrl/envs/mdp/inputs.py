"""What a caller gives: actions, and the episodes to play; checked before anything changes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Sequence


def checked_action(action: torch.Tensor, shape: torch.Size, device: torch.device) -> torch.Tensor:
    """Return an action within its bounds.

    Args:
        action: Action of each row [1]; it is not changed.
        shape: What is accepted, ``[N, A]``.
        device: Where the action is wanted.

    Returns:
        The action, clamped to [-1, 1], without gradient, shape ``[N, A]``.

    Raises:
        ValueError: If the action has another shape, or is not a number.

    Examples:
        >>> checked_action(torch.tensor([[0.5, 3.0]]), torch.Size([1, 2]), torch.device("cpu")).tolist()
        [[0.5, 1.0]]
    """
    if action.shape != shape:
        msg = f"action has shape {tuple(action.shape)}; accepted: {tuple(shape)}"
        raise ValueError(msg)
    action = action.detach().to(device).clamp(-1.0, 1.0)
    finite = action.isfinite().all(-1)
    if not bool(finite.all()):
        rows = (~finite).nonzero().flatten().tolist()
        msg = f"action is not a number in rows {rows}; accepted: numbers, of which those beyond -1 or 1 are clamped"
        raise ValueError(msg)
    return action


def checked_episodes(episodes: torch.Tensor | Sequence[int], num_envs: int, device: torch.device) -> torch.Tensor:
    """Return the episodes that rows are asked to play.

    Args:
        episodes: Index of each row's scenario, with or without a trailing dimension.
        num_envs: Number of rows N.
        device: Where they are wanted.

    Returns:
        Indices, int64, shape ``[N]``.

    Raises:
        ValueError: If there is not one for each row, or they are not integers, 0 or more.

    Examples:
        >>> checked_episodes(torch.tensor([[3], [7]]), 2, torch.device("cpu")).tolist()
        [3, 7]
    """
    episodes = torch.as_tensor(episodes)
    is_integer = not (episodes.is_floating_point() or episodes.is_complex() or episodes.dtype == torch.bool)
    if not is_integer or episodes.numel() != num_envs or bool((episodes < 0).any()):
        msg = f"episodes are {episodes.tolist()}; accepted: {num_envs} integers, 0 or more, one for each row"
        raise ValueError(msg)
    return episodes.reshape(-1).to(device, torch.int64)
