"""Still pictures of what a robot expects and knows: the DCE's distribution, and an obstacle where all was free."""

from __future__ import annotations

from string import ascii_lowercase
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.axes import encode, set_margins, tidy
from cura_torchrl.trainers.pictures.moments import Appearance, find_appearance, frames_at
from cura_torchrl.trainers.pictures.raster import rectangle_corners, three_digits
from cura_torchrl.trainers.pictures.scene_axes import draw_map, draw_scan, outline, place_in_base

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cura_torchrl.trainers.pictures.recording import Recording
    from cura_torchrl.trainers.pictures.render_config import StillFormat


_LATER = 2.0
"""Time after the appearance at which it is shown once more [s]."""


def distribution_figure(
    recordings: Sequence[Recording], *, times: Sequence[float] = (), kind: StillFormat = "png"
) -> bytes:
    """Return the DCE's predicted distribution at some moments of each recording, and R and U over time.

    Args:
        recordings: What to show, at least one.
        times: The moments [s]; none takes three telling ones.
        kind: Format of the file.

    Returns:
        Content of the file.
    """
    count, rows = len(times) or 3, len(recordings)
    figure = Figure(figsize=(3.0 * count + 4.2, 0.8 + 2.3 * rows))
    grid = figure.add_gridspec(rows, count + 1, width_ratios=[1.0] * count + [1.5], wspace=0.28, hspace=0.34)
    shared = None
    for row, recording in enumerate(recordings):
        frames = frames_at(recording, times)
        axes = [figure.add_subplot(grid[row, column], sharey=shared) for column in range(count)]
        shared = axes[0]
        for name, axis, frame in zip(ascii_lowercase, axes, frames, strict=False):
            _draw_atoms(axis, recording, int(recording.frame_steps[frame]), name)
            axis.tick_params(labelleft=axis is axes[0])
            if row == rows - 1:
                axis.set_xlabel("collision possibility C [1]")
        axes[0].set_ylabel(f"{recording.label}\nshare of atoms [1]")
        pair = grid[row, count].subgridspec(2, 1, hspace=0.3)
        curves = [figure.add_subplot(pair[part, 0]) for part in (0, 1)]
        _draw_curves(curves, recordings, row, frames)
        if row == rows - 1:
            curves[1].set_xlabel("time [s]")
    set_margins(figure, left=0.85)
    return encode(figure, kind)


def _draw_atoms(axis: Any, recording: Recording, step: int, name: str) -> None:
    atoms = recording.atoms[step].clip(0.0, 1.0)
    risk, uncertainty = recording.risk[step], recording.uncertainty[step]
    axis.hist(atoms, np.linspace(0.0, 1.0, 26), weights=np.full(atoms.size, 1.0 / atoms.size), color=raster.UNCERTAINTY)
    axis.axvline(risk, color=raster.RISK, linewidth=1.8)
    title = f"{name}: t = {recording.times[step]:.1f} s, R = {three_digits(risk)}, U = {three_digits(uncertainty)}"
    axis.set_title(title, fontsize=9, loc="left")
    axis.set_xlim(0.0, 1.0)
    tidy(axis)


def _draw_curves(axes: Sequence[Any], recordings: Sequence[Recording], row: int, frames: Sequence[int]) -> None:
    # The scales are those of all recordings, so that what looks small is small.
    recording = recordings[row]
    marks = recording.times[recording.frame_steps[np.asarray(frames)]]
    end = max(float(each.times[-1]) for each in recordings)
    for axis, name, label, colour in (
        (axes[0], "risk", "R [1]", raster.RISK),
        (axes[1], "uncertainty", "U [1]", raster.UNCERTAINTY),
    ):
        axis.plot(recording.times, getattr(recording, name), color=colour, linewidth=1.3)
        known = np.concatenate([getattr(each, name) for each in recordings])
        axis.set_ylim(min(0.0, 1.1 * float(known.min())), max(1.1 * float(known.max()), 1e-3))
        for mark in marks:
            axis.axvline(mark, color=raster.FAINT, linewidth=0.8, linestyle=":")
        axis.set_ylabel(label)
        axis.yaxis.set_label_coords(-0.16, 0.5)
        axis.set_xlim(0.0, end)
        tidy(axis)
    axes[0].tick_params(labelbottom=False)
    for mark, name in zip(marks, ascii_lowercase, strict=False):
        axes[0].annotate(
            name,
            (mark, 1.0),
            (0, 2),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            fontsize=9,
        )


