"""What the LiDAR measures, and what follows from it."""

from cura_torchrl.envs.sensors.lidar import Lidar, ray_angles, ray_ends, starts_inside
from cura_torchrl.envs.sensors.visibility import (
    MapGrid,
    cell_of_points,
    clean_scan,
    inside_rectangle,
    scan_points,
    seen_free,
    unit_vector,
)
from cura_torchrl.envs.sensors.window import (
    footprint_frame,
    inside_footprint,
    map_frame,
    sample_map,
    window_offsets,
)

__all__ = [
    "Lidar",
    "MapGrid",
    "cell_of_points",
    "clean_scan",
    "footprint_frame",
    "inside_footprint",
    "inside_rectangle",
    "map_frame",
    "ray_angles",
    "ray_ends",
    "sample_map",
    "scan_points",
    "seen_free",
    "starts_inside",
    "unit_vector",
    "window_offsets",
]
