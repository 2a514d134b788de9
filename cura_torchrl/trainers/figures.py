"""Still pictures of recordings and of a run's progress, as PNG."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from PIL import Image

from cura_torchrl.envs.robots.ridgeback import CHASSIS_SIZE
from cura_torchrl.envs.robots.ridgeback_franka import HOME_TCP
from cura_torchrl.trainers import raster
from cura_torchrl.trainers.raster import rectangle_corners, two_digits

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from cura_torchrl.envs.config import ScenarioConfig
    from cura_torchrl.trainers.recording import Recording

_WORLD_X, _WORLD_Y = (-2.5, 16.0), (-4.625, 4.625)
_MAP_TICKS = (-4, -2, 0, 2, 4)
_DOTS = 140
"""Resolution of the pictures [pixel/inch]."""
_POSE_TIME = 5.0
"""Time between two outlines along a path [s]."""
_APART = 1.5
"""Least time between telling moments, where there is room for it [s]."""
_CURVES = (
    ("success", "success rate [1]", raster.ROBOT),
    ("collision", "collision rate [1]", raster.RISK),
    ("object_speed", "object speed [m/s]", raster.OBJECT),
    ("reward", "reward per step [1]", raster.UNCERTAINTY),
)


def paths_figure(recordings: Sequence[Recording]) -> bytes:
    """Return the paths of recordings of the same scene, side by side.

    Args:
        recordings: What to show, at least one.

    Returns:
        Content of a PNG file.
    """
    figure = Figure(figsize=(5.0 * len(recordings), 3.1))
    axes = np.atleast_1d(figure.subplots(1, len(recordings), sharex=True, sharey=True, gridspec_kw={"wspace": 0.06}))
    for axis, recording in zip(axes, recordings, strict=True):
        _draw_paths(axis, recording)
        axis.set_title(f"{recording.label}: {recording.describe()}", fontsize=10, loc="left")
    axes[0].set_ylabel("y [m]")
    _set_margins(figure)
    return _png(figure)


def snapshots_figure(recordings: Sequence[Recording]) -> bytes:
    """Return each recording's paths above its map at three telling moments.

    Args:
        recordings: What to show, at least one.

    Returns:
        Content of a PNG file.
    """
    figure = Figure(figsize=(5.0 * len(recordings), 7.2))
    _set_margins(figure)
    cells = figure.add_gridspec(1, len(recordings), wspace=0.15)
    for index, recording in enumerate(recordings):
        grid = cells[0, index].subgridspec(3, 3, height_ratios=(2.3, 1.5, 1.5), hspace=0.5, wspace=0.1)
        axis = figure.add_subplot(grid[0, :])
        _draw_paths(axis, recording)
        axis.set_ylabel("y [m]")
        axis.set_title(f"{recording.label}: {recording.describe()}", fontsize=10, loc="left")
        frames = telling_frames(recording)
        for name, frame in zip("abc", frames, strict=True):
            place = recording.base_pose[recording.frame_steps[frame], :2]
            _write(axis, name, place, up=12, fontsize=10, fontweight="bold")
        for row, channel in ((1, 0), (2, -1)):
            axes = [figure.add_subplot(grid[row, column]) for column in range(3)]
            _draw_maps(axes, recording, frames, channel=channel)
    return _png(figure)


def distribution_figure(recordings: Sequence[Recording]) -> bytes:
    """Return the DCE's predicted distribution at three telling moments of each recording.

    Args:
        recordings: What to show, at least one.

    Returns:
        Content of a PNG file.
    """
    figure = Figure(figsize=(9.0, 0.8 + 2.1 * len(recordings)))
    spaces = {"wspace": 0.06, "hspace": 0.25}
    axes = np.atleast_2d(figure.subplots(len(recordings), 3, sharex=True, sharey=True, gridspec_kw=spaces))
    bins = np.linspace(0.0, 1.0, 26)
    for row, recording in zip(axes, recordings, strict=True):
        for name, axis, frame in zip("abc", row, telling_frames(recording), strict=True):
            step = recording.frame_steps[frame]
            atoms = recording.atoms[step].clip(0.0, 1.0)
            risk, uncertainty = recording.risk[step], recording.uncertainty[step]
            axis.hist(atoms, bins, weights=np.full(atoms.size, 1.0 / atoms.size), color=raster.UNCERTAINTY)
            axis.axvline(risk, color=raster.RISK, linewidth=1.8)
            title = f"{name}: t = {recording.times[step]:.1f} s, R = {two_digits(risk)}, U = {uncertainty:.3f}"
            axis.set_title(title, fontsize=9, loc="left")
            _tidy(axis)
        row[0].set_ylabel(f"{recording.label}\nshare of atoms [1]")
    for axis in axes[-1]:
        axis.set_xlabel("collision possibility C [1]")
    _set_margins(figure, left=0.85)
    return _png(figure)


def layout_figure(config: ScenarioConfig) -> bytes:
    """Return where object, robot, obstacles and goal may be, to scale.

    Args:
        config: Layout.

    Returns:
        Content of a PNG file.
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
        _write(axis, text, ((left + right) / 2, high), up=3, fontsize=9)
    (left, right), jitter = config.obstacle_x, config.adversarial_jitter
    strip = np.array([[left, -jitter], [right, -jitter], [right, jitter], [left, jitter]])
    _outline(axis, strip, raster.INK, linewidth=1.2, linestyle=":")
    _write(axis, "adversarial: on the line from object to goal", strip[:2].mean(0), up=-12, fontsize=9)
    _draw_sizes(axis, config)
    _frame_world(axis)
    axis.set_ylabel("y [m]")
    _set_margins(figure, top=0.15)
    return _png(figure)


