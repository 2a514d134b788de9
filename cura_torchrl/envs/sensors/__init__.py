"""What the LiDAR measures, and what follows from it."""

from cura_torchrl.envs.sensors.lidar import Lidar, ray_angles, ray_ends, starts_inside
from cura_torchrl.envs.sensors.visibility import (
    MapGrid,
    cell_of_points,
    clean_scan,
    free_margin,
    inside_rectangle,
    sample_table,
    scan_points,
    seen_free,
    unit_vector,
    view_scan,
)
from cura_torchrl.envs.sensors.window import outside_footprint, sample_map, window_offsets, window_points

__all__ = [
    "Lidar",
    "MapGrid",
    "cell_of_points",
    "clean_scan",
    "free_margin",
    "inside_rectangle",
    "outside_footprint",
    "ray_angles",
    "ray_ends",
    "sample_map",
    "sample_table",
    "scan_points",
    "seen_free",
    "starts_inside",
    "unit_vector",
    "view_scan",
    "window_offsets",
    "window_points",
]
