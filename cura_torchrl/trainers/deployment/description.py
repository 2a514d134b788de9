"""What stands beside exported graphs: names, shapes, units, frames, limits and origin of all that goes in and out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES, observation_size
from cura_torchrl.envs.robots.robot import ROBOT_MODELS
from cura_torchrl.trainers.build import LATENT_SIZE
from cura_torchrl.trainers.info import git_commit, versions

if TYPE_CHECKING:
    from cura_torchrl.envs.config import RobotConfig
    from cura_torchrl.envs.transforms import ConfidenceMap
    from cura_torchrl.trainers.config import CURAConfig, TrainConfig
    from cura_torchrl.trainers.loaded_policy import LoadedPolicy

OBSERVATION_PARTS: dict[str, tuple[str, str]] = {
    "tcp_position": ("m", "TCP relative to the base"),
    "hand_axes": ("1", "x axis, then y axis, of the hand"),
    "tcp_velocity": ("m/s", "velocity of the TCP relative to the world"),
    "base_velocity": ("m/s, m/s, rad/s", "x, y, yaw rate"),
    "object_position": ("m", "object's centre, its height included"),
    "object_heading": ("1", "cosine, sine of four times the object's yaw relative to the base"),
    "object_velocity": ("m/s", "object's planar velocity relative to the world"),
    "object_yaw_rate": ("rad/s", "object's yaw rate"),
    "goal_position": ("m", "goal's centre in the plane"),
    "goal_heading": ("1", "cosine, sine of four times the goal's yaw relative to the base"),
    "previous_action": ("1", "last action"),
}
"""Unit and meaning of the parts of the observation, all in the base frame."""

_UNCERTAINTY_MEANINGS = {
    "total": "population variance of the atoms",
    "perceptual": "population variance of another estimator's atoms: the part that seeing all obstacles would remove",
}


class Signal(NamedTuple):
    """An input or output of a graph; all are float32."""

    name: str
    shape: tuple[int, ...]
    unit: str
    frame: str
    meaning: str

    def to_json(self) -> dict[str, Any]:
        """Return the signal as JSON, with its type."""
        return {**self._asdict(), "dtype": "float32"}


def map_signals(transform: ConfidenceMap) -> tuple[list[Signal], list[Signal]]:
    """Return the inputs and the outputs of the graph of the map.

    Args:
        transform: The map.

    Returns:
        Inputs and outputs, in order.
    """
    cells, window = (1, transform.grid.num_rows, transform.grid.num_columns), transform.config.window
    stored, time = "when each cell was last seen, plus 1/2 if it was occupied; 0 never", "scans so far, from a start"
    inputs = [
        Signal("stamps", cells, "1", "world", stored),
        Signal("steps", (1,), "1", "", time),
        Signal("scan", (1, transform.num_rays), "m", "base", "ranges; a miss is the largest, NaN has seen nothing"),
        Signal("sensor_pose", (1, 3), "m, m, rad", "world", "LiDAR's x, y, yaw"),
        Signal("object_pose", (1, 3), "m, m, rad", "world", "object's centre x, y, yaw"),
        Signal("object_size", (1, 2), "m", "object", "object's footprint: length, width"),
    ]
    shown = (1, transform.num_channels, window, window)
    outputs = [
        Signal("stamps_next", cells, "1", "world", "stamps for the next scan"),
        Signal("steps_next", (1,), "1", "", "steps for the next scan"),
        Signal("window", shown, "1", "base", f"{transform.config.channels}; rows ahead, columns to the left"),
    ]
    return inputs, outputs


def policy_signals(transform: ConfidenceMap, config: TrainConfig) -> tuple[list[Signal], list[Signal]]:
    """Return the inputs and the outputs of the graph of encoder, normalisation, policy and collision estimator.

    Args:
        transform: The map.
        config: Whose policy it is.

    Returns:
        Inputs and outputs, in order.
    """
    size = ROBOT_MODELS[config.env.robot.model].action_size
    inputs = [
        map_signals(transform)[1][-1],
        Signal(
            "observation", (1, observation_size(size)), "see observation", "base", "robot, object and goal, as measured"
        ),
    ]
    outputs = [
        Signal("action", (1, size), "1", "base", "mean action, clamped; see action"),
        Signal("latent", (1, LATENT_SIZE), "1", "", "code of the window"),
        Signal("atoms", (1, config.cura.num_atoms), "1", "", "atoms of the collision possibility, in no order"),
        Signal("risk", (1, 1), "1", "", _risk_meaning(config.cura)),
        Signal("uncertainty", (1, 1), "1", "", _UNCERTAINTY_MEANINGS[config.cura.uncertainty]),
    ]
    return inputs, outputs


def _risk_meaning(cura: CURAConfig) -> str:
    meanings = {
        "mean": "mean of the atoms",
        "cvar": f"mean of the largest {cura.risk_level:g} of the atoms, which are clamped to 0 to 1",
        "wang": f"mean of the atoms, which are clamped to 0 to 1, after Wang's shift by {cura.risk_level:g}",
    }
    return meanings[cura.risk_measure]


def describe(loaded: LoadedPolicy, transform: ConfidenceMap) -> dict[str, Any]:
    """Return all that a robot has to know beside the graphs.

    Args:
        loaded: What is exported.
        transform: Its map.

    Returns:
        JSON-compatible.
    """
    config, task = loaded.config, loaded.config.env.task
    pairs = {
        "map": map_signals(transform),
        "policy": policy_signals(transform, config),
    }
    graphs = {
        name: {
            "onnx": f"{name}.onnx",
            "torch_export": f"{name}.pt2",
            "inputs": [signal.to_json() for signal in inputs],
            "outputs": [signal.to_json() for signal in outputs],
        }
        for name, (inputs, outputs) in pairs.items()
    }
    return {
        "method": config.method,
        "frames": loaded.record["frames"],
        "trained_with": {name: loaded.record.get(name) for name in ("commit", "seed", "versions")},
        "exported_with": {"commit": git_commit(), "versions": versions()},
        "policy_period": {"value": task.policy_period, "unit": "s"},
        "graphs": graphs,
        "initial_state": {"stamps": 0.0, "steps": float(transform.initial_state(1)[1])},
        "action": _actions(config.env.robot),
        "observation": _observation(config.env.robot),
        "lidar": {
            "num_rays": transform.num_rays,
            "max_range": transform.max_range,
            "bearing_of_ray_0": "-pi, straight behind; the others follow counter-clockwise",
            "sees_the_object": config.env.lidar.occlusion,
        },
        "map": _geometry(transform),
    }


def _actions(robot: RobotConfig) -> dict[str, Any]:
    speeds = {
        "base_x": (robot.max_base_speed, "m/s"),
        "base_y": (robot.max_base_speed, "m/s"),
        "base_yaw": (robot.max_base_yaw_rate, "rad/s"),
        **{f"tcp_{axis}": (robot.max_tcp_speed, "m/s") for axis in "xyz"},
    }
    size = ROBOT_MODELS[robot.model].action_size
    return {
        "frame": "base",
        "low": -1.0,
        "high": 1.0,
        "meaning": "velocities as shares of scale, the end-effector's relative to the base; (base_x, base_y) is "
        "shortened to length 1",
        "parts": [{"name": name, "scale": scale, "unit": unit} for name, (scale, unit) in list(speeds.items())[:size]],
    }


def _observation(robot: RobotConfig) -> list[dict[str, Any]]:
    parts, size = [], observation_size(ROBOT_MODELS[robot.model].action_size)
    for name, (unit, meaning) in OBSERVATION_PARTS.items():
        place = OBSERVATION_SLICES[name]
        parts.append(
            {"name": name, "start": place.start, "stop": min(place.stop, size), "unit": unit, "meaning": meaning}
        )
    return parts


def _geometry(transform: ConfidenceMap) -> dict[str, Any]:
    config, grid = transform.config, transform.grid
    return {
        "decay": config.decay,
        "resolution": config.resolution,
        "window": config.window,
        "channels": config.channels,
        "extent_x": list(grid.extent_x),
        "extent_y": list(grid.extent_y),
        "unit": "m",
        "stored": "row i + 1, column j: the cell whose lower corner is (extent_x[0] + i res, extent_y[0] + j res)",
    }
