"""The planar LiDAR: ray pattern, noise, what a miss reads, and the guard against rays that start inside a body.

A simulator's ray ignores a convex body that it starts in, and would report free space. That is an error here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from cura_torchrl.envs import geometry

if TYPE_CHECKING:
    from collections.abc import Callable

    from cura_torchrl.envs.config import LidarConfig


def ray_angles(num_rays: int) -> torch.Tensor:
    """Return the rays' directions in the base frame, from behind, counter-clockwise [rad], shape ``[R]``.

    Examples:
        >>> ray_angles(4).div(math.pi).tolist()
        [-1.0, -0.5, 0.0, 0.5]
    """
    return torch.arange(num_rays, dtype=torch.float64) * (2 * math.pi / num_rays) - math.pi


def ray_ends(pose: torch.Tensor, config: LidarConfig) -> torch.Tensor:
    """Return where the rays end if they meet nothing.

    Args:
        pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[B, 3]``.
        config: Ray count, range and height.

    Returns:
        End points in the world frame [m], shape ``[B, R, 3]``.
    """
    angle = (ray_angles(config.num_rays) + pose[:, 2:3]).contiguous()
    x = pose[:, 0:1] + config.max_range * angle.cos()
    y = pose[:, 1:2] + config.max_range * angle.sin()
    return torch.stack([x, y, torch.full_like(x, config.height)], dim=-1)


def starts_inside(pose: torch.Tensor, body_pose: torch.Tensor, body_edge: torch.Tensor) -> torch.Tensor:
    """Return whether the sensor lies in a square's footprint.

    Args:
        pose: Sensor pose, shape ``[B, 3]``.
        body_pose: Squares' (x [m], y [m], yaw [rad]), shape ``[B, M, 3]``.
        body_edge: Their edges [m], 0 where there is none, shape ``[B, M]``.

    Returns:
        Whether the sensor lies strictly inside any of them, bool, shape ``[B]``.
    """
    local = geometry.to_frame(body_pose, pose[:, None, :2].expand(-1, body_pose.shape[1], -1))
    return (local.abs().amax(-1) < body_edge / 2).any(-1)


class Lidar:
    """Turns free shares of rays into ranges, with noise that belongs to the episode and not to the batch.

    Args:
        num_worlds: Number of sensors N.
        config: Pattern, range, noise, occlusion.
        cast: Casts rays from ``[B, 3]`` to ``[B, R, 3]`` in the named worlds and returns free shares ``[B, R]``.
    """

    def __init__(self, num_worlds: int, config: LidarConfig, cast: Callable[..., np.ndarray]) -> None:
        self.config = config
        self._cast = cast
        self._noise = [np.random.default_rng(0) for _ in range(num_worlds)]

    def reset(self, rows: list[int], keys: list[tuple[int, ...]]) -> None:
        """Start each world's noise anew from a key of non-negative integers."""
        for row, key in zip(rows, keys, strict=True):
            self._noise[row] = np.random.Generator(np.random.Philox(np.random.SeedSequence(key)))

    def scan(
        self, rows: list[int], pose: torch.Tensor, body_pose: torch.Tensor, body_edge: torch.Tensor
    ) -> torch.Tensor:
        """Measure.

        Args:
            rows: Worlds to measure in, B of them.
            pose: Sensor (x [m], y [m], yaw [rad]), shape ``[B, 3]``.
            body_pose: Bodies that rays must see, (x [m], y [m], yaw [rad]), shape ``[B, M, 3]``.
            body_edge: Their edges [m], 0 where there is none, shape ``[B, M]``.

        Returns:
            Ranges [m], the maximum range for a miss, float32, shape ``[B, R]``.

        Raises:
            RuntimeError: If a sensor lies inside a body that it should see.
        """
        inside = starts_inside(pose, body_pose, body_edge)
        if bool(inside.any()):
            worlds = [rows[i] for i in inside.nonzero().flatten().tolist()]
            msg = f"the LiDAR of worlds {worlds} starts inside a body, where rays would read free space"
            raise RuntimeError(msg)
        origin = torch.cat([pose[:, :2], torch.full_like(pose[:, :1], self.config.height)], dim=-1).numpy()
        free = self._cast(origin, ray_ends(pose, self.config).numpy(), see_object=self.config.occlusion, rows=rows)
        ranges = free * self.config.max_range
        if self.config.noise > 0:
            draws = np.stack([self._noise[row].standard_normal(self.config.num_rays) for row in rows])
            noisy = np.clip(ranges + self.config.noise * draws, 0.0, self.config.max_range)
            ranges = np.where(free < 1.0, noisy, ranges)
        return torch.from_numpy(ranges.astype(np.float32))
