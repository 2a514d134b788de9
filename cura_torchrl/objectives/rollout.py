"""What is common to all that reads a rollout: keys that have to be there, and trajectories that end in padding."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tensordict import NestedKey, TensorDictBase

MASK = ("collector", "mask")
"""Steps that are not padding, where TorchRL's collectors with ``split_trajs=True`` write them."""


def require_keys(needed: Iterable[NestedKey], present: Iterable[NestedKey], accepted: str) -> None:
    """Check that no key is missing.

    Args:
        needed: Keys that will be read.
        present: Keys that there are.
        accepted: What to say is accepted instead.

    Raises:
        KeyError: If a key is missing; the first one is named.

    Examples:
        >>> require_keys(["risk", ("next", "cost")], ["risk"], "rollouts that hold it")
        Traceback (most recent call last):
        KeyError: "key ('next', 'cost') is missing; accepted: rollouts that hold it"
    """
    there = set(present)
    for key in needed:
        if key not in there:
            msg = f"key {key!r} is missing; accepted: {accepted}"
            raise KeyError(msg)


def read_mask(tensordict: TensorDictBase, key: NestedKey = MASK) -> torch.Tensor | None:
    """Return which steps of a rollout are not padding.

    Args:
        tensordict: Rollout, shape ``[*B, T]``.
        key: Where the mask is, with or without a trailing dimension.

    Returns:
        Mask, bool, shape ``[*B, T, 1]``; None if there is none.
    """
    mask = tensordict.get(key, None)
    return None if mask is None else mask.reshape(*tensordict.batch_size, 1)


def cut_at_padding(done: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Return where trajectories end in the data: where they are done, and before and within their padding.

    Args:
        done: Whether a trajectory ends with the step, bool, shape ``[*B, T, 1]``.
        mask: Steps that are not padding, bool, same shape; none has no padding.

    Returns:
        Ends, bool, same shape.

    Examples:
        >>> open_ended, mask = torch.zeros(4, 1, dtype=torch.bool), torch.tensor([[True], [True], [False], [False]])
        >>> cut_at_padding(open_ended, mask).flatten().tolist()
        [False, True, True, True]
    """
    return done if mask is None else done | ~torch.cat([mask[..., 1:, :], mask[..., -1:, :]], -2)