def _draw_sizes(axis: Any, config: ScenarioConfig) -> None:
    """Draw robot and largest object at their start, and an obstacle of each size."""
    edge = max(config.object_edges)
    hand = -edge / 2 - float(np.mean(config.start_gap))
    base = (hand - HOME_TCP[0], 0.0, 0.0)
    _draw_robot(axis, base, (hand, 0.0))
    axis.add_patch(Polygon(rectangle_corners((0.0, 0.0, 0.0), edge, edge), facecolor=raster.OBJECT))
    _write(axis, "robot", base[:2], up=-24, fontsize=9)
    for number, size in enumerate(config.obstacle_edges):
        place = (config.obstacle_x[0] + 1.2 + 1.6 * number, config.obstacle_y[0] + 0.9, 0.4 * number)
        axis.add_patch(Polygon(rectangle_corners(place, size, size), facecolor=raster.OBSTACLE))
        _write(axis, f"{size:g} m", (place[0], place[1] + 0.75 * size), fontsize=8)


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
            _tidy(axis)
        pair[1].tick_params(labelleft=False)
        pair[1].xaxis.set_major_locator(MaxNLocator(3))
        pair[0].set_title(label, fontsize=10, loc="left")
        pair[1].set_title("in this demo", fontsize=9, loc="left")
    for pair in grid[1].reshape(2, 2):
        pair[0].set_xlabel("environment steps [million]")
        pair[1].set_xlabel("steps [thousand]")
    _set_margins(figure)
    return _png(figure)


