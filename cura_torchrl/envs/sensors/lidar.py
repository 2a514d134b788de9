"""The planar LiDAR: ray pattern, noise, what a miss reads, and the guard against rays that start inside a body.

A simulator's ray ignores a convex body that it starts in, and would report free space. That is an error here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs import geometry
from cura_torchrl.envs.sensors import noise

if TYPE_CHECKING:
    from collections.abc import Callable

    from cura_torchrl.envs.config import LidarConfig


def ray_angles(num_rays: int, device: torch.device | None = None) -> torch.Tensor:
    """Return the rays' directions in the base frame, from behind, counter-clockwise [rad], shape ``[R]``.

    Examples:
        >>> ray_angles(4).div(math.pi).tolist()
        [-1.0, -0.5, 0.0, 0.5]
    """
    return torch.arange(num_rays, dtype=torch.float64, device=device) * (2 * math.pi / num_rays) - math.pi


def ray_ends(pose: torch.Tensor, config: LidarConfig) -> torch.Tensor:
    """Return where the rays end if they meet nothing.

    Args:
        pose: Sensor (x [m], y [m], yaw [rad]) in the world frame, shape ``[B, 3]``.
        config: Ray count, range and height.

    Returns:
        End points in the world frame [m], shape ``[B, R, 3]``.
    """
    # Turned by the angle addition theorem: a sine and a cosine a sensor in place of one a ray.
    angle, yaw = ray_angles(config.num_rays, pose.device), pose[:, 2:3]
    ahead, left = config.max_range * yaw.cos(), config.max_range * yaw.sin()
    cos, sin = angle.cos(), angle.sin()
    x = pose[:, 0:1] + (ahead * cos - left * sin)
    y = pose[:, 1:2] + (left * cos + ahead * sin)
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
        cast: Casts rays in worlds ``[B]`` from ``[B, 3]`` to ``[B, R, 3]`` and returns free shares ``[B, R]``.
        device: Where the tensors live.
    """

    def __init__(
        self,
        num_worlds: int,
        config: LidarConfig,
        cast: Callable[..., torch.Tensor],
        device: torch.device | None = None,
    ) -> None:
        self.config = config
        self._cast = cast
        self._key = torch.zeros(num_worlds, dtype=torch.int64, device=device)
        self._scans = torch.zeros_like(self._key)

    def reset(self, rows: torch.Tensor, key: torch.Tensor) -> None:
        """Start the noise of worlds anew.

        Args:
            rows: Their indices, shape ``[B]``.
            key: Keys as from :func:`cura_torchrl.envs.sensors.noise.noise_key`, shape ``[B]``.
        """
        self._key[rows] = key
        self._scans[rows] = 0

    def scan(
        self, rows: torch.Tensor, pose: torch.Tensor, body_pose: torch.Tensor, body_edge: torch.Tensor
    ) -> torch.Tensor:
        """Measure.

        Args:
            rows: Worlds to measure in, shape ``[B]``.
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
            msg = f"the LiDAR of worlds {rows[inside].tolist()} starts inside a body, where rays would read free space"
            raise RuntimeError(msg)
        origin = torch.cat([pose[:, :2], torch.full_like(pose[:, :1], self.config.height)], dim=-1)
        free = self._cast(rows, origin, ray_ends(pose, self.config), see_object=self.config.occlusion)
        ranges = free * self.config.max_range
        if self.config.noise > 0:
            draws = noise.normal(self._key[rows], self._scans[rows], self.config.num_rays)
            noisy = (ranges + self.config.noise * draws).clamp(0.0, self.config.max_range)
            ranges = torch.where(free < 1.0, noisy, ranges)
        self._scans[rows] += 1
        return ranges.float()
