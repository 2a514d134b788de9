"""What a scan costs beside its rays alone, the map beside a test of all its cells, the encoder beside a usual one."""

from __future__ import annotations

import functools
import itertools
from typing import TYPE_CHECKING

import torch
from torch import nn

from cura_torchrl import keys
from cura_torchrl.envs.config import LidarConfig, MapConfig
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.sensors import MapGrid, seen_free
from cura_torchrl.envs.sensors.lidar import Lidar, ray_ends
from cura_torchrl.envs.simulation.bullet_floor import BulletFloor
from cura_torchrl.envs.transforms import ConfidenceMap
from cura_torchrl.trainers.benches.report import Report, measure, rates, timed
from cura_torchrl.trainers.build import load_encoder

if TYPE_CHECKING:
    from tensordict import TensorDict

    from cura_torchrl.trainers.benches.config import BenchConfig

USUAL_CHANNELS = (32, 64, 64, 128)
"""Channels of the usual encoder of pictures of 100 x 100 cells: four convolutions with stride 2."""


def run(config: BenchConfig) -> Report:
    """Measure scan, map and encoder.

    Args:
        config: How.

    Returns:
        Each beside its reference.
    """
    report = Report()
    env = PushEnv(config.num_envs, seed=config.seed)
    scans = env.rollout(config.steps, break_when_any_done=False).transpose(0, 1).reshape(-1)
    measure_scan(env, config, report)
    env.close()
    maps = measure_map(scans, config, report)
    measure_encoder(maps, config, report)
    return report


def measure_scan(env: PushEnv, config: BenchConfig, report: Report) -> None:
    """Compare the LiDAR's scan, noise and conversions included, with the engine's ray test alone.

    Args:
        env: Worlds after a reset.
        config: How.
        report: Where the figures go.
    """
    lidar, rows = env.config.lidar, env.num_envs
    sensor = Lidar(rows, lidar, env._worlds.cast)
    pose = env.world_state.base_pose
    bodies, edges = pose.new_zeros(rows, 1, 3), pose.new_zeros(rows, 1)
    origin = torch.cat([pose[:, :2], torch.full_like(pose[:, :1], lidar.height)], -1)
    ends = ray_ends(pose, lidar)
    starts, targets = origin[:, None].expand(ends.shape).contiguous().numpy(), ends.numpy()
    floor = BulletFloor(env._worlds)
    plays = {
        "scan": timed(lambda: sensor.scan(torch.arange(rows), pose, bodies, edges)),
        "rays": timed(functools.partial(floor.cast, starts, targets)),
    }
    taken = measure(plays, 3 * config.rounds, "scans")
    report.add_figure(f"scan of {lidar.num_rays} rays, {rows} worlds", rates(rows, taken["scan"]), "scans/s")
    report.add_ratio("scan / rayTestBatch alone", taken["scan"], taken["rays"])


def see_all_cells(scan: torch.Tensor, pose: torch.Tensor, config: MapConfig) -> torch.Tensor:
    """Return which cells of the global map a scan sees free, from the bearing and the distance of each of them.

    Args:
        scan: Ranges [m], shape ``[B, R]``.
        pose: Sensor (x [m], y [m], yaw [rad]), shape ``[B, 3]``.
        config: Extent and resolution.

    Returns:
        Whether a cell's centre is nearer than the range at its bearing, less half its diagonal, ``[B, X, Y]``.
    """
    grid = MapGrid(extent_x=config.extent_x, extent_y=config.extent_y, resolution=config.resolution)
    return grid.inside(seen_free(grid.row_x(), grid.column_y(), scan, pose.float(), grid.half_diagonal))


def measure_map(scans: TensorDict, config: BenchConfig, report: Report) -> torch.Tensor:
    """Compare a step of the map, with its memory and its window, with a test of all cells that keeps nothing.

    Args:
        scans: What PushEnv observed, repeated to fill the batch.
        config: How.
        report: Where the figures go.

    Returns:
        Windows of a batch, shape ``[N, 2, 100, 100]``.
    """
    lidar, count = LidarConfig(), config.maps
    transform = ConfidenceMap(num_rays=lidar.num_rays, max_range=lidar.max_range)
    inputs = scans.select(*transform.in_keys)[torch.arange(count) % len(scans)]
    few = inputs[: max(1, count // 16)]  # its work space is large

    def all_cells() -> None:
        see_all_cells(few[keys.SCAN], few[keys.SENSOR_POSE], MapConfig())

    plays = {"map": timed(lambda: transform(inputs.clone(False))), "all cells": timed(all_cells)}
    taken = measure(plays, config.rounds, "maps")
    report.add_figure(f"step of the map, {count} environments", rates(count, taken["map"]), "maps/s")
    per_map = [value / count for value in taken["map"]], [value / len(few) for value in taken["all cells"]]
    report.add_ratio("bearing and range of all cells / step of the map", per_map[1], per_map[0])
    return transform(inputs.clone(False))[keys.CONFIDENCE_MAP]


def usual_encoder(latent_size: int, channels: int, window: int) -> nn.Module:
    """Return four convolutions with stride 2 and a linear layer.

    Args:
        latent_size: Length of the code [1].
        channels: Channels of the window [1].
        window: Cells along its edge [1].

    Returns:
        The network, ``[B, C, W, W]`` to ``[B, latent_size]``.
    """
    sizes = channels, *USUAL_CHANNELS
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(sizes):
        layers += [nn.Conv2d(before, after, 4, stride=2, padding=1), nn.ReLU()]
    trunk = nn.Sequential(*layers, nn.Flatten())
    features = trunk(torch.zeros(1, channels, window, window)).shape[-1]
    return nn.Sequential(trunk, nn.Linear(features, latent_size)).requires_grad_(False)


def measure_encoder(maps: torch.Tensor, config: BenchConfig, report: Report) -> None:
    """Compare the shipped encoder with a usual one on the same maps.

    Args:
        maps: Windows, shape ``[N, C, W, W]``.
        config: How.
        report: Where the figures go.
    """
    encoder = load_encoder(None).requires_grad_(False)
    usual = usual_encoder(encoder.latent_size, maps.shape[1], maps.shape[2])
    few = maps[: max(1, len(maps) // 4)]
    plays = {"encoder": timed(lambda: encoder.encode(maps)), "usual": timed(lambda: usual(few))}
    taken = measure(plays, config.rounds, "codes")
    report.add_figure(f"encoder, batch of {len(maps)}", rates(len(maps), taken["encoder"]), "maps/s")
    ours, theirs = rates(len(maps), taken["encoder"]), rates(len(few), taken["usual"])
    report.add_ratio("encoder / four convolutions with stride 2, maps/s", ours, theirs)
