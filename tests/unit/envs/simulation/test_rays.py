"""Rays against squares, against rays cast one by one in NumPy."""

from __future__ import annotations

import numpy as np
import torch

from cura_torchrl.envs.config import LidarConfig
from cura_torchrl.envs.sensors.lidar import ray_ends
from cura_torchrl.envs.simulation.rays import free_share
from tests.scenes import cast_rays

RANGE = 10.0


def scan(pose: torch.Tensor, bodies: torch.Tensor) -> torch.Tensor:
    """Return the ranges of 360 rays from poses ``[B, 3]`` past bodies (x, y, yaw, edge) ``[B, M, 4]``."""
    ends = ray_ends(pose, LidarConfig())[..., :2]
    return RANGE * free_share(pose[:, :2], ends, bodies[..., :3], bodies[..., 3] / 2)


def test_any_scene_is_seen_as_geometry_says():
    """Catches a wrong frame, a slab that is left out and a chunk that falls away."""
    generator = np.random.default_rng(0)
    count = 60
    bodies = np.concatenate(
        [generator.uniform(-6, 6, (count, 7, 2)), generator.uniform(-3, 3, (count, 7, 1)),
         generator.choice([0.4, 0.6, 1.0], (count, 7, 1))], -1,
    )  # fmt: skip
    pose = np.concatenate([generator.uniform(-1, 1, (count, 2)), generator.uniform(-3, 3, (count, 1))], -1)
    ranges = scan(torch.from_numpy(pose), torch.from_numpy(bodies)).numpy()
    expected = np.stack([cast_rays(body[:, [0, 1, 2, 3, 3]], at) for body, at in zip(bodies, pose, strict=True)])
    outside = [np.hypot(*(body[:, :2] - at[:2]).T).min() > 0.75 for body, at in zip(bodies, pose, strict=True)]
    agree = np.abs(ranges - expected)[outside] < 1e-3
    assert sum(outside) > 40
    assert agree.mean() > 0.999  # a ray that grazes a corner may fall either way
    assert (expected < RANGE).mean() > 0.2


def test_a_square_without_size_is_not_there():
    """Catches the ghost of an obstacle that has not appeared yet."""
    pose = torch.zeros(1, 3, dtype=torch.float64)
    assert (
        scan(pose, torch.tensor([[[3.0, 0.0, 0.3, 0.0], [0.0, 0.0, 0.0, 0.0]]], dtype=torch.float64)) == RANGE
    ).all()


def test_a_square_around_the_sensor_and_one_behind_are_not_seen():
    """Catches hits behind the sensor, and a start inside that reads as a hit at zero."""
    origin, ends = torch.zeros(1, 2), torch.tensor([[[10.0, 0.0]]])
    around, behind = torch.tensor([[[0.2, 0.0, 0.1]]]), torch.tensor([[[-3.0, 0.0, 0.1]]])
    for square in (around, behind):
        assert free_share(origin, ends, square, torch.tensor([[0.5]])).item() == 1.0


def test_a_ray_along_a_face_is_finite():
    """Catches a division by a direction's zero component."""
    origin, ends = torch.tensor([[0.0, 0.0]]), torch.tensor([[[10.0, 0.0], [0.0, 10.0]]])
    square = torch.tensor([[[4.0, 0.5, 0.0]]])
    share = free_share(origin, ends, square, torch.tensor([[0.5 + 1e-3]]))
    assert share.isfinite().all()
    assert abs(share[0, 0].item() - 0.35) < 1e-3
    assert share[0, 1].item() == 1.0
