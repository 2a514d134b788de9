"""The figures' command: every file that was asked for, of the scene that evaluate plays."""

from __future__ import annotations

import dataclasses
import io
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import pytest
from PIL import Image

from cura_torchrl.trainers import render as render_module
from cura_torchrl.trainers.config import EvaluateConfig
from cura_torchrl.trainers.errors import UnavailableError
from cura_torchrl.trainers.evaluate import evaluate
from cura_torchrl.trainers.evaluation.episodes import outcome_letter
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.pictures.render_config import FIGURES, RenderConfig
from cura_torchrl.trainers.render import play_scene, render
from tests.recordings import make_recording

if TYPE_CHECKING:
    from pathlib import Path

SCENE = 3


def test_the_scene_is_played_as_evaluate_plays_it() -> None:
    """Catches another scene, task or precision: evaluate plays scenes 0 to 4 side by side, here 3 is played alone."""
    scenes = {"scenario": "adversarial", "object_size": 1.0, "simulator": "planar"}
    known = evaluate(EvaluateConfig(method="push", episodes=5, chunk=5, **scenes))
    config = RenderConfig(methods=("push",), scene=SCENE, **scenes)
    (recording,) = play_scene(config, [load_policy("push").double()])
    assert outcome_letter(recording.episode) == known["outcomes"][SCENE]
    assert recording.scene.kind == "adversarial"
    assert recording.scene.object_edge == 1.0
    assert len(recording.frame_steps) == len(recording.base_pose) == len(recording.arm_joints)


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is simulated: the methods have played what is known."""
    recordings = [make_recording(outcome="collision"), make_recording()]
    monkeypatch.setattr(render_module, "play_scene", lambda config, loaded: recordings[: len(loaded)])


@pytest.mark.usefixtures("played")
def test_every_figure_and_view_is_written(tmp_path: Path) -> None:
    """Catches a figure, format or view that is left out, and files that no reader can open."""
    config = RenderConfig(formats=("png,svg", "gif"), view="both", size=(480, 240), every=2, out=tmp_path / "new")
    files = render(config)
    stills = {f"{name}.{kind}" for name in FIGURES for kind in ("png", "svg")}
    assert {file.name for file in files} == {*stills, "animation-top.gif", "animation-3d.gif"}
    assert set(files) == set((tmp_path / "new").iterdir())
    for file in files:
        if file.suffix == ".svg":
            root = ElementTree.fromstring(file.read_text(encoding="utf-8"))
            assert root.tag == "{http://www.w3.org/2000/svg}svg"
            continue
        with Image.open(io.BytesIO(file.read_bytes())) as picture:
            picture.load()
            # Frames 0 and 2 of three.
            assert getattr(picture, "n_frames", 1) == (2 if file.suffix == ".gif" else 1)


@pytest.mark.usefixtures("played")
def test_what_is_not_asked_for_is_not_drawn(tmp_path: Path) -> None:
    """Catches minutes of drawing for one figure."""
    config = RenderConfig(methods=("push",), figures=("paths",), formats=("svg",), times=(0.2,), out=tmp_path)
    assert [file.name for file in render(config)] == ["paths.svg"]
    none = dataclasses.replace(config, figures=("none",), formats=("webp",), every=9)
    assert [file.name for file in render(none)] == ["animation-top.webp"]


def test_a_format_that_cannot_be_written_is_refused_before_anything_is_played(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Catches a scene that is played for minutes and then lost."""
    monkeypatch.setattr("cura_torchrl.trainers.pictures.video.importlib.util.find_spec", lambda _: None)
    monkeypatch.setattr(render_module, "play_scene", lambda *_: pytest.fail("played"))
    with pytest.raises(UnavailableError, match="format is mp4"):
        render(RenderConfig(formats=("mp4",), out=tmp_path))
