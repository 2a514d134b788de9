"""Running normalisation of the observation, updated once per rollout and frozen in between.

Statistics that moved with every forward pass would change the policy between collection and loss, so that PPO's
probability ratios were wrong before the first step.
"""

from __future__ import annotations

import torch
from torch import nn

from cura_torchrl.validation import require_positive


class ObservationNorm(nn.Module):
    """Normalises features to mean 0 and standard deviation 1 by the statistics of all batches given to :meth:`update`.

    One instance is shared, by reference, by actor, critic and collision estimator. The statistics are buffers: they
    are saved and follow the policy into collection workers, and no gradient reaches them. Before the first update the
    module clips and does nothing else.

    Args:
        num_features: Size of the last dimension of the input [1].
        clip: Bound on the magnitude of the output [1].
        min_std: Smallest standard deviation to divide by, in the units of the feature. Features that (almost) never
            move would otherwise turn noise into values of order one.

    Raises:
        ValueError: If an argument is not positive.

    Examples:
        >>> norm = ObservationNorm(1)
        >>> norm.update(torch.tensor([[1.0], [3.0]]))  # mean 2, population standard deviation 1
        >>> norm(torch.tensor([[4.0], [100.0]])).tolist()
        [[2.0], [10.0]]
    """

    count: torch.Tensor
    mean: torch.Tensor
    squared_deviation: torch.Tensor
    loc: torch.Tensor
    scale: torch.Tensor

    def __init__(self, num_features: int, *, clip: float = 10.0, min_std: float = 0.01) -> None:
        super().__init__()
        require_positive(num_features=num_features, clip=clip, min_std=min_std)
        self.clip = clip
        self.min_std = min_std
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(num_features, dtype=torch.float64))
        self.register_buffer("squared_deviation", torch.zeros(num_features, dtype=torch.float64))
        # What forward reads, in single precision, so that an exported graph holds no double.
        self.register_buffer("loc", torch.zeros(num_features))
        self.register_buffer("scale", torch.ones(num_features))

    @torch.no_grad()
    def update(self, batch: torch.Tensor) -> None:
        """Merge a batch into the statistics, in place.

        The merge is exact: any split of the same data into batches gives the same statistics to float error.

        Args:
            batch: Observations, shape ``[*B, D]``; an empty batch changes nothing.

        Raises:
            ValueError: If the batch does not have D features, or holds a value that is not finite; the statistics are
                then left as they were.

        Source:
            Chan, Golub and LeVeque (1983), pairwise update of mean and sum of squared deviations.
        """
        num_features = self.mean.shape[0]
        if batch.shape[-1:] != (num_features,):
            msg = f"batch has shape {tuple(batch.shape)}; accepted: [..., {num_features}]"
            raise ValueError(msg)
        rows = batch.detach().reshape(-1, num_features).to(self.mean)
        if rows.shape[0] == 0:
            return
        if not bool(rows.isfinite().all()):
            msg = f"batch holds {int((~rows.isfinite()).sum())} values that are not finite; accepted: finite numbers"
            raise ValueError(msg)
        rows_mean = rows.mean(0)
        total = self.count + rows.shape[0]
        delta = rows_mean - self.mean
        self.squared_deviation += (rows - rows_mean).square().sum(0) + delta.square() * self.count * rows.shape[
            0
        ] / total
        self.mean += delta * rows.shape[0] / total
        self.count.copy_(total)
        self.loc.copy_(self.mean)
        self.scale.copy_((self.squared_deviation / total).sqrt().clamp_min(self.min_std))

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Normalise and clip by the statistics as they are.

        Args:
            observation: Observations, shape ``[*B, D]``.

        Returns:
            Normalised observations [1], shape ``[*B, D]``.
        """
        return ((observation - self.loc) / self.scale).clamp(-self.clip, self.clip)