def telling_frames(recording: Recording) -> list[int]:
    """Return three frames: the first obstacle's appearance, the highest uncertainty, and the end.

    Args:
        recording: What was played.

    Returns:
        Indices into ``frame_steps``, in order of time; the highest uncertainty is looked for between the other two and
        some way from both, so that three different moments are shown wherever there is room for them.
    """
    last = len(recording.frame_steps) - 1
    times = recording.times[recording.frame_steps]
    end = min(int(np.searchsorted(times, recording.end_time)), last)
    appeared = recording.appearances[np.isfinite(recording.appearances)]
    first = min(int(np.searchsorted(times, appeared.min())), end) if appeared.size else 0
    low, high = int(np.searchsorted(times, times[first] + _APART)), int(np.searchsorted(times, times[end] - _APART))
    if low > high:
        return [first, (first + end) // 2, end]
    between = recording.uncertainty[recording.frame_steps[low : high + 1]]
    return [first, low + int(between.argmax()), end]


def _draw_paths(axis: Any, recording: Recording) -> None:
    goal, edge = recording.scene.goal_pose, recording.scene.object_edge
    axis.add_patch(Circle(goal[:2], recording.success_radius, facecolor="none", edgecolor=raster.GOAL, linewidth=1.4))
    _outline(axis, rectangle_corners(goal, edge, edge), raster.GOAL, linewidth=1.4)
    for obstacle, appeared in zip(recording.obstacles[-1], recording.appearances, strict=True):
        if np.isfinite(appeared):
            corners = rectangle_corners(obstacle, obstacle[3], obstacle[3])
            axis.add_patch(Polygon(corners, facecolor=raster.OBSTACLE, linewidth=0))
            place = obstacle[0], corners[:, 1].max()
            label = _write(axis, f"{appeared:.1f} s", place, fontsize=8)
            label.set_path_effects([withStroke(linewidth=2.0, foreground="white")])
    every = round(_POSE_TIME / recording.period)
    for step in range(0, len(recording.times), every):
        robot = rectangle_corners(recording.base_pose[step], *CHASSIS_SIZE)
        box = rectangle_corners(recording.object_pose[step], edge, edge)
        _outline(axis, robot, raster.ROBOT, alpha=0.35, linewidth=0.8)
        _outline(axis, box, raster.OBJECT, alpha=0.35, linewidth=0.8)
    axis.plot(*recording.base_pose[:, :2].T, color=raster.ROBOT, linewidth=2.0)
    axis.plot(*recording.object_pose[:, :2].T, color=raster.OBJECT, linewidth=2.0, linestyle=(0, (4, 1)))
    axis.plot(*recording.object_pose[0, :2], "o", color=raster.OBJECT, markerfacecolor="white", markersize=5)
    _draw_robot(axis, recording.base_pose[-1], recording.tcp[-1] if recording.has_arm else None)
    axis.add_patch(Polygon(rectangle_corners(recording.object_pose[-1], edge, edge), facecolor=raster.OBJECT))
    if recording.outcome == "collision":
        bodies = (recording.base_pose, recording.tcp, recording.object_pose)
        struck = next(body for body, touched in zip(bodies, recording.episode.contact, strict=True) if touched)
        axis.plot(*struck[-1, :2], "X", color=raster.FAILURE, markeredgecolor="white", markersize=11)
    _frame_world(axis)


def _draw_robot(axis: Any, base: Any, tcp: Any) -> None:
    axis.add_patch(Polygon(rectangle_corners(base, *CHASSIS_SIZE), facecolor=raster.ROBOT))
    if tcp is not None:
        axis.plot([base[0], tcp[0]], [base[1], tcp[1]], color=raster.ARM, linewidth=3.0, solid_capstyle="round")


def _draw_maps(axes: Sequence[Any], recording: Recording, frames: Sequence[int], *, channel: int) -> None:
    extent = recording.maps.shape[-1] * recording.resolution / 2
    colours = raster.CONFIDENCE_COLOURS if channel == 0 else raster.OCCUPANCY_COLOURS
    for name, axis, frame in zip("abc", axes, frames, strict=True):
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
        _outline(axis, rectangle_corners((0.0, 0.0, 0.0), *CHASSIS_SIZE), raster.ROBOT, linewidth=1.6)
        _outline(axis, rectangle_corners(recording.object_in_base(step), edge, edge), raster.OBJECT, linewidth=1.6)
        quantity = "confidence" if channel == 0 else "occupancy"
        axis.set_title(f"{name}: {quantity}, {recording.times[step]:.1f} s", fontsize=8, loc="left")
        axis.tick_params(labelsize=8)
        axis.set(xticks=_MAP_TICKS, yticks=_MAP_TICKS)
        axis.tick_params(labelleft=axis is axes[0])
        if channel != 0:
            axis.set_xlabel("ahead of the base [m]", fontsize=8)
    axes[0].set_ylabel("left of the base [m]", fontsize=8)


def _outline(axis: Any, corners: NDArray[np.float64], colour: str, **options: Any) -> None:
    axis.add_patch(Polygon(corners, facecolor="none", edgecolor=colour, **options))


def _write(axis: Any, text: str, place: Any, *, up: float = 2.0, **options: Any) -> Any:
    # Above the place by so many points.
    return axis.annotate(text, place, (0, up), textcoords="offset points", ha="center", **options)


def _frame_world(axis: Any) -> None:
    axis.set(xlim=_WORLD_X, ylim=_WORLD_Y, aspect="equal", xlabel="x [m]")
    axis.set_xticks(range(-2, 17, 2))
    _tidy(axis)


def _tidy(axis: Any) -> None:
    axis.grid(color=raster.GRID, linewidth=0.6)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.tick_params(labelsize=9)


def _set_margins(figure: Figure, *, left: float = 0.6, right: float = 0.15, top: float = 0.35) -> None:
    """Set the margins [inch]; matplotlib's automatic layout takes longer than all the rest of a figure."""
    width, height = figure.get_size_inches()
    figure.subplots_adjust(left / width, 0.55 / height, 1 - right / width, 1 - top / height)


def _png(figure: Figure) -> bytes:
    # A palette of 256 colours makes a third of the size.
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png", dpi=_DOTS, facecolor="white")
    image = Image.open(drawn).convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    packed = io.BytesIO()
    image.save(packed, "PNG", optimize=True)
    return packed.getvalue()
