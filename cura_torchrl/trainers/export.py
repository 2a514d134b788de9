"""Writes a trained policy as graphs that run without this package: ONNX for a robot, ``torch.export`` for PyTorch.

Two graphs: ``map`` takes a scan and the map so far and returns the map and the window around the robot; ``policy``
takes the window and the observation and returns the action and what the collision estimator predicts. An export is
compared with PyTorch on recorded observations before it appears, and holds that recording.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import logging
import shutil
import warnings
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type
from tqdm import tqdm

from cura_torchrl import keys
from cura_torchrl.envs.transforms import ConfidenceMap
from cura_torchrl.trainers.build import load_encoder
from cura_torchrl.trainers.checkpoint import file_sha256
from cura_torchrl.trainers.deployment.description import Signal, describe, map_signals, policy_signals
from cura_torchrl.trainers.errors import CheckpointError, RunError, UnavailableError
from cura_torchrl.trainers.folders import make_folder
from cura_torchrl.trainers.loaded_policy import LoadedPolicy, load_policy

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray
    from tensordict import TensorDictBase

    from cura_torchrl.trainers.deployment.config import ExportConfig

RUNNER = Path(__file__).with_name("deployment") / "runner.py"
"""The runner that is copied beside the graphs."""
TOLERANCE = 1e-5
"""Largest difference between a graph and PyTorch in action, atoms, risk or uncertainty [1]."""
_SENSED = (keys.SCAN, keys.SENSOR_POSE, keys.OBJECT_POSE, keys.OBJECT_SIZE)


class MapGraph(nn.Module):
    """The map's update as a pure function of state and measurement.

    Args:
        transform: The map.
    """

    def __init__(self, transform: ConfidenceMap) -> None:
        super().__init__()
        self.transform = transform

    def forward(self, *inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return what :meth:`~cura_torchrl.ConfidenceMap.advance` does.

        Args:
            *inputs: Its arguments.

        Returns:
            Maps, their time, and windows.
        """
        return self.transform.advance(*inputs)


