"""Animations can be read again, by other readers than those that wrote them where there are any."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from cura_torchrl.trainers.errors import UnavailableError
from cura_torchrl.trainers.pictures import video
from cura_torchrl.trainers.pictures.video import encode_animation

COLOURS = ("#ffffff", "#1a9850", "#c51b8a")


@pytest.fixture(scope="module")
def frames() -> list[Image.Image]:
    """Three frames of one colour each, of a size that is no multiple of 16."""
    return [Image.new("RGB", (90, 62), colour) for colour in COLOURS]


@pytest.mark.parametrize("kind", ["gif", "webp"])
def test_looping_animations_keep_frames_and_times(frames: list[Image.Image], kind: str) -> None:
    """Catches frames that are dropped, in a wrong order or colour, or too fast."""
    content = encode_animation(frames, kind=kind, frame_time=0.2, hold_time=1.5)
    with Image.open(io.BytesIO(content)) as opened:
        assert (opened.format, opened.n_frames, opened.size) == (kind.upper(), 3, (90, 62))
        durations = []
        for number, frame in enumerate(frames):
            opened.seek(number)
            shown = np.asarray(opened.convert("RGB")).astype(int)
            durations.append(opened.info["duration"])  # known once the frame is decoded
            assert np.array_equal(shown, np.asarray(frame))
    assert durations == [200, 200, 1500]


def test_lossy_webp_is_nearly_the_same(frames: list[Image.Image]) -> None:
    """Catches a quality that changes colours."""
    content = encode_animation(frames, frame_time=0.2, lossless=False)
    with Image.open(io.BytesIO(content)) as opened:
        opened.seek(1)
        assert np.asarray(opened.convert("RGB"))[31, 45] == pytest.approx(np.asarray(frames[1])[31, 45], abs=8)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio leaves the reader's pipes open
def test_mp4_has_all_frames_and_holds_the_last(frames: list[Image.Image]) -> None:
    """Catches a size that the codec rounds, frames that are lost, and an end that flashes by."""
    import imageio.v3 as imageio  # noqa: PLC0415 - extra "video"

    content = encode_animation(frames, kind="mp4", frame_time=0.2, hold_time=1.0)
    read = imageio.imread(content, extension=".mp4", plugin="FFMPEG")
    assert read.shape == (2 + 5, 62, 90, 3)
    for number, frame in enumerate([*frames, frames[-1]]):
        assert read[number, 31, 45] == pytest.approx(np.asarray(frame)[31, 45], abs=12)
    facts = imageio.immeta(content, extension=".mp4", plugin="FFMPEG")
    assert facts["fps"] == pytest.approx(5.0)


def test_mp4_without_its_package_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an import error after minutes of playing."""
    monkeypatch.setattr(video.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UnavailableError, match=r"format is mp4.*accepted: gif, webp, or first pip install"):
        video.require_format("mp4")
    video.require_format("gif")
