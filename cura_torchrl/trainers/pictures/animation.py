"""Animations of recordings: the scene from above, the map, and what the collision estimator predicts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw

from cura_torchrl.envs.robots.ridgeback import CHASSIS_SIZE
from cura_torchrl.envs.sensors.lidar import ray_angles
from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.raster import SCALE, SCENE_X, SCENE_Y, Axis, Panel, font, rectangle_corners
from cura_torchrl.trainers.pictures.recording import Recording

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

COLUMN_WIDTH, FRAME_HEIGHT = 480, 744
"""Width of a recording's column and height of a frame [pixel]."""
_LEFT = 44
"""Where plot areas begin in a column [pixel]."""
FLASH_TIME = 1.5
"""Time for which an obstacle that has just appeared is marked [s]."""
_PATH_WIDTH, _HIT_RADIUS = 0.09, 0.045
"""How wide paths are drawn, and how large the ends of rays [m]."""
_OUTCOME_COLOUR = {"success": raster.ROBOT, "collision": raster.FAILURE, "time-out": "#8a6100"}


@dataclass(frozen=True)
class _Column:
    """Panels of one recording, and what they hold in every frame."""

    recording: Recording
    scene: Panel
    confidence: Panel
    occupancy: Panel
    atoms: Panel
    risk: Panel
    uncertainty: Panel
    curves: tuple[Image.Image, Image.Image]


def animation_frames(recordings: Sequence[Recording], *, every: int = 1) -> list[Image.Image]:
    """Return frames that show recordings of the same scene side by side.

    A recording that is over keeps its last state, and the last state is shown in any case.

    Args:
        recordings: What to show, at least one.
        every: Every how many of the recordings' scans and maps are shown [1].

    Returns:
        Frames of the size (``COLUMN_WIDTH`` times their number, ``FRAME_HEIGHT``) [pixel].
    """
    columns, background = _layout(recordings)
    return [raster.finish(_frame(columns, background, number)) for number in frame_numbers(recordings, every)]


def frame_numbers(recordings: Sequence[Recording], every: int) -> list[int]:
    """Return which frames of the longest recording are shown.

    Args:
        recordings: What to show, at least one.
        every: Every how many of them [1].

    Returns:
        Indices, the last one among them.
    """
    last = max(len(recording.frame_steps) for recording in recordings) - 1
    return [*range(0, last, every), last]


def scene_panel(column: int) -> Panel:
    """Return the panel that shows the scene from above, world frame.

    Args:
        column: Index of the recording in the frame [1].

    Returns:
        The panel, which tells where a point of the world is drawn.
    """
    return Panel(column * COLUMN_WIDTH + _LEFT, 56, width=420, height=210, x=SCENE_X, y=SCENE_Y)


def map_image(values: NDArray[np.uint8], colours: NDArray[np.uint8], size: int) -> Image.Image:
    """Return a window of the map as a picture: ahead of the robot is right, its left is up.

    Args:
        values: One channel of the window [1/255], row along the base's x, column along its y, shape ``[W, W]``.
        colours: Colour of each value, shape ``[256, 3]``.
        size: Edge of the picture [pixel].

    Returns:
        The picture.
    """
    turned = np.ascontiguousarray(colours[values.T[::-1]])
    return Image.fromarray(turned).resize((size, size), Image.Resampling.NEAREST)


def _layout(recordings: Sequence[Recording]) -> tuple[list[_Column], Image.Image]:
    """Return the columns, and a frame with all that does not change."""
    background = Image.new("RGB", (COLUMN_WIDTH * len(recordings) * SCALE, FRAME_HEIGHT * SCALE), raster.PAPER)
    last = max(float(recording.times[-1]) for recording in recordings)
    most_risk = _ceiling(max(float(recording.risk.max()) for recording in recordings), least=0.2)
    most_uncertainty = _ceiling(max(float(recording.uncertainty.max()) for recording in recordings), least=0.02)
    columns = []
    for index, recording in enumerate(recordings):
        column = _column(recording, index * COLUMN_WIDTH, last, (most_risk, most_uncertainty))
        columns.append(column)
        column.scene.decorate(background, "Scene from above, world frame")
        column.confidence.decorate(background, "Confidence M: light = seen")
        column.occupancy.decorate(background, "Occupancy O: dark = occupied")
        column.atoms.decorate(background, f"Collision estimate: {recording.atoms.shape[1]} atoms")
        for panel, name, values, moment, meaning in (
            (column.risk, "Risk R", recording.risk, recording.atoms.mean(1), "mean"),
            (column.uncertainty, "Uncertainty U", recording.uncertainty, recording.atoms.var(1), "variance"),
        ):
            # Methods beyond the paper are charged for others.
            panel.decorate(background, f"{name} = {meaning}" if np.allclose(values, moment, atol=1e-5) else name)
        place = (index * COLUMN_WIDTH + _LEFT) * SCALE, 18 * SCALE
        draw = ImageDraw.Draw(background)
        draw.text(place, recording.label, fill=raster.INK, font=font(15, bold=True), anchor="ls")
    draw_legend(background, FRAME_HEIGHT - 12)
    return columns, background


