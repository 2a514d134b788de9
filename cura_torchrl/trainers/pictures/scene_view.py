"""Animations of recordings in 3-D: bodies as the renderer draws them, what lies on the floor beneath them."""

from __future__ import annotations

from contextlib import ExitStack, closing
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageColor, ImageDraw

from cura_torchrl.envs.robots import ridgeback, ridgeback_franka
from cura_torchrl.envs.simulation.camera import Camera, View
from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.animation import (
    FLASH_TIME,
    draw_floor,
    draw_legend,
    draw_status,
    frame_numbers,
)
from cura_torchrl.trainers.pictures.raster import SCALE, SCENE_X, SCENE_Y, Panel, font

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from cura_torchrl.trainers.pictures.recording import Recording

HEADER, FOOTER = 44, 38
"""Height of what is written above and below the pictures [pixel]."""
_EYE, _TARGET = (-3.6, -2.2, 3.4), (2.1, 0.2, 0.3)
"""Camera and what it looks at, from the base, world frame [m]: from behind, the right and above."""
_FLOOR_SCALE = 55
"""Pixels of the floor's drawing along a metre [pixel/m]."""
_FIELD_OF_VIEW = 42.0
"""Vertical angle that is seen [deg]."""
_SKY, _OUTSIDE = "#c9d6e2", "#e6e9ec"
"""Colours above the horizon, and of the floor outside of the scene."""


def scene_frames(recordings: Sequence[Recording], *, size: tuple[int, int], every: int = 1) -> Iterator[Image.Image]:
    """Yield frames that show recordings of the same scene side by side, from a camera that follows the base.

    A recording that is over keeps its last state, and the last state is shown in any case.

    Args:
        recordings: What to show, at least one.
        size: Width and height of one recording's picture [pixel].
        every: Every how many of the recordings' scans are shown [1].

    Yields:
        Frames, each wide enough for all pictures, with a line above and below.
    """
    with ExitStack() as stack:
        cameras = [stack.enter_context(closing(make_camera(recording, size))) for recording in recordings]
        for number in frame_numbers(recordings, every):
            yield _frame(recordings, cameras, number)


def make_camera(recording: Recording, size: tuple[int, int]) -> Camera:
    """Return a camera on a recording's robot, object and obstacles.

    Args:
        recording: What was played.
        size: Width and height of its pictures [pixel].

    Returns:
        The camera, to be closed.
    """
    return Camera(
        (ridgeback_franka if recording.has_arm else ridgeback).URDF,
        object_edge=recording.scene.object_edge,
        obstacle_edges=recording.obstacles[-1, :, 3].tolist(),
        size=size,
        colours=(_rgb(raster.ROBOT), _rgb(raster.OBJECT)),
    )


def draw_scene(camera: Camera, recording: Recording, index: int) -> Image.Image:
    """Return one picture.

    Args:
        camera: The recording's camera.
        recording: What was played.
        index: Index of the frame [1].

    Returns:
        The picture, of the camera's size.
    """
    step = int(recording.frame_steps[index])
    base = recording.base_pose[step]
    camera.place_robot([*base.tolist(), *recording.arm_joints[step].tolist()])
    camera.place_object(recording.object_position[step].tolist(), recording.object_quaternion[step].tolist())
    camera.place_obstacles(recording.obstacles[step, :, :3], _obstacle_colours(recording, step))
    colours, is_body = camera.look(_view(base))
    picture = _draw_ground(camera, recording, index)
    picture.paste(Image.fromarray(colours), (0, 0), Image.fromarray(is_body.astype(np.uint8) * 255))
    return picture


def _view(base: NDArray[np.float32]) -> View:
    # The camera does not turn with the base: the goal always lies ahead, and the picture stays calm.
    x, y = float(base[0]), float(base[1])
    eye, target = (x + _EYE[0], y + _EYE[1], _EYE[2]), (x + _TARGET[0], y + _TARGET[1], _TARGET[2])
    return View(eye=eye, target=target, field_of_view=_FIELD_OF_VIEW)


def _obstacle_colours(recording: Recording, step: int) -> list[tuple[int, int, int] | None]:
    now = float(recording.times[step])
    return [
        None
        if edge == 0.0
        else _rgb(raster.RISK if appeared > 0.0 and now - appeared <= FLASH_TIME else raster.OBSTACLE)
        for edge, appeared in zip(recording.obstacles[step, :, 3].tolist(), recording.appearances, strict=True)
    ]


def _draw_ground(camera: Camera, recording: Recording, index: int) -> Image.Image:
    """Return the floor as the camera sees it."""
    width, height = ((axis.high - axis.low) * _FLOOR_SCALE for axis in (SCENE_X, SCENE_Y))
    panel = Panel(0, 0, width=round(width), height=round(height), x=SCENE_X, y=SCENE_Y)
    floor = draw_floor(panel, recording, index)
    per_metre = _FLOOR_SCALE * SCALE
    to_floor = np.array(
        [[per_metre, 0.0, -SCENE_X.low * per_metre], [0.0, -per_metre, SCENE_Y.high * per_metre], [0.0, 0.0, 1.0]]
    )
    back = np.linalg.inv(camera.floor_to_picture())
    # Where a ray through the picture meets the floor behind the camera there is sky.
    columns, rows = np.meshgrid(np.arange(camera.size[0]) + 0.5, np.arange(camera.size[1]) + 0.5)
    is_floor = back[2, 0] * columns + back[2, 1] * rows + back[2, 2] > 0.0
    matrix = to_floor @ back
    drawn = floor.transform(
        camera.size,
        Image.Transform.PERSPECTIVE,
        (matrix / matrix[2, 2]).flatten().tolist()[:8],
        Image.Resampling.BILINEAR,
        fillcolor=_OUTSIDE,
    )
    picture = Image.new("RGB", camera.size, _SKY)
    picture.paste(drawn, (0, 0), Image.fromarray(is_floor.astype(np.uint8) * 255))
    return picture


def _frame(recordings: Sequence[Recording], cameras: Sequence[Camera], number: int) -> Image.Image:
    width, height = cameras[0].size
    whole = Image.new("RGB", (width * len(recordings) * SCALE, (height + HEADER + FOOTER) * SCALE), raster.PAPER)
    for column, recording in enumerate(recordings):
        step = int(recording.frame_steps[min(number, len(recording.frame_steps) - 1)])
        left, draw = (column * width + 10) * SCALE, ImageDraw.Draw(whole)
        draw.text((left, 19 * SCALE), recording.label, fill=raster.INK, font=font(12, bold=True), anchor="ls")
        risk, uncertainty = (raster.three_digits(series[step]) for series in (recording.risk, recording.uncertainty))
        estimate = f"risk R = {risk}, uncertainty U = {uncertainty}"
        draw.text((left, 37 * SCALE), estimate, fill=raster.INK, font=font(11), anchor="ls")
        draw_status(whole, recording, step, ((column + 1) * width - 10, 19))
    draw_legend(whole, HEADER + height + FOOTER - 12)
    frame = raster.finish(whole)
    for column, (camera, recording) in enumerate(zip(cameras, recordings, strict=True)):
        index = min(number, len(recording.frame_steps) - 1)
        frame.paste(draw_scene(camera, recording, index), (column * width, HEADER))
    if len(recordings) > 1:
        draw = ImageDraw.Draw(frame)
        for column in range(1, len(recordings)):
            draw.line([(column * width, 0), (column * width, HEADER + height)], fill=raster.PAPER, width=4)
    return frame


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = ImageColor.getrgb(colour)[:3]
    return red, green, blue
