"""The live view: what is served, and how its buttons steer the play."""

from __future__ import annotations

import socket
import urllib.request
from typing import TYPE_CHECKING

import pytest

from cura_torchrl.trainers import view as view_module
from cura_torchrl.trainers.errors import UnavailableError
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.view import View, ViewConfig, play_scene
from tests.recordings import make_recording
from tests.runs import short_evaluation, tiny_run

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from cura_torchrl.trainers.pictures.recording import Recording


@pytest.fixture
def shown() -> Iterator[View]:
    """A view on a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    made = View(ViewConfig(port=port, speed=20.0))
    yield made
    made.close()


def test_a_missing_extra_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback where the package is not installed."""
    monkeypatch.setattr(view_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UnavailableError, match=r"pip install cura-torchrl\[live\]$"):
        View(ViewConfig())


def test_a_state_is_shown_where_it_is(shown: View) -> None:
    """Catches a body that is missing, turned or in another place, and a page that is not served."""
    shown.show(make_recording(), 6)
    address = f"http://127.0.0.1:{shown.server.get_port()}"
    with urllib.request.urlopen(address, timeout=20) as page:
        assert b"<html" in page.read()
    bodies = shown._bodies
    assert {"robot/chassis", "robot/arm", "object", "goal", "obstacles/5"} <= set(bodies)
    # State 6: base at x = 3, object's centre 1.5 m ahead, its edge 1 m; the obstacle of 0.4 m at x = 8.
    assert tuple(bodies["object"].position) == pytest.approx((4.5, 0.0, 0.5))
    assert tuple(bodies["robot/arm"].position)[:2] == pytest.approx((3.45, 0.0))
    assert tuple(bodies["obstacles/1"].scale) == pytest.approx((0.4, 0.4, 0.4))
    assert "R = 0.500" in shown._text.content
    assert shown._map.image.shape == (300, 300, 3)


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Scenes are over after five steps."""
    with short_evaluation():
        yield


@pytest.mark.parametrize("recorded", [False, True])
def test_a_scene_is_played_to_its_end(recorded: bool, shown: View, tmp_path: Path) -> None:
    """Catches an episode that stops, states that are not shown, and a next scene that does not come."""
    states = []
    show = shown.show

    def note(recording: Recording, step: int, *, passed: float = 0.0) -> None:
        states.append(round(passed + recording.times[step], 3))
        show(recording, step, passed=passed)

    shown.show = note  # type: ignore[method-assign]
    loaded = load_policy(tiny_run("push", tmp_path))
    play_scene(ViewConfig(speed=20.0, recorded=recorded), loaded, shown)
    # Episodes last 1 s: five steps of 0.2 s, six states.
    assert states == [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    assert shown.scene_index.value == 1


def test_a_chosen_scene_ends_the_one_before(shown: View, tmp_path: Path) -> None:
    """Catches a button that does nothing while the view is paused."""
    shown.playing.value = False
    show = shown.show

    def choose(recording: Recording, step: int, *, passed: float = 0.0) -> None:
        show(recording, step, passed=passed)
        shown.scene_index.value = 7

    shown.show = choose  # type: ignore[assignment,method-assign]
    play_scene(ViewConfig(), load_policy(tiny_run("push", tmp_path)), shown)
    assert shown.scene_index.value == 7
