"""Which rows of a batch a transform has to start anew."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torchrl.envs.transforms.utils import _get_reset

from cura_torchrl.validation import require

if TYPE_CHECKING:
    import torch
    from tensordict import TensorDictBase
    from torchrl.envs.transforms import Transform


def reset_mask(transform: Transform, tensordict: TensorDictBase) -> torch.Tensor:
    """Return which rows are reset.

    Args:
        transform: Whose environment has the reset key; without an environment it is ``_reset``.
        tensordict: What the transform's ``_reset`` was given; without the key all rows are reset.

    Returns:
        Mask, bool, of a shape that expands to the batch's. Environments with more than one reset key are refused with a
        ValueError.
    """
    reset_keys = ["_reset"] if transform.parent is None else transform.parent.reset_keys
    require(len(reset_keys) == 1, "reset keys", reset_keys, "environments with one done flag per row")
    mask: torch.Tensor = _get_reset(reset_keys[0], tensordict)
    return mask