def _column(recording: Recording, left: int, last: float, most: tuple[float, float]) -> _Column:
    window = recording.maps.shape[-1] * recording.resolution / 2
    ahead = Axis(-window, window, (-4, -2, 0, 2, 4), "ahead of the base [m] \N{RIGHTWARDS ARROW} forward")
    aside = Axis(-window, window, (-4, -2, 0, 2, 4), "left of the base [m]")
    unlabelled = Axis(-window, window, (-4, -2, 0, 2, 4))
    seconds = tuple(float(value) for value in range(0, int(last) + 1, 10))
    time, bare_time = Axis(0.0, last, seconds, "time [s]"), Axis(0.0, last, seconds)
    num_atoms = recording.atoms.shape[1]
    number = Axis(0.5, num_atoms + 0.5, (1, num_atoms // 2, num_atoms), "atom, in order of size")
    chance = Axis(0.0, 1.0, (0.0, 0.25, 0.5, 0.75, 1.0), "C [1]")
    risk_axis = Axis(0.0, most[0], (0.0, most[0] / 2, most[0]), "R [1]")
    uncertainty_axis = Axis(0.0, most[1], (0.0, most[1] / 2, most[1]), "U [1]")
    risk = Panel(left + 264, 567, width=200, height=48, x=bare_time, y=risk_axis)
    uncertainty = Panel(left + 264, 636, width=200, height=48, x=time, y=uncertainty_axis)
    return _Column(
        recording=recording,
        scene=scene_panel(left // COLUMN_WIDTH),
        confidence=Panel(left + _LEFT, 320, width=200, height=200, x=ahead, y=aside),
        occupancy=Panel(left + 264, 320, width=200, height=200, x=ahead, y=unlabelled),
        atoms=Panel(left + _LEFT, 567, width=150, height=117, x=number, y=chance),
        risk=risk,
        uncertainty=uncertainty,
        curves=(
            _curve(risk, recording.times, recording.risk, raster.RISK),
            _curve(uncertainty, recording.times, recording.uncertainty, raster.UNCERTAINTY),
        ),
    )


def _ceiling(value: float, *, least: float) -> float:
    """Return the smallest of 1, 2, 5, 10, ... times ``least`` that is not below ``value``."""
    top = least
    for factor in (2.0, 2.5, 2.0) * 4:
        if top >= value:
            break
        top *= factor
    return top


def _curve(panel: Panel, times: NDArray[np.floating], values: NDArray[np.floating], colour: str) -> Image.Image:
    image = panel.blank()
    points = panel.pixels(np.stack([times, values], -1))
    ImageDraw.Draw(image).line(points, fill=colour, width=3, joint="curve")
    return image


def draw_legend(frame: Image.Image, row: int) -> None:
    """Write what the colours stand for, in two lines where one is too long.

    Args:
        frame: Frame of the drawn size; changed in place.
        row: Middle of the last line [pixel].
    """
    entries = (
        (raster.ROBOT, "robot and its path"),
        (raster.OBJECT, "object and its path"),
        (raster.OBSTACLE, "obstacle"),
        (raster.GOAL, "goal"),
        (raster.RAY, "seen by the LiDAR"),
        (raster.HIT, "where a ray ends"),
    )
    widths = [round((26 + font(10).getlength(text) / SCALE) * SCALE) for _, text in entries]
    is_long = _LEFT * SCALE + sum(widths) > frame.width
    lines = (entries[:3], entries[3:]) if is_long else (entries,)
    for number, line in enumerate(reversed(lines)):
        _draw_entries(ImageDraw.Draw(frame), line, row - 15 * number)


def _draw_entries(draw: ImageDraw.ImageDraw, entries: Sequence[tuple[str, str]], row: int) -> None:
    x, y = _LEFT * SCALE, row * SCALE
    for colour, text in entries:
        draw.rectangle([x, y - 5 * SCALE, x + 10 * SCALE, y + 5 * SCALE], fill=colour, outline=raster.FAINT)
        draw.text((x + 14 * SCALE, y), text, fill=raster.INK, font=font(10), anchor="lm")
        x += round((26 + font(10).getlength(text) / SCALE) * SCALE)


def _frame(columns: Sequence[_Column], background: Image.Image, number: int) -> Image.Image:
    frame = background.copy()
    for column in columns:
        index = min(number, len(column.recording.frame_steps) - 1)
        right = column.scene.left + column.scene.width
        draw_status(frame, column.recording, _step(column, index), (right, 18))
        column.scene.paste(frame, _draw_scene(column, index))
        column.confidence.paste(frame, _draw_map(column, column.confidence, index, raster.CONFIDENCE_COLOURS))
        column.occupancy.paste(frame, _draw_map(column, column.occupancy, index, raster.OCCUPANCY_COLOURS))
        column.atoms.paste(frame, _draw_atoms(column, index))
        for panel, curve in zip((column.risk, column.uncertainty), column.curves, strict=True):
            panel.paste(frame, _draw_cursor(panel, curve, float(column.recording.times[_step(column, index)])))
        _draw_numbers(frame, column, index)
    return frame


def _step(column: _Column, index: int) -> int:
    return int(column.recording.frame_steps[index])


def draw_status(frame: Image.Image, recording: Recording, step: int, place: tuple[int, int]) -> None:
    """Write the time, or, from the end on, how the episode ended.

    Args:
        frame: Frame of the drawn size; changed in place.
        recording: What was played.
        step: Index of the state [1].
        place: Right end of the line's foot [pixel].
    """
    time = float(recording.times[step])
    is_known = time >= recording.end_time - 1e-6
    text = recording.describe() if is_known else f"{time:.1f} s"
    colour = _OUTCOME_COLOUR[recording.outcome] if is_known else raster.INK
    where = place[0] * SCALE, place[1] * SCALE
    ImageDraw.Draw(frame).text(where, text, fill=colour, font=font(12, bold=is_known), anchor="rs")


def draw_floor(panel: Panel, recording: Recording, index: int) -> Image.Image:
    """Draw what lies on the floor: what the LiDAR sees, where its rays end, the goal and both paths.

    Args:
        panel: Where points of the world are drawn.
        recording: What was played.
        index: Index of the frame [1].

    Returns:
        Image of the plot area, drawn size.
    """
    image, step = panel.blank(), int(recording.frame_steps[index])
    draw = ImageDraw.Draw(image)
    base, angles = recording.base_pose[step], ray_angles(recording.scans.shape[1]).numpy()
    bearing = angles + base[2]
    scan = recording.scans[index]
    ends = base[:2] + scan[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    points = panel.pixels(ends)
    draw.polygon(points, fill=raster.RAY)
    (origin,) = panel.pixels(base[None, :2])
    for point in points[::8]:
        draw.line([origin, point], fill="#c3dff0", width=_pixels(panel, 0.02))
    _draw_goal(draw, panel, recording)
    radius = panel.length(_HIT_RADIUS)
    for point, distance in zip(points, scan.tolist(), strict=True):
        if distance < 0.995 * scan.max():
            draw.ellipse([point[0] - radius, point[1] - radius, point[0] + radius, point[1] + radius], fill=raster.HIT)
    for path, colour in ((recording.base_pose, raster.ROBOT), (recording.object_pose, raster.OBJECT)):
        if step > 0:
            line = panel.pixels(path[: step + 1, :2])
            draw.line(line, fill=colour, width=_pixels(panel, _PATH_WIDTH), joint="curve")
    return image


def _pixels(panel: Panel, length: float) -> int:
    return max(1, round(panel.length(length)))


def _draw_scene(column: _Column, index: int) -> Image.Image:
    recording, step = column.recording, _step(column, index)
    image = draw_floor(column.scene, recording, index)
    draw = ImageDraw.Draw(image)
    _draw_obstacles(draw, column.scene, recording, step)
    _draw_bodies(draw, column.scene, recording, step)
    return image


def _draw_goal(draw: ImageDraw.ImageDraw, panel: Panel, recording: Recording) -> None:
    edge = recording.scene.object_edge
    ((x, y),) = panel.pixels(np.array([recording.scene.goal_pose[:2]]))
    radius = panel.length(recording.success_radius)
    width = _pixels(panel, 0.066)
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], outline=raster.GOAL, width=width)
    corners = panel.pixels(rectangle_corners(recording.scene.goal_pose, edge, edge))
    draw.line([*corners, corners[0]], fill=raster.GOAL, width=width)


def _draw_obstacles(draw: ImageDraw.ImageDraw, panel: Panel, recording: Recording, step: int) -> None:
    now = float(recording.times[step])
    for obstacle, appeared in zip(recording.obstacles[step], recording.appearances, strict=True):
        edge = float(obstacle[3])
        if edge == 0.0:
            continue
        draw.polygon(panel.pixels(rectangle_corners(obstacle, edge, edge)), fill=raster.OBSTACLE)
        if now - appeared <= FLASH_TIME and appeared > 0.0:
            ((x, y),) = panel.pixels(obstacle[None, :2])
            radius = panel.length(0.9 * edge + 0.1)
            draw.ellipse([x - radius, y - radius, x + radius, y + radius], outline=raster.RISK, width=4)


def _draw_bodies(draw: ImageDraw.ImageDraw, panel: Panel, recording: Recording, step: int) -> None:
    edge, base = recording.scene.object_edge, recording.base_pose[step]
    draw.polygon(panel.pixels(rectangle_corners(recording.object_pose[step], edge, edge)), fill=raster.OBJECT)
    draw.polygon(panel.pixels(rectangle_corners(base, *CHASSIS_SIZE)), fill=raster.ROBOT)
    if recording.has_arm:
        arm = panel.pixels(np.stack([base[:2], recording.tcp[step]]))
        draw.line(arm, fill=raster.ARM, width=6)
        x, y = arm[1]
        draw.ellipse([x - 4, y - 4, x + 4, y + 4], fill=raster.ARM)


def _draw_map(column: _Column, panel: Panel, index: int, colours: NDArray[np.uint8]) -> Image.Image:
    recording, step = column.recording, _step(column, index)
    channel = 0 if panel is column.confidence else -1
    image = map_image(recording.maps[index, channel], colours, panel.width * SCALE)
    draw = ImageDraw.Draw(image)
    edge, pose = recording.scene.object_edge, recording.object_in_base(step)
    draw.polygon(panel.pixels(rectangle_corners((0.0, 0.0, 0.0), *CHASSIS_SIZE)), outline=raster.ROBOT, width=4)
    draw.polygon(panel.pixels(rectangle_corners(pose, edge, edge)), outline=raster.OBJECT, width=4)
    return image


def _draw_atoms(column: _Column, index: int) -> Image.Image:
    recording, panel, step = column.recording, column.atoms, _step(column, index)
    image = panel.blank()
    draw = ImageDraw.Draw(image)
    for number, atom in enumerate(np.sort(recording.atoms[step]).clip(0.0, 1.0).tolist(), start=1):
        (x0, y0), (x1, y1) = panel.pixels(np.array([[number - 0.4, atom], [number + 0.4, 0.0]]))
        draw.rectangle([x0, y0, x1, y1], fill=raster.UNCERTAINTY)
    risk = float(recording.risk[step])
    mean = panel.pixels(np.array([[panel.x.low, risk], [panel.x.high, risk]]))
    draw.line(mean, fill=raster.RISK, width=3)
    return image


def _draw_numbers(frame: Image.Image, column: _Column, index: int) -> None:
    step, draw = _step(column, index), ImageDraw.Draw(frame)
    for panel, text, colour in (
        (column.risk, raster.three_digits(column.recording.risk[step]), raster.RISK),
        (column.uncertainty, raster.three_digits(column.recording.uncertainty[step]), raster.UNCERTAINTY),
    ):
        place = (panel.left + panel.width) * SCALE, (panel.top - 4) * SCALE
        draw.text(place, text, fill=colour, font=font(11, bold=True), anchor="rs")


def _draw_cursor(panel: Panel, curve: Image.Image, time: float) -> Image.Image:
    """Return the curve up to now; what is to come is pale."""
    image = curve.copy()
    ((column, _),) = panel.pixels(np.array([[time, panel.y.high]]))
    left = min(round(column), image.width - 2)
    rest = image.crop((left, 0, image.width, image.height))
    image.paste(Image.blend(rest, Image.new("RGB", rest.size, raster.PAPER), 0.75), (left, 0))
    ImageDraw.Draw(image).line([(left, 0), (left, image.height)], fill=raster.INK, width=2)
    return image
