"""Frames as files that move: WebP and GIF by Pillow, MP4 by FFmpeg."""

from __future__ import annotations

import importlib.util
import io
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from cura_torchrl.trainers.errors import UnavailableError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cura_torchrl.trainers.pictures.render_config import AnimationFormat


def require_format(kind: str) -> None:
    """Raise unless an animation can be written in a format here.

    Args:
        kind: The format.

    Raises:
        UnavailableError: If it needs a package that is not installed.
    """
    missing = [name for name in ("imageio", "imageio_ffmpeg") if importlib.util.find_spec(name) is None]
    if kind == "mp4" and missing:
        msg = (
            f"format is mp4, whose {missing[0]} is not installed; accepted: gif, webp, or first pip install"
            " cura-torchrl[video]"
        )
        raise UnavailableError(msg)


def encode_animation(
    frames: Sequence[Image.Image],
    *,
    kind: AnimationFormat = "webp",
    frame_time: float,
    hold_time: float = 2.5,
    lossless: bool = True,
) -> bytes:
    """Return frames as a file.

    WebP and GIF loop. MP4 has frames of equal time: the last one is repeated.

    Args:
        frames: Frames of one size, for MP4 an even one.
        kind: Format of the file.
        frame_time: Time for which a frame is shown [s].
        hold_time: Time for which the last frame is shown [s].
        lossless: Whether WebP keeps every pixel: with flat colours that makes the smaller file.

    Returns:
        Content of the file.

    Raises:
        UnavailableError: If the format needs a package that is not installed.
    """  # noqa: DOC502 - raised by what this calls
    require_format(kind)
    if kind == "mp4":
        return _encode_mp4(frames, frame_time, hold_time)
    durations = [round(1000 * frame_time)] * (len(frames) - 1) + [round(1000 * hold_time)]
    # Durations of GIF are whole hundredths; one palette for all frames, so that colours do not flicker.
    options: dict[str, Any] = {"duration": durations, "loop": 0}
    if kind == "gif":
        shown = _with_one_palette(frames)
        options |= {"optimize": False, "disposal": 1}
    else:
        # Flat colours: without loss the file is smaller than with it, and a third of a GIF.
        shown, options = (
            list(frames),
            options | {"lossless": lossless, "quality": 40 if lossless else 50, "method": 2 if lossless else 4},
        )
    buffer = io.BytesIO()
    shown[0].save(buffer, kind.upper(), save_all=True, append_images=shown[1:], **options)
    return buffer.getvalue()


def _with_one_palette(frames: Sequence[Image.Image]) -> list[Image.Image]:
    # The palette is that of first, middle and last frame.
    chosen = [frames[0], frames[len(frames) // 2], frames[-1]]
    width, height = frames[0].size
    sheet = Image.new("RGB", (width, height * len(chosen)))
    for row, frame in enumerate(chosen):
        sheet.paste(frame, (0, row * height))
    palette = sheet.quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    return [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]


def _encode_mp4(frames: Sequence[Image.Image], frame_time: float, hold_time: float) -> bytes:
    import imageio.v3 as imageio  # noqa: PLC0415 - extra "video"

    repeated = [*frames, *[frames[-1]] * (round(hold_time / frame_time) - 1)]
    content: bytes = imageio.imwrite(
        "<bytes>", np.stack([np.asarray(frame) for frame in repeated]), extension=".mp4", plugin="FFMPEG",
        fps=1.0 / frame_time, codec="libx264", macro_block_size=2, output_params=["-crf", "20"],
    )  # fmt: skip
    return content
