"""What the LiDAR measures, and what follows from it."""

from cura_torchrl.envs.sensors.lidar import Lidar, ray_angles, ray_ends, starts_inside
from cura_torchrl.envs.sensors.visibility import (
    MapGrid,
    cell_of_points,
    clean_scan,
    inside_rectangle,
    outside_footprint,
    scan_points,
    seen_free,
    unit_vector,
    window_cells,
    window_offsets,
    work_space,
)

__all__ = [
    "Lidar",
    "MapGrid",
    "cell_of_points",
    "clean_scan",
    "inside_rectangle",
    "outside_footprint",
    "ray_angles",
    "ray_ends",
    "scan_points",
    "seen_free",
    "starts_inside",
    "unit_vector",
    "window_cells",
    "window_offsets",
    "work_space",
]
