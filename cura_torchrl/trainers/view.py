"""Scenes in the browser, as they are played or after they were recorded; needs the extra ``live``."""

from __future__ import annotations

import importlib.util
import itertools
import logging
import time
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from cura_torchrl.envs.robots.ridgeback import CHASSIS_SIZE
from cura_torchrl.envs.sensors.lidar import ray_angles
from cura_torchrl.trainers.errors import UnavailableError
from cura_torchrl.trainers.evaluation.episodes import play_episodes
from cura_torchrl.trainers.evaluation.task import evaluation_task
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.animation import map_image
from cura_torchrl.trainers.pictures.recording import Recorder, Recording, find_scene, record
from cura_torchrl.trainers.pictures.view_config import ViewConfig
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.trainers.loaded_policy import LoadedPolicy
    from cura_torchrl.trainers.pictures.recording import Scene

__all__ = ["ViewConfig", "view"]

logger = logging.getLogger(__name__)

_WAIT = 0.02
"""Time between two looks at the buttons [s]."""
_HEIGHT = 0.28
"""Height that chassis and LiDAR's points are drawn at [m]."""
_ARM_WIDTH = 0.12
"""Width of the arm as it is drawn [m]."""
_NOTHING = 0.001
"""Edge of an obstacle that has not appeared, as it is drawn [m]."""
_MAP_PIXELS = 300


class _SceneChosen(Exception):  # noqa: N818 - no error: the browser asks for another scene
    """Ends an episode that is being played."""


class View:
    """What the browser shows, and its buttons.

    Args:
        config: Port, first scene and speed.

    Raises:
        UnavailableError: If viser is not installed.
    """

    def __init__(self, config: ViewConfig) -> None:
        if importlib.util.find_spec("viser") is None:
            msg = "the live view needs viser, which is not installed; accepted: first pip install cura-torchrl[live]"
            raise UnavailableError(msg)
        import viser  # noqa: PLC0415 - an extra

        self.server = viser.ViserServer(host=config.host, port=config.port, verbose=False)
        scene, gui = self.server.scene, self.server.gui
        scene.add_grid("/floor", 20.0, 10.0, position=(7.0, 0.0, 0.0))
        self._bodies: dict[str, Any] = {}
        self.playing = gui.add_checkbox("play", initial_value=True)
        self.step = gui.add_button("one step")
        self.speed = gui.add_number("speed [1]", config.speed, min=0.1, max=20.0)
        self.scene_index = gui.add_number("scene", config.scene, min=0, step=1)
        self.time = gui.add_slider("state", 0, 1, 1, 0, visible=config.recorded)
        self._text = gui.add_markdown("")
        self._map = gui.add_image(np.zeros((_MAP_PIXELS, _MAP_PIXELS, 3), np.uint8), label="confidence map")
        self._steps = 0
        self.step.on_click(lambda _: self._ask_step())

    def _ask_step(self) -> None:
        self._steps += 1

    def close(self) -> None:
        """Stop serving."""
        self.server.stop()

    def wait(self, period: float, scene: int) -> None:
        """Wait until the next state is due.

        Args:
            period: Time from one state to the next [s].
            scene: Index of the scene that is shown [1].

        Raises:
            _SceneChosen: If the browser has asked for another scene.
        """
        due = time.monotonic() + period / max(0.1, float(self.speed.value))
        while True:
            if int(self.scene_index.value) != scene:
                raise _SceneChosen
            if self._steps > 0:
                self._steps -= 1
                return
            if self.playing.value and time.monotonic() >= due:
                return
            time.sleep(_WAIT)

    def show(self, recording: Recording, step: int, *, passed: float = 0.0) -> None:
        """Show one state.

        Args:
            recording: What is shown; of maps and scans it needs those of the state.
            step: Index of the state [1].
            passed: Time of the scene that passed before the recording [s].
        """
        base, tcp, edge = recording.base_pose[step], recording.tcp[step], recording.scene.object_edge
        self._box("robot/chassis", base, (*CHASSIS_SIZE, _HEIGHT), raster.ROBOT)
        reach = tcp - base[:2]
        middle = (*(base[:2] + reach / 2), np.arctan2(reach[1], reach[0]))
        arm = (float(np.hypot(*reach)), _ARM_WIDTH, _ARM_WIDTH)
        if recording.has_arm:
            self._box("robot/arm", middle, arm, raster.ARM, above=_HEIGHT)
        self._box("object", recording.object_pose[step], (edge, edge, edge), raster.OBJECT)
        self._box("goal", recording.scene.goal_pose, (edge, edge, 0.01), raster.GOAL)
        for number, obstacle in enumerate(recording.obstacles[step]):
            size = max(_NOTHING, float(obstacle[3]))
            self._box(f"obstacles/{number}", obstacle[:3], (size, size, size), raster.OBSTACLE)
        frame = int(np.searchsorted(recording.frame_steps, step, side="right")) - 1
        self._scan(base, recording.scans[frame])
        picture = map_image(recording.maps[frame, 0], raster.CONFIDENCE_COLOURS, _MAP_PIXELS)
        self._map.image = np.asarray(picture)
        self._text.content = (
            f"scene {recording.scene.index}, t = {passed + recording.times[step]:.1f} s  \n"
            f"risk R = {recording.risk[step]:.3f}  \nuncertainty U = {recording.uncertainty[step]:.4f}"
        )

    def _scan(self, base: Any, ranges: Any) -> None:
        angles = base[2] + ray_angles(len(ranges)).numpy()
        points = base[:2] + ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], -1)
        points = np.concatenate([points, np.full((len(points), 1), _HEIGHT)], -1).astype(np.float32)
        self.server.scene.add_point_cloud("/lidar", points, (0, 114, 178), point_size=0.05)

    def _box(self, name: str, pose: Any, size: tuple[float, ...], colour: str, *, above: float = 0.0) -> None:
        x, y, yaw = (float(value) for value in pose)
        place = (x, y, above + size[2] / 2)
        turn = (float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2)))
        if name not in self._bodies:
            rgb = tuple(int(colour[start : start + 2], 16) for start in (1, 3, 5))
            self._bodies[name] = self.server.scene.add_box(f"/{name}", color=rgb, dimensions=(1.0, 1.0, 1.0))
        body = self._bodies[name]
        body.scale, body.position, body.wxyz = size, place, turn


