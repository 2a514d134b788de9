"""A recording on matplotlib's axes: paths, bodies, windows of the map; what all figures have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.colors import ListedColormap
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.patheffects import withStroke

from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots.ridgeback import CHASSIS_SIZE
from cura_torchrl.envs.sensors.lidar import ray_angles
from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.axes import tidy
from cura_torchrl.trainers.pictures.raster import SCENE_X, SCENE_Y, rectangle_corners

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from cura_torchrl.trainers.pictures.recording import Recording

_MARGIN = 0.25
"""Left between what is drawn and the frame, where that is beyond the usual limits [m]."""
_MAP_TICKS = (-4, -2, 0, 2, 4)
_POSE_TIME = 5.0
"""Time between two outlines along a path [s]."""


def draw_paths(axis: Any, recording: Recording) -> None:
    """Draw how a recording went, seen from above: paths, outlines on the way, obstacles with their time, the end.

    Args:
        axis: Where to draw.
        recording: What was played.
    """
    goal, edge = recording.scene.goal_pose, recording.scene.object_edge
    axis.add_patch(Circle(goal[:2], recording.success_radius, facecolor="none", edgecolor=raster.GOAL, linewidth=1.4))
    outline(axis, rectangle_corners(goal, edge, edge), raster.GOAL, linewidth=1.4)
    words: list[tuple[float, float]] = []
    for obstacle, appeared in zip(recording.obstacles[-1], recording.appearances, strict=True):
        if np.isfinite(appeared):
            corners = rectangle_corners(obstacle, obstacle[3], obstacle[3])
            axis.add_patch(Polygon(corners, facecolor=raster.OBSTACLE, linewidth=0))
            words.append(_free_place(recording, obstacle, words))
            label = write(axis, f"{appeared:.1f} s", words[-1], up=0.0, va="center", fontsize=8)
            label.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
            label.set_zorder(5)
    every = round(_POSE_TIME / recording.period)
    for step in range(0, len(recording.times), every):
        robot = rectangle_corners(recording.base_pose[step], *CHASSIS_SIZE)
        box = rectangle_corners(recording.object_pose[step], edge, edge)
        outline(axis, robot, raster.ROBOT, alpha=0.35, linewidth=0.8)
        outline(axis, box, raster.OBJECT, alpha=0.35, linewidth=0.8)
    axis.plot(*recording.base_pose[:, :2].T, color=raster.ROBOT, linewidth=2.0)
    axis.plot(*recording.object_pose[:, :2].T, color=raster.OBJECT, linewidth=2.0, linestyle=(0, (4, 1)))
    axis.plot(*recording.object_pose[0, :2], "o", color=raster.OBJECT, markerfacecolor="white", markersize=5)
    draw_robot(axis, recording.base_pose[-1], recording.tcp[-1] if recording.has_arm else None)
    axis.add_patch(Polygon(rectangle_corners(recording.object_pose[-1], edge, edge), facecolor=raster.OBJECT))
    if recording.outcome == "collision":
        bodies = (recording.base_pose, recording.tcp, recording.object_pose)
        struck = next(body for body, touched in zip(bodies, recording.episode.contact, strict=True) if touched)
        axis.plot(*struck[-1, :2], "X", color=raster.FAILURE, markeredgecolor="white", markersize=11)
    frame_world(axis)


def _free_place(
    recording: Recording, obstacle: NDArray[np.float32], words: list[tuple[float, float]]
) -> tuple[float, float]:
    """Return where beside an obstacle a word is farthest from all that is drawn."""
    aside, above = 0.5 * float(obstacle[3]) + 0.75, 0.5 * float(obstacle[3]) + 0.4
    places = np.array(obstacle[:2]) + np.array([[0.0, above], [0.0, -above], [aside, 0.0], [-aside, 0.0]])
    edge = recording.scene.object_edge
    others = recording.obstacles[-1][recording.obstacles[-1, :, 3] > 0, :2]
    drawn = np.concatenate(
        [
            recording.base_pose[:, :2],
            recording.object_pose[:, :2],
            rectangle_corners(recording.object_pose[-1], edge, edge),
            rectangle_corners(recording.base_pose[-1], *CHASSIS_SIZE),
            others[np.abs(others - obstacle[:2]).max(-1) > 0.0],
            *(np.array([[x - 0.6, y], [x, y], [x + 0.6, y]]) for x, y in words),
        ]
    )
    # A word is about three times as wide as it is high.
    away = (np.abs(places[:, None] - drawn) / np.array([3.0, 1.0])).max(-1).min(-1)
    x, y = places[int(away.argmax())].tolist()
    return x, y


def draw_robot(axis: Any, base: Any, tcp: Any) -> None:
    """Draw chassis and arm, if any, seen from above.

    Args:
        axis: Where to draw.
        base: (x [m], y [m], yaw [rad]).
        tcp: TCP in the plane [m]; None draws no arm.
    """
    axis.add_patch(Polygon(rectangle_corners(base, *CHASSIS_SIZE), facecolor=raster.ROBOT))
    if tcp is not None:
        axis.plot([base[0], tcp[0]], [base[1], tcp[1]], color=raster.ARM, linewidth=3.0, solid_capstyle="round")


def draw_map(axis: Any, recording: Recording, frame: int, *, channel: int) -> None:
    """Draw a window of the map with the outlines of robot and object, base frame.

    Args:
        axis: Where to draw.
        recording: What was played.
        frame: Index into ``frame_steps`` [1].
        channel: 0 for the confidence, -1 for the occupancy.
    """
    extent = recording.maps.shape[-1] * recording.resolution / 2
    colours = raster.CONFIDENCE_COLOURS if channel == 0 else raster.OCCUPANCY_COLOURS
    axis.imshow(
        recording.maps[frame, channel].T,
        cmap=ListedColormap(colours / 255.0),
        vmin=0,
        vmax=255,
        origin="lower",
        extent=(-extent, extent, -extent, extent),
        interpolation="nearest",
    )
    edge, step = recording.scene.object_edge, int(recording.frame_steps[frame])
    outline(axis, rectangle_corners((0.0, 0.0, 0.0), *CHASSIS_SIZE), raster.ROBOT, linewidth=1.6)
    outline(axis, rectangle_corners(recording.object_in_base(step), edge, edge), raster.OBJECT, linewidth=1.6)
    axis.set(xticks=_MAP_TICKS, yticks=_MAP_TICKS, xlim=(-extent, extent), ylim=(-extent, extent))
    axis.tick_params(labelsize=8)


def draw_scan(axis: Any, recording: Recording, frame: int) -> None:
    """Draw where the LiDAR's rays end on something, base frame.

    Args:
        axis: Where to draw.
        recording: What was played.
        frame: Index into ``frame_steps`` [1].
    """
    scan, angles = recording.scans[frame], ray_angles(recording.scans.shape[1]).numpy()
    is_hit = scan < 0.995 * recording.scans.max()
    ends = scan[is_hit, None] * np.stack([np.cos(angles), np.sin(angles)], -1)[is_hit]
    axis.plot(*ends.T, ".", color=raster.HIT, markersize=3.0, markeredgewidth=0.0)


def place_in_base(recording: Recording, step: int, pose: NDArray[np.floating]) -> tuple[float, float, float]:
    """Return a pose in the base frame.

    Args:
        recording: What was played.
        step: Index of the state [1].
        pose: (x [m], y [m], yaw [rad]), world frame.

    Returns:
        (x [m], y [m], yaw [rad]).
    """
    base = torch.from_numpy(recording.base_pose[step])
    x, y = geometry.to_frame(base, torch.as_tensor(pose[:2], dtype=base.dtype)).tolist()
    return x, y, float(pose[2] - recording.base_pose[step, 2])


def add_legend(figure: Figure, *, has_collision: bool) -> None:
    """Write what the colours of paths stand for along the figure's lower edge.

    Args:
        figure: The figure.
        has_collision: Whether a collision is marked.
    """
    entries: list[Any] = [
        Line2D([], [], color=raster.ROBOT, linewidth=2.0, label="robot and its path"),
        Line2D([], [], color=raster.OBJECT, linewidth=2.0, linestyle=(0, (4, 1)), label="object and its path"),
        Patch(facecolor=raster.OBSTACLE, label="obstacle, time at which it appeared"),
        Patch(facecolor="none", edgecolor=raster.GOAL, label="goal"),
    ]
    if has_collision:
        marker: dict[str, Any] = {"marker": "X", "markersize": 9, "markeredgecolor": "white"}
        entries.append(Line2D([], [], linestyle="none", color=raster.FAILURE, label="collision", **marker))
    wide = figure.get_size_inches()[0] > 8.0
    figure.legend(handles=entries, loc="lower center", ncols=len(entries) if wide else 3, fontsize=8, frameon=False)


def outline(axis: Any, corners: NDArray[np.float64], colour: str, **options: Any) -> None:
    """Draw an outline.

    Args:
        axis: Where to draw.
        corners: Corners [m], shape ``[M, 2]``.
        colour: Colour of the line.
        **options: Of the patch.
    """
    axis.add_patch(Polygon(corners, facecolor="none", edgecolor=colour, **options))


def write(axis: Any, text: str, place: Any, *, up: float = 2.0, **options: Any) -> Any:
    """Write above a place.

    Args:
        axis: Where to draw.
        text: What to write.
        place: Where [m].
        up: How far above [point].
        **options: Of the text.

    Returns:
        The annotation.
    """
    return axis.annotate(text, place, (0, up), textcoords="offset points", ha="center", **options)


def frame_world(axis: Any) -> None:
    """Show the whole scene to scale, and what went beyond.

    Args:
        axis: Where all has been drawn.
    """
    drawn = [sibling.dataLim for sibling in axis.get_shared_y_axes().get_siblings(axis)]
    low, high = np.min([box.p0 for box in drawn], 0) - _MARGIN, np.max([box.p1 for box in drawn], 0) + _MARGIN
    x, y = zip(np.minimum(low, (SCENE_X.low, SCENE_Y.low)), np.maximum(high, (SCENE_X.high, SCENE_Y.high)), strict=True)
    axis.set(xlim=x, ylim=y, aspect="equal", xlabel="x [m]")
    axis.set_xticks(range(-2, 17, 2))
    tidy(axis)