def appearance_figure(recordings: Sequence[Recording], *, kind: StillFormat = "png") -> bytes:
    """Return how an obstacle appeared where the map, if it can, had shown free ground: four moments of each recording.

    Args:
        recordings: What to show, at least one.
        kind: Format of the file.

    Returns:
        Content of the file.
    """
    rows = len(recordings)
    figure = Figure(figsize=(10.6, 0.9 + 3.25 * rows))
    set_margins(figure, top=0.7, bottom=0.9)
    grid = figure.add_gridspec(rows, 4, wspace=0.08, hspace=0.5)
    for row, recording in enumerate(recordings):
        axes = [figure.add_subplot(grid[row, column]) for column in range(4)]
        appearance = find_appearance(recording)
        if appearance is None:
            for axis in axes:
                axis.set_axis_off()
            axes[0].set_title(f"{recording.label}: no obstacle appeared after the start", loc="left", fontsize=10)
            continue
        heading = (
            f"{recording.label}: obstacle after {appearance.time:.1f} s; {appearance.seen_free:.0%} of its place had"
            f" been seen free, mean confidence {appearance.confidence:.2f}"
        )
        axes[0].annotate(
            heading, (0.0, 1.0), (0, 20), xycoords="axes fraction", textcoords="offset points", fontsize=10
        )
        for axis, (title, frame) in zip(axes, _moments(recording, appearance), strict=True):
            _draw_snapshot(axis, recording, appearance, frame)
            time = recording.times[recording.frame_steps[frame]]
            axis.set_title(f"{time:.1f} s: {title}", fontsize=9, loc="left")
            axis.set_xlabel("ahead of the base [m]", fontsize=8)
            axis.tick_params(labelleft=axis is axes[0])
        axes[0].set_ylabel("left of the base [m]", fontsize=8)
    _add_legend(figure)
    return encode(figure, kind)


def _moments(recording: Recording, appearance: Appearance) -> list[tuple[str, int]]:
    seen, appeared = appearance.first_seen, appearance.appeared
    last = len(recording.frame_steps) - 1
    times = recording.times[recording.frame_steps]
    later = min(int(np.searchsorted(times, times[appeared] + _LATER - 1e-6)), last)
    is_at_once = seen == appeared
    third = ("a little later", later) if seen is None or is_at_once else ("first ray on it", seen)
    return [
        ("before", appearance.before),
        ("it appears, in sight" if is_at_once else "it appears, unseen", appeared),
        third,
        ("least clearance" if seen is not None else "least clearance, still unseen", appearance.nearest),
    ]


def _draw_snapshot(axis: Any, recording: Recording, appearance: Appearance, frame: int) -> None:
    draw_map(axis, recording, frame, channel=0)
    draw_scan(axis, recording, frame)
    step = int(recording.frame_steps[frame])
    for slot, obstacle in enumerate(recording.obstacles[-1]):
        edge, is_there = float(obstacle[3]), recording.obstacles[step, slot, 3] > 0
        if edge == 0.0 or not (is_there or slot == appearance.slot):
            continue
        place = place_in_base(recording, step, obstacle)
        if slot == appearance.slot and max(abs(place[0]), abs(place[1])) > axis.get_xlim()[1]:
            text = f"the obstacle is {place[0]:.1f} m ahead,\noutside of the window"
            axis.text(0.03, 0.03, text, transform=axis.transAxes, fontsize=8, color=raster.RISK, fontweight="bold")
            continue
        corners = rectangle_corners(place, edge, edge)
        colour = raster.RISK if slot == appearance.slot else raster.OBSTACLE
        if is_there:
            axis.add_patch(Polygon(corners, facecolor=colour, edgecolor="white", linewidth=0.8))
        else:
            outline(axis, corners, colour, linewidth=1.6, linestyle="--")


def _add_legend(figure: Figure) -> None:
    light, dark = raster.CONFIDENCE_COLOURS[255] / 255.0, raster.CONFIDENCE_COLOURS[0] / 255.0
    entries: list[Any] = [
        Patch(facecolor="none", edgecolor=raster.RISK, linestyle="--", label="where it will appear"),
        Patch(facecolor=raster.RISK, label="the obstacle"),
        Patch(facecolor=raster.OBSTACLE, label="other obstacles"),
        Line2D([], [], linestyle="none", marker=".", color=raster.HIT, label="end of a ray"),
        Patch(facecolor="none", edgecolor=raster.ROBOT, label="robot"),
        Patch(facecolor="none", edgecolor=raster.OBJECT, label="object"),
        Patch(facecolor=light, edgecolor=raster.FAINT, label="confidence 1 (seen now)"),
        Patch(facecolor=dark, label="0 (not seen)"),
    ]
    figure.legend(handles=entries, loc="lower center", ncols=4, fontsize=8, frameon=False)