class PolicyGraph(nn.Module):
    """Encoder, normalisation, mean action and collision estimator.

    Args:
        loaded: Trained networks, whose policy sees the map.
    """

    def __init__(self, loaded: LoadedPolicy) -> None:
        super().__init__()
        # Channels last, as the encoder comes, torch.export stores with a warning.
        encoder = load_encoder(loaded.config.encoder).requires_grad_(False)
        self.encoder = encoder.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
        self.actor = loaded.policy[0].module
        estimator = loaded.collision_estimator
        # In sequence, the last one writes the uncertainty that costs and pictures read.
        parts = list(estimator.module) if isinstance(estimator, TensorDictSequential) else [estimator]
        self.collision_estimator = parts[0].module
        self.perceptual_estimator = parts[1].module if len(parts) > 1 else None

    def forward(self, window: torch.Tensor, observation: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return what a policy step needs.

        Args:
            window: Windows of the map [1], shape ``[N, C, W, W]``.
            observation: Observations, shape ``[N, D]``.

        Returns:
            Actions in -1 to 1 ``[N, A]``, codes ``[N, L]``, atoms ``[N, M]``, risk and uncertainty ``[N, 1]`` each.
        """
        latent = self.encoder(window)
        loc, _ = self.actor(observation, latent)
        atoms, risk, uncertainty = self.collision_estimator(observation, latent)
        if self.perceptual_estimator is not None:
            _, _, uncertainty = self.perceptual_estimator(observation, latent)
        return loc.clamp(-1.0, 1.0), latent, atoms, risk, uncertainty


def export(config: ExportConfig) -> Path:
    """Write an export: graphs, description, runner and recording.

    Args:
        config: What is exported, and where to.

    Returns:
        The folder, which appears whole or not at all.

    Raises:
        CheckpointError: If the policy sees no map.
        RunError: If the folder of the export cannot be made.
    """  # noqa: DOC502 - raised by what this calls
    _require_installed()
    loaded = load_policy(config.method or config.checkpoint or "")
    if loaded.config.perception != "map":
        msg = f"perception of {loaded.path.name} is {loaded.config.perception!r}; accepted: 'map'"
        raise CheckpointError(msg)
    stage = config.out.with_name(f".{config.out.name}.partial")
    shutil.rmtree(stage, ignore_errors=True)
    make_folder(config.out.parent, "folder of out")
    stage.mkdir()
    try:
        _fill(stage, loaded, config.check_steps)
        if config.out.exists():
            config.out.rmdir()
        stage.replace(config.out)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
    return config.out


def make_map(loaded: LoadedPolicy) -> ConfidenceMap:
    """Return the map that a policy was trained with.

    Args:
        loaded: Trained networks.

    Returns:
        A map without state.
    """
    lidar = loaded.config.env.lidar
    return ConfidenceMap(loaded.config.map, num_rays=lidar.num_rays, max_range=lidar.max_range)


def observations(loaded: LoadedPolicy, steps: int, episodes: int = 2) -> Iterator[tuple[bool, TensorDictBase]]:
    """Play the first evaluation scenarios on the planar simulator with the mean action.

    Args:
        loaded: Who plays.
        steps: Most policy steps of an episode [1].
        episodes: Episodes [1].

    Yields:
        Whether an episode starts, and what the environment emits with the map's window, batch size ``[1]``.
    """
    env = loaded.make_env(1, simulator="planar", keep_map=True)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for episode in range(episodes):
            state = env.reset(episodes=torch.tensor([episode]))
            for step in range(steps):
                yield step == 0, state
                if step and bool(state["done"]):
                    break
                state = env.step(loaded.policy(state))["next"]
    env.close()


def record(map_graph: MapGraph, policy_graph: PolicyGraph, loaded: LoadedPolicy, steps: int) -> dict[str, NDArray[Any]]:
    """Return recorded inputs with PyTorch's answers.

    Args:
        map_graph: The map.
        policy_graph: The networks.
        loaded: Who plays.
        steps: Most policy steps of an episode [1].

    Returns:
        Arrays by name, one row a step.
    """
    rows: dict[str, list[NDArray[Any]]] = {}
    memory: list[torch.Tensor] = []
    for is_first, state in observations(loaded, steps):
        sensed = {name: state[name].float() for name in (*_SENSED, keys.OBSERVATION)}
        if is_first:
            memory = list(map_graph.transform.initial_state(1))
        with torch.no_grad():
            *memory, window = map_graph(*memory, *(sensed[name] for name in _SENSED))
            action, _, atoms, risk, uncertainty = policy_graph(window, sensed[keys.OBSERVATION])
        answers = {"action": action, "atoms": atoms, "risk": risk, "uncertainty": uncertainty}
        for name, value in {**sensed, **answers}.items():
            rows.setdefault(name, []).append(value[0].numpy())
        rows.setdefault("is_first", []).append(np.array(is_first))
    return {name: np.stack(values) for name, values in rows.items()}


def _fill(stage: Path, loaded: LoadedPolicy, check_steps: int) -> None:
    transform = make_map(loaded)
    map_graph, policy_graph = MapGraph(transform), PolicyGraph(loaded)
    with tqdm(total=4, unit="part", desc="map") as bar:
        _write_graph(map_graph, map_signals(transform), stage / "map")
        bar.update()
        bar.set_description("policy")
        _write_graph(policy_graph, policy_signals(transform, loaded.config), stage / "policy")
        bar.update()
        bar.set_description("recording")
        recording: dict[str, Any] = record(map_graph, policy_graph, loaded, check_steps)
        np.savez_compressed(stage / "recording.npz", **recording)
        bar.update()
        bar.set_description("comparison")
        shutil.copyfile(RUNNER, stage / RUNNER.name)
        _describe(stage, loaded, transform)
        bar.update()


def _write_graph(module: nn.Module, signals: tuple[list[Signal], list[Signal]], stem: Path) -> None:
    # Half, and not 0: no tensor is empty or divides by nothing while it is traced.
    examples = tuple(torch.full(signal.shape, 0.5) for signal in signals[0])
    program = torch.export.export(module.eval(), examples)
    for node in program.graph_module.graph.nodes:
        node.meta.pop("stack_trace", None)  # paths of this machine
    torch.export.save(program, stem.with_suffix(".pt2"))
    names = [[signal.name for signal in side] for side in signals]
    options: dict[str, Any] = {"dynamo": True, "external_data": False, "verbose": False}
    with _quiet():
        exported = torch.onnx.export(program, input_names=names[0], output_names=names[1], **options)
    if exported is None:
        msg = f"graph of {stem.name} was not made; accepted: an exporter that returns it"
        raise RunError(msg)
    exported.save(stem.with_suffix(".onnx"))


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence what the exporter tells of itself: its own deprecations, torchvision that nothing needs, folded nodes."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnxscript", "onnx_ir")]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)
            warnings.simplefilter("ignore", DeprecationWarning)
            yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _describe(stage: Path, loaded: LoadedPolicy, transform: ConfidenceMap) -> None:
    """Write the description, once the graphs agree with PyTorch.

    Raises:
        RunError: If they do not.
    """
    path, description = stage / "export.json", describe(loaded, transform)
    path.write_text(json.dumps(description), encoding="utf-8")
    runner = importlib.import_module("cura_torchrl.trainers.deployment.runner")
    found = runner.replay(runner.Runner(stage))
    found.pop("milliseconds")
    if not all(difference <= TOLERANCE for difference in found.values()):
        msg = f"graphs differ from PyTorch by {found}; accepted: at most {TOLERANCE}"
        raise RunError(msg)
    description["largest_difference_from_pytorch"] = found
    files = sorted(file for file in stage.iterdir() if file != path)
    description["sha256"] = {file.name: file_sha256(file) for file in files}
    path.write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")


def _require_installed() -> None:
    for name in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            msg = f"{name} is not installed; accepted: first pip install cura-torchrl[export]"
            raise UnavailableError(msg)