def view(config: ViewConfig, *, scenes: int | None = None) -> None:
    """Serve scenes until the process is stopped.

    Args:
        config: Who plays what.
        scenes: Scenes to show before it ends [1]; None goes on.

    Raises:
        UnavailableError: If viser is not installed.
        CheckpointError: If there are no such weights.
    """  # noqa: DOC502 - raised by what this calls
    shown = View(config)
    with closing(shown), one_thread():
        loaded = load_policy(config.method).double()
        logger.info("open http://%s:%d in a browser; Ctrl-C ends the view", config.host, shown.server.get_port())
        while scenes is None or scenes > 0:
            play_scene(config, loaded, shown)
            scenes = None if scenes is None else scenes - 1


def play_scene(config: ViewConfig, loaded: LoadedPolicy, shown: View) -> None:
    """Show the scene that the browser has chosen, to its end or until another one is chosen.

    Args:
        config: Who plays what.
        loaded: Who plays.
        shown: The view.
    """
    task = evaluation_task(loaded.config.env.task, config)
    index = int(shown.scene_index.value)
    scene = find_scene(task.scenario, seed=config.seed, index=index)
    with closing(loaded.make_evaluation_env(1, config, simulator=config.simulator, keep_map=True)) as env:
        try:
            if config.recorded:
                _show_recorded(loaded, env, scene, shown)
            else:
                _show_live(loaded, env, scene, shown)
        except _SceneChosen:
            return
    shown.scene_index.value = index + 1


def _show_live(loaded: LoadedPolicy, env: EnvBase, scene: Scene, shown: View) -> None:
    states = itertools.count()

    def look(state: TensorDictBase, is_playing: torch.Tensor) -> None:
        recorder = Recorder(loaded.collision_estimator, 1, stride=1)
        recorder(state, is_playing, env.base_env.world_state)
        (recording,) = recorder.recordings([None], [scene], label="", env=env)  # type: ignore[list-item]
        shown.show(recording, 0, passed=next(states) * recording.period)
        shown.wait(recording.period, scene.index)

    play_episodes(env, loaded.policy, torch.tensor([scene.index]), watch=look)


def _show_recorded(loaded: LoadedPolicy, env: EnvBase, scene: Scene, shown: View) -> None:
    (recording,) = record(env, loaded.policy, loaded.collision_estimator, [scene], label="", stride=1)
    last = len(recording.times) - 1
    shown.time.max, shown.time.value = last, 0
    while shown.time.value < last:
        shown.show(recording, int(shown.time.value))
        before = shown.time.value
        shown.wait(recording.period, scene.index)
        # Where the slider was moved in the meantime, the view goes on from there.
        shown.time.value = min(last, shown.time.value + (shown.time.value == before))
    shown.show(recording, last)
