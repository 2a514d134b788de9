"""The LiDAR in scenes whose ranges are known, through BulletWorlds: nothing that should be seen reads as free space."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from cura_torchrl.envs.config import LidarConfig
from cura_torchrl.envs.sensors.lidar import Lidar
from cura_torchrl.envs.sensors.noise import noise_key
from cura_torchrl.envs.simulation.interface import SimulationError
from tests.scenes import cast_rays
from tests.worlds import AWAY, make_worlds, place

if TYPE_CHECKING:
    from cura_torchrl.envs.simulation.bullet import BulletWorlds

ROW = torch.arange(1)

AHEAD = 180
"""Ray that points along the base's x axis: the first one points backwards, a ray a degree."""


def scan(
    worlds: BulletWorlds, pose: tuple[float, float, float], bodies: list[tuple[float, ...]] = (), **config: float
) -> np.ndarray:
    """Return the ranges seen from a pose in world 0; bodies are (x, y, yaw, edge)."""
    lidar = Lidar(1, LidarConfig(**({"noise": 0.0} | config)), worlds.cast)
    lidar.reset(ROW, noise_key(0, 0, ROW))
    squares = torch.tensor(bodies, dtype=torch.float64).reshape(1, -1, 4)
    ranges = lidar.scan(ROW, torch.tensor([pose], dtype=torch.float64), squares[..., :3], squares[..., 3])
    assert ranges.dtype == torch.float32
    return ranges[0].double().numpy()


def test_a_face_is_seen_at_its_distance():
    """Catches a range that is a share of the ray, and rays that start beside the base's centre or at a wrong angle."""
    worlds = make_worlds(1)
    place(worlds, 0, 0, (3.0, 0.0, 0.0), 1.0)
    ranges = scan(worlds, (0.0, 0.0, 0.0))
    worlds.close()
    # The face at x = 2.5, half as wide as 0.5: seen within atan(0.5 / 2.5) = 11.3 degrees.
    for degree in range(-11, 12):
        assert ranges[AHEAD + degree] == pytest.approx(2.5 / math.cos(math.radians(degree)), abs=1e-6)
    assert (np.delete(ranges, np.arange(AHEAD - 11, AHEAD + 12)) == 10.0).all()


def test_a_corner_is_seen_at_its_distance():
    """Catches collision margins that round the box off or blow it up."""
    worlds = make_worlds(1)
    place(worlds, 0, 0, (0.0, 4.0, math.pi / 4), 1.0)
    ranges = scan(worlds, (0.0, 0.0, 0.0))
    worlds.close()
    left, corner = AHEAD + 90, 4.0 - math.sqrt(0.5)
    assert ranges[left] == pytest.approx(corner, abs=1e-3)  # Bullet's search for the contact ends early at a vertex
    for degree in (1, 5, 8):
        # The faces are y = corner + |x|: t cos d = corner + t sin d.
        angle = math.radians(degree)
        expected = corner / (math.cos(angle) - math.sin(angle))
        assert ranges[[left - degree, left + degree]] == pytest.approx([expected] * 2, abs=1e-6)


def test_any_scene_is_seen_as_geometry_says():
    """Catches a wrong frame, filter or order of the rays, against rays cast in NumPy."""
    obstacles = [(4.0, 1.0, 0.3, 1.0), (-3.0, -2.0, 1.0, 0.6), (1.0, -5.0, 2.0, 0.4), (6.0, 2.5, -0.4, 1.0)]
    worlds = make_worlds(1, object=(1.5, 0.2, 0.5), edge=0.75)
    for slot, (x, y, yaw, edge) in enumerate(obstacles):
        place(worlds, 0, slot, (x, y, yaw), edge)
    for pose in ((0.0, 0.0, 0.0), (-1.0, 0.5, 2.2), (0.3, -2.0, -0.7)):
        for occlusion in (True, False):
            bodies = [(x, y, yaw, edge, edge) for x, y, yaw, edge in obstacles + [(1.5, 0.2, 0.5, 0.75)] * occlusion]
            expected = cast_rays(np.array(bodies), np.array(pose))
            ranges = scan(worlds, pose, occlusion=occlusion)
            # A ray that grazes a corner may fall either way; all others agree to the last digit of a float32.
            agree = np.abs(ranges - expected) < 1e-6
            assert agree.mean() > 0.99
            assert (expected < 10.0).sum() > 30
    worlds.close()


def test_turning_the_world_turns_nothing_in_the_base_frame():
    """Catches rays whose direction ignores the base's yaw."""
    ranges = []
    for turn in (0.0, 1.1):
        where = (3.0 * math.cos(turn + 0.2), 3.0 * math.sin(turn + 0.2), turn + 0.4)
        worlds = make_worlds(1)
        place(worlds, 0, 0, where, 1.0)
        ranges.append(scan(worlds, (0.0, 0.0, turn)))
        worlds.close()
    np.testing.assert_allclose(ranges[0], ranges[1], atol=1e-6)


