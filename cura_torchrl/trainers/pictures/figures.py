"""Still pictures: paths and maps of recordings, the environment's layout, a run's progress."""

from __future__ import annotations

import math
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from cura_torchrl.envs.robots.ridgeback_franka import HOME_TCP
from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.axes import encode, set_margins, tidy
from cura_torchrl.trainers.pictures.moments import frames_at
from cura_torchrl.trainers.pictures.raster import rectangle_corners
from cura_torchrl.trainers.pictures.scene_axes import (
    add_legend,
    draw_map,
    draw_paths,
    draw_robot,
    frame_world,
    outline,
    write,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cura_torchrl.envs.config import ScenarioConfig
    from cura_torchrl.trainers.pictures.recording import Recording
    from cura_torchrl.trainers.pictures.render_config import StillFormat

_CURVES = (
    ("success", "success rate [1]", raster.ROBOT),
    ("collision", "collision rate [1]", raster.RISK),
    ("object_speed", "object speed [m/s]", raster.OBJECT),
    ("reward", "reward per step [1]", raster.UNCERTAINTY),
)


def paths_figure(recordings: Sequence[Recording], *, kind: StillFormat = "png") -> bytes:
    """Return the paths of recordings of the same scene, side by side.

    Args:
        recordings: What to show, at least one.
        kind: Format of the file.

    Returns:
        Content of the file.
    """
    figure = Figure(figsize=(5.0 * len(recordings), 3.4))
    axes = np.atleast_1d(figure.subplots(1, len(recordings), sharex=True, sharey=True, gridspec_kw={"wspace": 0.06}))
    for axis, recording in zip(axes, recordings, strict=True):
        draw_paths(axis, recording)
        axis.set_title(f"{recording.label}: {recording.describe()}", fontsize=10, loc="left")
    axes[0].set_ylabel("y [m]")
    _finish_paths(figure, recordings)
    return encode(figure, kind)


def snapshots_figure(
    recordings: Sequence[Recording], *, times: Sequence[float] = (), kind: StillFormat = "png"
) -> bytes:
    """Return each recording's paths above its map at some moments.

    Args:
        recordings: What to show, at least one.
        times: The moments [s]; none takes three telling ones.
        kind: Format of the file.

    Returns:
        Content of the file.
    """
    count = len(times) or 3
    width = max(5.0, 1.67 * count)
    figure = Figure(figsize=(width * len(recordings), 7.5))
    _finish_paths(figure, recordings)
    cells = figure.add_gridspec(1, len(recordings), wspace=0.15)
    for index, recording in enumerate(recordings):
        grid = cells[0, index].subgridspec(3, count, height_ratios=(2.3, 1.5, 1.5), hspace=0.5, wspace=0.1)
        axis = figure.add_subplot(grid[0, :])
        draw_paths(axis, recording)
        axis.set_ylabel("y [m]")
        axis.set_title(f"{recording.label}: {recording.describe()}", fontsize=10, loc="left")
        frames = frames_at(recording, times)
        for name, frame in zip(ascii_lowercase, frames, strict=False):
            place = recording.base_pose[recording.frame_steps[frame], :2]
            label = write(axis, name, place, up=12, fontsize=10, fontweight="bold")
            label.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
        for row, channel in ((1, 0), (2, -1)):
            axes = [figure.add_subplot(grid[row, column]) for column in range(count)]
            _draw_maps(axes, recording, frames, channel=channel)
    return encode(figure, kind)


def _finish_paths(figure: Figure, recordings: Sequence[Recording]) -> None:
    """Set margins, and write the legend into the lower one."""
    add_legend(figure, has_collision=any(recording.outcome == "collision" for recording in recordings))
    set_margins(figure, bottom=0.85 if figure.get_size_inches()[0] > 8.0 else 1.0)


def _draw_maps(axes: Sequence[Any], recording: Recording, frames: Sequence[int], *, channel: int) -> None:
    quantity = "confidence" if channel == 0 else "occupancy"
    for name, axis, frame in zip(ascii_lowercase, axes, frames, strict=False):
        draw_map(axis, recording, frame, channel=channel)
        time = recording.times[recording.frame_steps[frame]]
        axis.set_title(f"{name}: {quantity}, {time:.1f} s", fontsize=8, loc="left")
        axis.tick_params(labelleft=axis is axes[0])
        if channel != 0:
            axis.set_xlabel("ahead of the base [m]", fontsize=8)
    axes[0].set_ylabel("left of the base [m]", fontsize=8)


def layout_figure(config: ScenarioConfig, *, kind: StillFormat = "png") -> bytes:
    """Return where object, robot, obstacles and goal may be, to scale.

    Args:
        config: Layout.
        kind: Format of the file.

    Returns:
        Content of the file.
    """
    figure = Figure(figsize=(8.0, 4.3))
    axis = figure.subplots()
    for x_range, y_range, colour, text in (
        ((-0.06, 0.06), config.object_y, raster.OBJECT, "object's start"),
        (config.obstacle_x, config.obstacle_y, raster.GOAL, "obstacles may appear here (uniform)"),
        (config.goal_x, config.goal_y, raster.ROBOT, "goal"),
    ):
        (left, right), (low, high) = x_range, y_range
        axis.add_patch(Rectangle((left, low), right - left, high - low, alpha=0.3, color=colour, linewidth=0))
        write(axis, text, ((left + right) / 2, high), up=3, fontsize=9)
    (left, right), jitter = config.obstacle_x, config.adversarial_jitter
    strip = np.array([[left, -jitter], [right, -jitter], [right, jitter], [left, jitter]])
    outline(axis, strip, raster.INK, linewidth=1.2, linestyle=":")
    write(axis, "adversarial: on the line from object to goal", strip[:2].mean(0), up=-12, fontsize=9)
    _draw_sizes(axis, config)
    frame_world(axis)
    axis.set_ylabel("y [m]")
    set_margins(figure, top=0.15)
    return encode(figure, kind)


def _draw_sizes(axis: Any, config: ScenarioConfig) -> None:
    """Draw robot and largest object at their start, and an obstacle of each size."""
    edge = max(config.object_edges)
    hand = -edge / 2 - float(np.mean(config.start_gap))
    base = (hand - HOME_TCP[0], 0.0, 0.0)
    draw_robot(axis, base, (hand, 0.0))
    axis.add_patch(Polygon(rectangle_corners((0.0, 0.0, 0.0), edge, edge), facecolor=raster.OBJECT))
    write(axis, "robot", base[:2], up=-24, fontsize=9)
    for number, size in enumerate(config.obstacle_edges):
        place = (config.obstacle_x[0] + 1.2 + 1.6 * number, config.obstacle_y[0] + 0.9, 0.4 * number)
        axis.add_patch(Polygon(rectangle_corners(place, size, size), facecolor=raster.OBSTACLE))
        write(axis, f"{size:g} m", (place[0], place[1] + 0.75 * size), fontsize=8)


def curve_figure(before: Sequence[dict[str, float]], after: Sequence[dict[str, float]]) -> bytes:
    """Return a run's curves, and how they went on.

    Args:
        before: Rows of the run so far; may be empty.
        after: Rows of the iterations that followed, whose ``frames`` count from there.

    Returns:
        Content of a PNG file.
    """
    figure = Figure(figsize=(10.0, 4.8))
    grid = figure.subplots(2, 4, gridspec_kw={"width_ratios": (2.6, 1.0, 2.6, 1.0), "wspace": 0.22, "hspace": 0.32})
    for pair, (name, label, colour) in zip(grid.reshape(4, 2), _CURVES, strict=True):
        pair[1].sharey(pair[0])
        for axis, rows, unit, style in (
            (pair[0], before, 1e6, {"linewidth": 1.3}),
            (pair[1], after, 1e3, {"linewidth": 1.8, "marker": "o", "markersize": 4.0}),
        ):
            points = [(row["frames"] / unit, row[name]) for row in rows if math.isfinite(row.get(name, math.nan))]
            if points:
                axis.plot(*np.array(points).T, color=colour, **style)
            tidy(axis)
        pair[1].tick_params(labelleft=False)
        pair[1].xaxis.set_major_locator(MaxNLocator(3))
        pair[0].set_title(label, fontsize=10, loc="left")
        pair[1].set_title("in this demo", fontsize=9, loc="left")
    for pair in grid[1].reshape(2, 2):
        pair[0].set_xlabel("environment steps [million]")
        pair[1].set_xlabel("steps [thousand]")
    set_margins(figure)
    return encode(figure, "png")
