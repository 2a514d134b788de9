"""What the LiDAR measures, and what follows from it."""

from cura_torchrl.envs.sensors.visibility import (
    MapGrid,
    cell_of_points,
    clean_scan,
    inside_rectangle,
    outside_footprint,
    ray_bearings,
    ray_ends,
    seen_free,
    unit_vector,
    window_cells,
    window_offsets,
)

__all__ = [
    "MapGrid",
    "cell_of_points",
    "clean_scan",
    "inside_rectangle",
    "outside_footprint",
    "ray_bearings",
    "ray_ends",
    "seen_free",
    "unit_vector",
    "window_cells",
    "window_offsets",
]
