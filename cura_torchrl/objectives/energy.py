"""The energy distance between two sets of atoms, exactly and without a tensor of all pairs.

In tensor operations on any device; on the CPU in one compiled pass.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from cura_torchrl.compiled import compiled, run_rows

if TYPE_CHECKING:
    from cura_torchrl.compiled import Floats, Ints


def energy_distance(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the energy distance between two sets of atoms, exactly and without a tensor of all pairs.

    With F and G the empirical distribution functions, 2 E|x - y| - E|x - x'| - E|y - y'| = 2 * integral (F - G)^2.
    Between neighbouring merged atoms F - G is constant, so the integral is a sum over atoms with weights that depend on
    their order alone. Gradients flow through that linear sum and are exact wherever no two atoms are equal.

    Without the absolute values, which the paper's Eq. (7) leaves out, the distance would be unbounded below.

    Args:
        prediction: Atoms x in any order, shape ``[*B, N]``.
        target: Atoms y in any order, shape ``[*B, M]``.

    Returns:
        Energy distance, in the units of the atoms, shape ``[*B]``; never negative but for rounding.

    Raises:
        ValueError: If the leading shapes differ or a set is empty.

    Source:
        Paper Eq. (7); Székely and Rizzo (2013), "Energy statistics".

    Examples:
        ``2 * (|0 - 1| + |2 - 1|) / 2 - (0 + 2 + 2 + 0) / 4 - 0 = 2 - 1 = 1``:

        >>> energy_distance(torch.tensor([0.0, 2.0]), torch.tensor([1.0])).item()
        1.0
    """
    num_x, num_y = prediction.shape[-1], target.shape[-1]
    if prediction.shape[:-1] != target.shape[:-1] or num_x == 0 or num_y == 0:
        msg = (
            f"prediction has shape {tuple(prediction.shape)} and target {tuple(target.shape)}; "
            "accepted: the same leading shape and at least one atom each"
        )
        raise ValueError(msg)
    if prediction.dtype.itemsize < 4 or target.dtype.itemsize < 4:
        # Half precision has neither the range nor the digits of the sums.
        return energy_distance(prediction.float(), target.float()).to(prediction.dtype)
    is_traced = torch.compiler.is_compiling() or torch._C._functorch.maybe_current_level() is not None
    if prediction.device.type == "cpu" and not is_traced:
        distance: torch.Tensor = _EnergyDistance.apply(prediction, target)  # type: ignore[no-untyped-call]
        return distance
    merged = torch.cat([prediction, target], -1)
    # The weights sum to zero: moving the origin changes no value but avoids cancellation far from zero.
    merged = merged - merged[..., :1].detach()
    return (merged * _sorted_weights(merged, num_x, num_y)).sum(-1)


@torch.no_grad()
def _sorted_weights(merged: torch.Tensor, num_x: int, num_y: int) -> torch.Tensor:
    # 2 sum_k D_k^2 (z_(k+1) - z_k) = sum_k z_k * 2 (D_(k-1)^2 - D_k^2), where D_k is F - G just above sorted atom z_k.
    # With the step s_k = D_k - D_(k-1), the weight is 2 s_k (s_k - 2 D_k).
    order = merged.argsort(-1)
    # Steps of N M (F - G): whole numbers, so that the sums are exact.
    steps = torch.cat([merged.new_full((num_x,), num_y), merged.new_full((num_y,), -num_x)])
    sorted_steps = steps.expand_as(merged).gather(-1, order)
    sorted_weights = (sorted_steps - 2.0 * sorted_steps.cumsum(-1)) * sorted_steps * (2.0 / (num_x * num_y) ** 2)
    return torch.empty_like(merged).scatter(-1, order, sorted_weights)


class _EnergyDistance(torch.autograd.Function):
    """The same in one compiled pass, on the CPU."""

    @staticmethod
    def forward(ctx: Any, prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        atoms = [part.detach().reshape(-1, part.shape[-1]).contiguous() for part in (prediction, target)]
        distance = atoms[0].new_empty(len(atoms[0]))
        weights = [torch.empty_like(part) for part in atoms]
        run_rows(_weigh_atoms, (distance, *weights, *atoms))
        ctx.save_for_backward(*(part.view(prediction.shape[:-1] + part.shape[1:]) for part in weights))
        return distance.view(prediction.shape[:-1])

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        pairs = zip(ctx.needs_input_grad, ctx.saved_tensors, strict=True)
        return tuple(gradient[..., None] * weights if is_needed else None for is_needed, weights in pairs)


@compiled
def _weigh_atoms(distance: Floats, x_weights: Floats, y_weights: Floats, x: Floats, y: Floats) -> None:
    # Up to a few hundred atoms, counting on all vector lanes is quicker than sorting. The derivative of E|x - y| by an
    # atom of x is the share of y below it less the share above. One comparison a pair: among equals x comes first.
    num_x, num_y = x.shape[1], y.shape[1]
    x_places, y_places = np.empty(num_x, np.int32), np.empty(num_y, np.int32)
    for n in range(x.shape[0]):
        _place(x_places, x[n])
        _place(y_places, y[n])
        for i in range(num_x):
            share = (2 * _count_smaller(x[n, i], y[n]) - num_y) / num_y - x_places[i] / num_x
            x_weights[n, i] = share * (2.0 / num_x)
        for j in range(num_y):
            share = (2 * _count_not_larger(y[n, j], x[n]) - num_x) / num_x - y_places[j] / num_y
            y_weights[n, j] = share * (2.0 / num_y)
        # The weights sum to zero: a nearer origin changes no value but avoids cancellation far from zero.
        total, origin = 0.0, x[n, 0]
        for i in range(num_x):
            total += x_weights[n, i] * (x[n, i] - origin)
        for j in range(num_y):
            total += y_weights[n, j] * (y[n, j] - origin)
        distance[n] = total


@compiled
def _place(places: Ints, atoms: Floats) -> None:
    """Write how many of the atoms are smaller than each, less how many are larger."""
    size, total = atoms.shape[0], np.int64(0)
    for i in range(size):
        places[i] = _count_smaller(atoms[i], atoms)
        total += places[i]
    if 2 * total == size * (size - 1):  # no two are equal
        for i in range(size):
            places[i] += places[i] + 1 - size
    else:
        for i in range(size):
            places[i] += _count_not_larger(atoms[i], atoms) - size


@compiled
def _count_smaller(value: np.float32, atoms: Floats) -> np.int32:
    count, one, none = np.int32(0), np.int32(1), np.int32(0)
    for j in range(atoms.shape[0]):
        count += one if atoms[j] < value else none
    return count


@compiled
def _count_not_larger(value: np.float32, atoms: Floats) -> np.int32:
    count, one, none = np.int32(0), np.int32(1), np.int32(0)
    for j in range(atoms.shape[0]):
        count += one if atoms[j] <= value else none
    return count
