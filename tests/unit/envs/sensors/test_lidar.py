"""The ray pattern, the guard and the noise, with rays answered by hand."""

from __future__ import annotations

import math

import pytest
import torch

from cura_torchrl.envs.config import LidarConfig
from cura_torchrl.envs.sensors.lidar import Lidar, ray_angles, ray_ends, starts_inside
from cura_torchrl.envs.sensors.noise import noise_key

NO_BODIES = (torch.zeros(2, 0, 3, dtype=torch.float64), torch.zeros(2, 0, dtype=torch.float64))
BOTH = torch.arange(2)
POSES = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]], dtype=torch.float64)


def half_way(rows: torch.Tensor, origin: torch.Tensor, ends: torch.Tensor, *, see_object: bool) -> torch.Tensor:
    """Answer every ray with a hit at half of its length, but the first with a miss."""
    share = torch.full(ends.shape[:2], 0.5, dtype=torch.float64)
    share[:, 0] = 1.0
    return share


def test_rays_start_behind_and_go_around_counter_clockwise():
    """Catches a pattern that differs from what the map assumes."""
    angles = ray_angles(360)
    assert angles[0].item() == -math.pi
    assert angles[180].item() == pytest.approx(0.0, abs=1e-12)
    assert angles[270].item() == pytest.approx(math.pi / 2)
    torch.testing.assert_close(angles.diff(), torch.full((359,), 2 * math.pi / 360, dtype=torch.float64))


def test_rays_end_at_the_range_in_the_world_frame():
    """Catches a yaw that is ignored or subtracted, and rays that leave the scan plane."""
    config = LidarConfig(num_rays=8, max_range=4.0, height=0.3)
    ends = ray_ends(torch.tensor([[1.0, 2.0, math.pi / 2]], dtype=torch.float64), config)[0]
    # Ray 4 points along the base's x axis, which is the world's y axis; ray 6 to the left, the world's -x axis.
    torch.testing.assert_close(ends[4], torch.tensor([1.0, 6.0, 0.3], dtype=torch.float64))
    torch.testing.assert_close(ends[6], torch.tensor([-3.0, 2.0, 0.3], dtype=torch.float64))


def test_only_a_sensor_within_a_square_is_inside():
    """Catches circles in place of squares, a yaw that is ignored, and ghosts of edge zero."""
    pose = torch.tensor([[0.0, 0.0, 0.3]] * 4, dtype=torch.float64)
    # Edge 1, turned by 45 degrees: corners at 0.7071 along x. Straight: faces at 0.5.
    squares = [(0.7, 0.0, math.pi / 4), (0.7, 0.0, 0.0), (0.4, 0.4, 0.0), (0.4, 0.4, math.pi / 4)]
    body = torch.tensor(squares, dtype=torch.float64)[:, None]
    assert starts_inside(pose, body, torch.ones(4, 1, dtype=torch.float64)).tolist() == [True, False, True, False]
    assert not starts_inside(pose, torch.zeros_like(body), torch.zeros(4, 1, dtype=torch.float64)).any()


def test_ranges_are_shares_of_the_maximum():
    """Catches a share that is returned as a range, and a miss that does not read the maximum."""
    lidar = Lidar(2, LidarConfig(num_rays=16, max_range=6.0, noise=0.0), half_way)
    ranges = lidar.scan(BOTH, POSES, *NO_BODIES)
    assert ranges.shape == (2, 16)
    assert (ranges[:, 0] == 6.0).all()
    assert (ranges[:, 1:] == 3.0).all()


def test_noise_belongs_to_the_episode():
    """Catches noise that depends on the batch, on other worlds, or on what was measured before the reset."""
    lidar = Lidar(2, LidarConfig(num_rays=16), half_way)
    lidar.reset(BOTH, noise_key(0, 3, BOTH + 5))
    both = lidar.scan(BOTH, POSES, *NO_BODIES)
    assert not torch.equal(both[0], both[1])
    lidar.reset(BOTH[:1], noise_key(0, 3, BOTH[1:] + 5))
    alone = lidar.scan(BOTH[:1], POSES[:1], *(part[:1] for part in NO_BODIES))
    assert torch.equal(alone[0], both[1])
    assert not torch.equal(lidar.scan(BOTH[1:], POSES[1:], *(part[1:] for part in NO_BODIES))[0], both[1])


def test_noisy_ranges_stay_between_zero_and_the_maximum():
    """Catches a range beyond its spec, which a collector refuses."""
    lidar = Lidar(2, LidarConfig(num_rays=4000, max_range=2.0, noise=1.0), half_way)
    ranges = lidar.scan(BOTH, POSES, *NO_BODIES)
    assert ranges.min() == 0.0
    assert ranges.max() == 2.0


def test_a_sensor_inside_a_body_is_named():
    """Catches an error that does not tell which world, or tells the place in the call."""
    lidar = Lidar(9, LidarConfig(num_rays=16), half_way)
    body = torch.tensor([[[9.0, 9.0, 0.0]], [[1.2, 2.0, 0.0]]], dtype=torch.float64)
    with pytest.raises(RuntimeError, match=r"^the LiDAR of worlds \[7\] starts inside a body"):
        lidar.scan(torch.tensor([4, 7]), POSES, body, torch.ones(2, 1, dtype=torch.float64))