def test_what_is_beyond_the_range_reads_the_maximum():
    """Catches a miss that reads zero, and a hit beyond the range."""
    worlds = make_worlds(1)
    place(worlds, 0, 0, (8.0, 0.0, 0.0), 1.0)  # face at 7.5 m
    assert scan(worlds, (0.0, 0.0, 0.0), max_range=7.6)[AHEAD] == pytest.approx(7.5, abs=1e-6)
    assert (scan(worlds, (0.0, 0.0, 0.0), max_range=7.4) == np.float32(7.4)).all()
    worlds.close()


def test_the_robot_is_never_seen():
    """Catches rays that hit the chassis or the arm, from inside or from outside of them."""
    worlds = make_worlds(1)
    for pose in ((0.0, 0.0, 0.0), (0.3, 0.1, 1.0), (0.0, 2.0, -1.5)):
        for height in (0.26, 0.5, 0.8):
            assert (scan(worlds, pose, height=height) == 10.0).all()
    worlds.close()


def test_a_box_lower_than_the_scan_plane_is_not_seen():
    """Catches a scan plane at another height than the config says."""
    worlds = make_worlds(1)
    place(worlds, 0, 0, (3.0, 0.0, 0.0), 0.4)
    assert scan(worlds, (0.0, 0.0, 0.0), height=0.39)[AHEAD] == pytest.approx(2.8, abs=1e-6)
    assert scan(worlds, (0.0, 0.0, 0.0), height=0.41)[AHEAD] == 10.0
    worlds.close()


def test_noise_has_the_deviation_asked_for_and_spares_misses():
    """Catches noise on free space, a wrong scale, and noise that is the same in every scan."""
    worlds = make_worlds(1)
    for slot in range(6):
        angle = slot * math.pi / 3
        place(worlds, 0, slot, (2.0 * math.cos(angle), 2.0 * math.sin(angle), angle), 1.0)
    clean, lidar = scan(worlds, (0.0, 0.0, 0.0)), Lidar(1, LidarConfig(noise=0.02), worlds.cast)
    lidar.reset(ROW, noise_key(0, 7, ROW + 3))
    nothing = torch.zeros(1, 0, 3, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
    pose = torch.zeros(1, 3, dtype=torch.float64)
    scans = np.stack([lidar.scan(ROW, pose, *nothing)[0].double().numpy() for _ in range(40)])
    worlds.close()
    is_hit = clean < 10.0
    assert is_hit.sum() > 150
    assert (scans[:, ~is_hit] == 10.0).all()
    error = (scans - clean)[:, is_hit]
    # 40 * 150 draws: the standard error of the deviation is 0.02 / sqrt(2 * 6000) = 0.0002, of the mean 0.0003.
    assert error.std() == pytest.approx(0.02, abs=0.001)
    assert abs(error.mean()) < 0.0013
    assert abs(np.corrcoef(error[:-1].ravel(), error[1:].ravel())[0, 1]) < 0.07


def test_a_sensor_inside_a_body_is_an_error():
    """Catches Bullet's rays that ignore a convex body they start in: free space where there is none."""
    worlds = make_worlds(1, object=(0.4, 0.0, 0.0), edge=1.0, base=AWAY)
    assert (scan(worlds, (0.0, 0.0, 0.0)) == 10.0).mean() > 0.7  # what the guard is for: all rays start inside
    with pytest.raises(RuntimeError, match=r"^the LiDAR of worlds \[0\] starts inside a body"):
        scan(worlds, (0.0, 0.0, 0.0), [(0.4, 0.0, 0.0, 1.0)])
    worlds.close()


def test_rays_that_bullet_would_not_answer_are_errors():
    """Catches NaN and too many rays, which Bullet answers with no hit at all."""
    worlds = make_worlds(1)
    with pytest.raises(SimulationError, match=r"finite: False; accepted: "):
        scan(worlds, (math.nan, 0.0, 0.0))
    ends = torch.zeros(1, 8193, 3, dtype=torch.float64)
    with pytest.raises(SimulationError, match=r"^8193 rays, .*; accepted: at most 8192"):
        worlds.cast(ROW, ends[:, 0], ends, see_object=True)
    ends[0, 5, 1] = math.inf
    with pytest.raises(SimulationError, match="finite: False"):
        worlds.cast(ROW, ends[:, 0], ends[:, :100], see_object=True)
    place(worlds, 0, 0, (3.0, 0.0, 0.0), 1.0)
    ranges = scan(worlds, (0.0, 0.0, 0.0), num_rays=8192)
    assert ranges[4096] == pytest.approx(2.5, abs=1e-6)
    worlds.close()


def test_rays_are_cast_in_the_worlds_asked_for():
    """Catches rows of a partial reset that are scanned in another world."""
    worlds = make_worlds(3)
    for world in range(3):
        place(worlds, world, 0, (3.0 + world, 0.0, 0.0), 1.0, num_worlds=3)
    origin = torch.tensor([[0.0, 0.0, 0.26]] * 2, dtype=torch.float64)
    ends = torch.tensor([[[10.0, 0.0, 0.26]]] * 2, dtype=torch.float64)
    share = worlds.cast(torch.tensor([2, 0]), origin, ends, see_object=False)
    np.testing.assert_allclose(share, [[0.45], [0.25]], atol=1e-9)
    worlds.close()
