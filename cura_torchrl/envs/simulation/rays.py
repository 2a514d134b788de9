"""Rays against squares on the floor: batched, without data-dependent shapes."""

from __future__ import annotations

import numpy as np
import torch

from cura_torchrl.compiled import Floats, compiled, fused, run_rows

_CHUNK = 2**25
"""Ray-square pairs handled together where the loops are not compiled: bounds the work space."""

_PARALLEL = 1e-9
"""Stands for a direction's component that is zero: the ray then crosses a slab nowhere near its end."""


def free_share(origin: torch.Tensor, ends: torch.Tensor, pose: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """Return how much of each ray is free of squares, by the slab method in each square's frame.

    A square that the ray starts in is not seen, as in Bullet. float32 inside: to 1e-6 of the ray.

    Args:
        origin: Where the rays start (x, y) [m], shape ``[B, 2]``.
        ends: Where they end [m], shape ``[B, R, 2]``.
        pose: Squares' (x [m], y [m], yaw [rad]), shape ``[B, M, 3]``.
        half: Their half edges [m], 0 where there is none, shape ``[B, M]``.

    Returns:
        Share of the ray up to the nearest square [1], 1 for a miss, in the rays' dtype, shape ``[B, R]``.

    Source:
        Kay and Kajiya (1986), "Ray tracing complex scenes": slabs.

    Examples:
        >>> square = torch.tensor([[[3.0, 0.0, 0.0]]])
        >>> free_share(torch.zeros(1, 2), torch.tensor([[[10.0, 0.0]]]), square, torch.tensor([[0.5]])).item()
        0.25
    """
    cos, sin = pose[..., 2].cos(), pose[..., 2].sin()
    shift = origin[:, None] - pose[..., :2]
    start_x, start_y = cos * shift[..., 0] + sin * shift[..., 1], cos * shift[..., 1] - sin * shift[..., 0]
    # The spans in which the ray is within a slab, as shares of the ray: (-+half - start) / direction.
    parts = torch.stack([cos, sin, start_x, start_y, half]).float()
    direction = (ends - origin[:, None]).float()
    if direction.device.type == "cpu":
        share = torch.ones_like(direction[..., 0])
        run_rows(_cast, (share, parts.movedim(0, 2).contiguous(), direction.movedim(2, 1).contiguous()))
        return share.to(ends.dtype)
    rows = max(1, _CHUNK // max(1, direction.shape[1] * half.shape[1]))
    shares = [
        _nearest(part, *piece.unbind(-1))
        for part, piece in zip(parts.split(rows, 1), direction.split(rows), strict=True)
    ]
    return torch.cat(shares).to(ends.dtype)


@compiled
def _cast(share: Floats, squares: Floats, direction: Floats) -> None:
    for n in range(share.shape[0]):
        for m in range(squares.shape[1]):
            cos, sin, x, y, half = squares[n, m]
            if half > np.float32(0.0):
                _cut(share[n], direction[n, 0], direction[n, 1], cos, sin, x, y, half)


@compiled
def _cut(
    share: Floats,
    ray_x: Floats,
    ray_y: Floats,
    cos: np.float32,
    sin: np.float32,
    x: np.float32,
    y: np.float32,
    half: np.float32,
) -> None:
    one, tiny = np.float32(1.0), np.float32(_PARALLEL)
    for r in range(share.shape[0]):
        ahead, left = cos * ray_x[r] + sin * ray_y[r], cos * ray_y[r] - sin * ray_x[r]
        ahead, left = one / (tiny if abs(ahead) < tiny else ahead), one / (tiny if abs(left) < tiny else left)
        near = max(-x * ahead - half * abs(ahead), -y * left - half * abs(left))
        far = min(-x * ahead + half * abs(ahead), -y * left + half * abs(left))
        is_hit = (near < far) & (near >= np.float32(0.0))
        share[r] = min(share[r], near) if is_hit else share[r]


@fused
def _nearest(parts: torch.Tensor, ray_x: torch.Tensor, ray_y: torch.Tensor) -> torch.Tensor:
    cos, sin, start_x, start_y, half = parts[..., None]
    ray_x, ray_y = ray_x[:, None], ray_y[:, None]
    near, far = _span(torch.addcmul(sin * ray_y, cos, ray_x), start_x, half)
    near_y, far_y = _span(torch.addcmul(cos * ray_y, sin, ray_x, value=-1.0), start_y, half)
    near, far = torch.maximum(near, near_y), torch.minimum(far, far_y)
    is_hit = (near < far) & (near >= 0.0)
    return torch.where(is_hit, near, 1.0).amin(1).clamp_max(1.0)


def _span(direction: torch.Tensor, start: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    inverse = torch.where(direction.abs() < _PARALLEL, 1.0 / _PARALLEL, direction.reciprocal())
    middle, reach = -start * inverse, half * inverse.abs()
    return middle - reach, middle + reach
