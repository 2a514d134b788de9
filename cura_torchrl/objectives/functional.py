"""Mathematics of CURA-PPO: SR(lambda) targets, costs, normalisation. Tensors in, tensors out."""

from __future__ import annotations

import torch

_RIDGE = 1e-6
"""Ridge of a regression beside features of deviation 1 [1]."""

_MIN_SPREAD = 1e-9
"""Stands for the deviation of a feature that never changes."""


def sr_lambda_targets(
    cost: torch.Tensor,
    next_atoms: torch.Tensor,
    terminated: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float,
    lmbda: float,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Return target atoms of the distributional Bellman operator by sample replacement, SR(lambda).

    Backward in time, G_t = c_t + gamma * mix_t, where each atom of mix_t is that of G_(t+1) with probability lambda and
    else that of the estimator at o_(t+1), clamped to [0, 1]. So every target atom is an n-step return with n drawn from
    a geometric distribution; lambda 0 is one step and lambda 1 is Monte-Carlo.

    - *Terminated*: G_t = c_t. The trace is cut after the terminal step, not before it, so the realised outcome
      reaches all earlier steps of the episode.
    - *Truncated*, or last step of the rollout: mix_t is the estimator at o_(t+1) alone.

    Atoms are paired by index and not shuffled. Any pairing is unbiased, since whether an atom is kept does not depend
    on its value; but output i describes much the same part of the distribution at both steps, so replacing like by like
    adds less noise than replacing at random: none at all where the two sets agree.

    Args:
        cost: Collision indicator c_t [1], shape ``[*B, T, 1]``.
        next_atoms: Estimator's atoms at o_(t+1), the true last observation where an episode ended, shape
            ``[*B, T, N]``.
        terminated: Whether the episode ended for good at step t, bool, shape ``[*B, T, 1]``.
        truncated: Whether it was cut there, bool, shape ``[*B, T, 1]``; ignored where ``terminated``.
        gamma: Discount gamma_c per step [1].
        lmbda: Probability of keeping the sampled return's atom [1].
        generator: Source of the choices, on any device; none takes the global one.

    Returns:
        Target atoms [1], shape ``[*B, T, N]``, without gradient. In [0, 1] if every collision terminates.

    Raises:
        ValueError: If the shapes do not fit together.

    Source:
        Paper, section "Training the Distributional Collision Estimator"; Schneider et al. (2024), "Learning Risk-Aware
        Quadrupedal Locomotion using Distributional Reinforcement Learning" <https://arxiv.org/abs/2309.14246>.

    Examples:
        Collision at the last of three steps: 0.9^2, 0.9, 1.

        >>> end = torch.tensor([[False], [False], [True]])
        >>> zeros = torch.zeros(3, 1)
        >>> sr_lambda_targets(end.float(), zeros, end, ~end & False, gamma=0.9, lmbda=1.0).squeeze(-1)
        tensor([0.8100, 0.9000, 1.0000])
    """
    if not _is_rollout(next_atoms, cost, terminated, truncated):
        shapes = ", ".join(str(tuple(x.shape)) for x in (cost, next_atoms, terminated, truncated))
        msg = (
            f"cost, next_atoms, terminated, truncated have shapes {shapes}; "
            "accepted: [*B, T, 1], [*B, T, N], and twice [*B, T, 1], with T at least 1"
        )
        raise ValueError(msg)
    with torch.no_grad():
        bootstrap = next_atoms.clamp(0.0, 1.0)
        device = next_atoms.device if generator is None else generator.device
        draws = torch.rand(next_atoms.shape, generator=generator, device=device).to(next_atoms.device)
        keeps = (draws < lmbda) & ~(terminated | truncated)
        cost = cost.to(next_atoms.dtype)
        returns = bootstrap[..., -1, :]  # What follows the rollout's last step.
        targets = []
        for t in reversed(range(next_atoms.shape[-2])):
            mix = torch.where(keeps[..., t, :], returns, bootstrap[..., t, :])
            step_cost = cost[..., t, :].expand_as(mix)
            returns = torch.where(terminated[..., t, :], step_cost, step_cost + gamma * mix)
            targets.append(returns)
        return torch.stack(targets[::-1], -2)


def _is_rollout(next_atoms: torch.Tensor, *signals: torch.Tensor) -> bool:
    has_steps = next_atoms.ndim >= 2 and next_atoms.shape[-2] > 0
    return has_steps and all(signal.shape == (*next_atoms.shape[:-1], 1) for signal in signals)


def risk_cost(
    cost: torch.Tensor, risk: torch.Tensor, next_risk: torch.Tensor, terminated: torch.Tensor, *, gamma: float
) -> torch.Tensor:
    """Return the temporal difference of the risk: c_t + gamma_c R(o_(t+1)) - R(o_t).

    After a terminal step nothing can collide any more, so there R(o_(t+1)) counts as zero.

    Args:
        cost: Collision indicator c_t [1], shape ``[*B]``.
        risk: R(o_t) [1], shape ``[*B]``.
        next_risk: R(o_(t+1)) [1], shape ``[*B]``.
        terminated: Whether the episode ended for good at step t, bool, shape ``[*B]``.
        gamma: Discount gamma_c per step [1].

    Returns:
        Risk cost C^R [1], shape ``[*B]``; negative where the action lowered the expected collision possibility.

    Source:
        Paper Eq. (8).

    Examples:
        >>> args = torch.tensor([[0.0], [1.0]]), torch.tensor([[0.5], [0.5]]), torch.tensor([[0.5], [0.5]])
        >>> risk_cost(*args, torch.tensor([[False], [True]]), gamma=0.9).tolist()  # 0.45 - 0.5, 1 - 0.5
        [[-0.050000011920928955], [0.5]]
    """
    return cost.to(risk.dtype) + gamma * next_risk.masked_fill(terminated, 0.0) - risk


def uncertainty_cost(uncertainty: torch.Tensor, next_uncertainty: torch.Tensor) -> torch.Tensor:
    """Return the change of the uncertainty: U(o_(t+1)) - U(o_t).

    It has no meaning on terminal steps: an absorbing state with U = 0 would pay a bonus for crashing while uncertain.
    Leave them out by the mask of :func:`normalise`, which sets them to zero *after* normalisation.

    Args:
        uncertainty: U(o_t) [1], shape ``[*B]``.
        next_uncertainty: U(o_(t+1)) [1], shape ``[*B]``.

    Returns:
        Uncertainty cost C^U [1], shape ``[*B]``; negative where the next observation is less uncertain.

    Source:
        Paper Eq. (9).

    Examples:
        >>> uncertainty_cost(torch.tensor([0.5]), torch.tensor([0.25])).item()
        -0.25
    """
    return next_uncertainty - uncertainty


def accumulate(values: torch.Tensor, done: torch.Tensor, factor: float) -> torch.Tensor:
    """Return the discounted sum of what follows along each trajectory.

    With the risk cost, which is the temporal difference error of the risk, and ``factor = gamma_c * lambda`` this is
    the generalised advantage estimate of the collision.

    Args:
        values: Values, time as the last dimension but one, shape ``[*B, T, F]``.
        done: Whether a trajectory ends with the step, bool, same shape.
        factor: Weight of the next step beside this one [1].

    Returns:
        Sums, shape ``[*B, T, F]``.

    Source:
        Schulman et al. (2016), "High-dimensional continuous control using generalized advantage estimation", Eq. (16).

    Examples:
        >>> done = torch.tensor([[False], [True], [False]])
        >>> accumulate(torch.ones(3, 1), done, 0.5).flatten().tolist()
        [1.5, 1.0, 1.0]
    """
    if factor == 0.0:
        return values
    sums = values.clone()
    for step in range(values.shape[-2] - 2, -1, -1):
        following = sums[..., step + 1, :].masked_fill(done[..., step, :], 0.0)
        sums[..., step, :] += factor * following
    return sums


def explain(values: torch.Tensor, features: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
    """Return what a linear regression on features makes of values: a baseline that knows the state and no action.

    With fewer samples than twice the features a regression fits the noise: then it is the mean.

    Args:
        values: What to explain, shape ``[*B, 1]``.
        features: Numbers that describe the state, shape ``[*B, F]``.
        mask: Which samples count, bool, shape ``[*B, 1]``; all if None.

    Returns:
        The regression's prediction, 0 where masked, shape ``[*B, 1]``.

    Source:
        Greensmith, Bartlett and Baxter (2004), "Variance reduction techniques for gradient estimates": baselines.

    Examples:
        >>> state = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
        >>> explain(3.0 * state + 1.0, state).flatten().round(decimals=3).tolist()
        [1.0, 4.0, 7.0, 10.0]
    """
    inside = torch.ones_like(values, dtype=torch.bool) if mask is None else mask
    weight = inside.reshape(-1, 1).double()
    rows, target = features.reshape(-1, features.shape[-1]).double() * weight, values.reshape(-1, 1).double() * weight
    count = weight.sum().clamp_min(1.0)
    rows = (rows - rows.sum(0) / count) * weight
    scale = (rows.square().sum(0) / count).sqrt().clamp_min(_MIN_SPREAD)
    rows = torch.cat([rows / scale, weight], -1)
    # The ridge keeps features that follow from others, or never change, from blowing up.
    ridge = _RIDGE * count * torch.eye(rows.shape[-1], dtype=rows.dtype, device=rows.device)
    weights = torch.linalg.solve(rows.T @ rows + ridge, rows.T @ target)
    is_enough = count >= 2 * rows.shape[-1]
    explained = torch.where(is_enough, rows @ weights, weight * target.sum() / count)
    return explained.reshape(values.shape).to(values.dtype)


def normalise(values: torch.Tensor, *, floor: float, clip: float, mask: torch.Tensor | None = None) -> torch.Tensor:
    """Return (x - mean) / max(std, floor), clipped; steps outside the mask count for nothing and become zero.

    Collisions are rare, so the costs are heavy-tailed with a tiny deviation at first: the floor keeps noise small, the
    clip bounds single steps.

    Args:
        values: Values x of a whole rollout, any shape.
        floor: Smallest deviation to divide by, in the units of x.
        clip: Bound on the magnitude of the result [1].
        mask: Steps to take into account, bool, shape of ``values``; none takes all.

    Returns:
        Normalised values [1], shape of ``values``; zero outside the mask and, if it is empty, everywhere.

    Source:
        The bar in paper Eq. (10); floor and clip are ours.

    Examples:
        Mean 2 and population deviation 1 of the two steps that count:

        >>> normalise(torch.tensor([1.0, 3.0, 99.0]), floor=0.005, clip=5.0, mask=torch.tensor([True, True, False]))
        tensor([-1.,  1.,  0.])
    """
    mean, std = masked_moments(values, mask)
    normalised = ((values - mean) / std.clamp_min(floor)).clamp(-clip, clip)
    return normalised if mask is None else normalised.masked_fill(~mask, 0.0)


def masked_moments(values: torch.Tensor, mask: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    """Return mean and population standard deviation of the values inside a mask.

    Args:
        values: Values, any shape; what is outside the mask may be anything, NaN included.
        mask: Values to take into account, bool, shape of ``values``; none takes all.

    Returns:
        Mean and deviation, in the units of the values, shape ``[]``; zero if nothing is inside the mask.

    Examples:
        >>> mean, std = masked_moments(torch.tensor([1.0, 3.0, float("nan")]), torch.tensor([True, True, False]))
        >>> mean.item(), std.item()
        (2.0, 1.0)
    """
    mask = torch.ones_like(values, dtype=torch.bool) if mask is None else mask
    count = mask.sum().clamp_min(1)
    mean = values.masked_fill(~mask, 0.0).sum() / count
    return mean, ((values - mean).masked_fill(~mask, 0.0).square().sum() / count).sqrt()


def standardise(advantage: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
    """Return the z-score that TorchRL's ``GAE(average_gae=True)`` computes, without a mask to the last bit.

    Args:
        advantage: Advantages of a whole rollout, any shape, at least two of them.
        mask: Steps to take into account, bool, shape of ``advantage``; none takes all. Others become zero.

    Returns:
        Standardised advantages [1], shape of ``advantage``.

    Examples:
        >>> standardise(torch.tensor([1.0, 2.0, 3.0]))
        tensor([-1.,  0.,  1.])
    """
    if mask is None:
        return (advantage - advantage.mean()) / advantage.std().clamp_min(_GAE_MIN_STD)
    mean, std = masked_moments(advantage, mask)
    count = mask.sum().to(std.dtype)
    std = std * (count / (count - 1.0).clamp_min(1.0)).sqrt()
    return ((advantage - mean) / std.clamp_min(_GAE_MIN_STD)).masked_fill(~mask, 0.0)


_GAE_MIN_STD = 1e-4
"""Smallest deviation [1] that TorchRL's GAE divides by."""
