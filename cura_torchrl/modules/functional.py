"""Statistics of a collision distribution given as atoms: pure tensors in, tensors out.

The collision estimator is trained by the energy distance, which treats its N outputs as exchangeable atoms: output i is
not tied to a quantile level. Mean and variance need no order; quantiles and tail measures sort first.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Literal

import torch

if TYPE_CHECKING:
    from collections.abc import Callable


def quantile_midpoints(num_atoms: int, *, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """Return the levels tau_i = (i - 0.5) / N that N sorted atoms stand for.

    Args:
        num_atoms: N, number of atoms [1].
        dtype: Type of the result.

    Returns:
        Levels in ascending order [1], shape ``[N]``.

    Raises:
        ValueError: If there is no atom.

    Source:
        Paper Eq. (4).

    Examples:
        >>> quantile_midpoints(4).tolist()
        [0.125, 0.375, 0.625, 0.875]
    """
    if num_atoms < 1:
        msg = f"num_atoms is {num_atoms}; accepted: 1 or more"
        raise ValueError(msg)
    return (torch.arange(num_atoms, dtype=dtype) + 0.5) / num_atoms


def atom_mean(atoms: torch.Tensor) -> torch.Tensor:
    """Return the risk: the mean of the atoms.

    Args:
        atoms: Atoms in any order [1], shape ``[*B, N]``.

    Returns:
        Mean [1], shape ``[*B]``.

    Source:
        Paper Eq. (5).

    Examples:
        >>> atom_mean(torch.tensor([[0.0, 1.0], [0.5, 1.0]])).tolist()
        [0.5, 0.75]
    """
    return atoms.mean(-1)


def atom_variance(atoms: torch.Tensor) -> torch.Tensor:
    """Return the uncertainty: the population variance of the atoms.

    Args:
        atoms: Atoms in any order [1], shape ``[*B, N]``.

    Returns:
        Variance, divided by N and not by N - 1 [1], shape ``[*B]``.

    Source:
        Paper Eq. (6).

    Examples:
        >>> atom_variance(torch.tensor([[0.0, 1.0], [0.5, 0.5]])).tolist()
        [0.25, 0.0]
    """
    return atoms.var(-1, correction=0)


def atom_quantile(atoms: torch.Tensor, levels: torch.Tensor) -> torch.Tensor:
    """Read quantiles from atoms, which are sorted first.

    A level is answered by the smallest atom at or below which at least that share of the atoms lies. At the midpoints
    of :func:`quantile_midpoints` these are the sorted atoms themselves.

    Args:
        atoms: Atoms in any order [1], shape ``[*B, N]``.
        levels: Levels in [0, 1], shape ``[L]``.

    Returns:
        Quantiles [1], shape ``[*B, L]``.

    Examples:
        >>> atom_quantile(torch.tensor([0.9, 0.1, 0.5, 0.2]), torch.tensor([0.0, 0.5, 0.51, 1.0])).tolist()
        [0.10000000149011612, 0.20000000298023224, 0.5, 0.8999999761581421]
    """
    num_atoms = atoms.shape[-1]
    # A level that is a whole number of atoms up to rounding, such as 0.07 * 100 = 7.000001, is that number.
    position = (levels.double() * num_atoms - 1e-4).ceil().long() - 1
    return atoms.sort(-1).values.index_select(-1, position.clamp(0, num_atoms - 1))


def conditional_value_at_risk(atoms: torch.Tensor, alpha: float) -> torch.Tensor:
    """Return CVaR_alpha: the mean of the worst share ``alpha`` of the distribution, its upper tail.

    High values of the collision possibility are bad, so the tail is the upper one; an atom on its edge counts in part.

    Args:
        atoms: Atoms in any order [1], shape ``[*B, N]``.
        alpha: Share of the distribution in the tail [1]. Range: above 0 to 1; 1 is the mean.

    Returns:
        CVaR [1], shape ``[*B]``.

    Raises:
        ValueError: If ``alpha`` is out of range.

    Source:
        Rockafellar and Uryasev (2000), for the empirical distribution.

    Examples:
        The worst 3/8 of four atoms are the largest one and half of the next: (1.0 + 0.5 * 0.4) / 1.5.

        >>> conditional_value_at_risk(torch.tensor([0.4, 1.0, 0.0, 0.2]), 0.375).item()
        0.800000011920929
    """  # noqa: DOC502 - raised by what this calls
    _require_share(alpha)
    edges = _cumulative_share(atoms)
    return _distorted_mean(atoms, (edges - (1.0 - alpha)).clamp_min(0.0) / alpha)


def wang_risk(atoms: torch.Tensor, beta: float) -> torch.Tensor:
    """Return Wang's risk measure: the mean after shifting probability to the upper tail.

    Args:
        atoms: Atoms in any order [1], shape ``[*B, N]``.
        beta: Aversion to risk [1]: 0 is the mean, positive weighs high atoms more. A normal distribution of mean m and
            deviation s gives m + beta s.

    Returns:
        Distorted mean [1], shape ``[*B]``.

    Source:
        Wang (2000), "A class of distortion operators for pricing financial and insurance risks"; with distributional
        critics: Schneider et al. (2024) <https://arxiv.org/abs/2309.14246>.

    Examples:
        >>> atoms = torch.tensor([0.0, 1.0])
        >>> wang_risk(atoms, 0.0).item(), round(wang_risk(atoms, 1.0).item(), 4)  # 1 - Phi(-1) = 0.8413
        (0.5, 0.8413)
    """
    edges = _cumulative_share(atoms)
    return _distorted_mean(atoms, torch.special.ndtr(torch.special.ndtri(edges) - beta))


def make_risk_measure(
    kind: Literal["mean", "cvar", "wang"], level: float = 0.25
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a risk measure by its name.

    Measures of the tail see the atoms clamped to [0, 1], the range of the collision possibility: what a linear head
    overshoots averages out in a mean, but not in a tail.

    Args:
        kind: The mean, as in the paper, :func:`conditional_value_at_risk` or :func:`wang_risk`.
        level: alpha of CVaR, above 0 to 1; beta of Wang's measure, 0 or more [1]; the mean has none.

    Returns:
        Function from atoms, shape ``[*B, N]``, to the risk, shape ``[*B]``; it can be pickled.

    Raises:
        ValueError: If there is no such measure, or the level is out of its range.

    Examples:
        >>> make_risk_measure("cvar", 0.5)(torch.tensor([0.0, 0.5, 0.25, 1.5])).item()  # (0.5 + 1.0) / 2
        0.75
    """
    if kind == "mean":
        return atom_mean
    if kind == "cvar":
        _require_share(level)
        return functools.partial(_clamped_cvar, alpha=level)
    if kind == "wang":
        if not 0.0 <= level < math.inf:
            msg = f"beta is {level}; accepted: 0 or more"
            raise ValueError(msg)
        return functools.partial(_clamped_wang, beta=level)
    msg = f"risk measure is {kind!r}; accepted: mean, cvar, wang"
    raise ValueError(msg)


def _require_share(alpha: float) -> None:
    if not 0.0 < alpha <= 1.0:
        msg = f"alpha is {alpha}; accepted: above 0 to 1"
        raise ValueError(msg)


def _clamped_cvar(atoms: torch.Tensor, alpha: float) -> torch.Tensor:
    return conditional_value_at_risk(atoms.clamp(0.0, 1.0), alpha)


def _clamped_wang(atoms: torch.Tensor, beta: float) -> torch.Tensor:
    return wang_risk(atoms.clamp(0.0, 1.0), beta)


def _cumulative_share(atoms: torch.Tensor) -> torch.Tensor:
    # 0, 1/N, ..., 1, shape [N + 1]; double precision keeps the tails of Phi^-1 exact.
    num_atoms = atoms.shape[-1]
    return torch.arange(num_atoms + 1, dtype=torch.float64, device=atoms.device) / num_atoms


def _distorted_mean(atoms: torch.Tensor, distorted: torch.Tensor) -> torch.Tensor:
    # Sorted atoms, weighted by the increments of a distorted cumulative share, shape [N + 1].
    return (atoms.sort(-1).values * distorted.diff().to(atoms.dtype)).sum(-1)
