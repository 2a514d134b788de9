"""Runs an exported policy with ONNX Runtime and NumPy alone: no PyTorch, no cura_torchrl. A copy lies in every export.

python runner.py

compares the graphs with the recorded answers beside this file, and says how long a step takes on this machine.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_INPUTS = ("scan", "sensor_pose", "object_pose", "object_size")


class Runner:
    """An exported policy with the map that it remembers. Units and frames of all inputs are in ``export.json``.

    Args:
        folder: The export; that of this file when left out.
        threads: Threads that a graph may use [1].
    """

    def __init__(self, folder: Path | str | None = None, *, threads: int = 1) -> None:
        self.folder = Path(__file__).parent if folder is None else Path(folder)
        self.description: dict[str, Any] = json.loads((self.folder / "export.json").read_text(encoding="utf-8"))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        self._map, self._policy = (
            onnxruntime.InferenceSession(self.folder / name, options, providers=["CPUExecutionProvider"])
            for name in ("map.onnx", "policy.onnx")
        )
        graphs = self.description["graphs"].values()
        self._shapes = {item["name"]: item["shape"] for graph in graphs for item in graph["inputs"]}
        self.outputs: dict[str, NDArray[np.float32]] = {}
        """All that the last step gave, by name: stamps, steps, window, action, latent, atoms, risk, uncertainty."""
        self.reset()

    def reset(self) -> None:
        """Forget what was seen: before every episode."""
        start = self.description["initial_state"]
        self._state = {name: np.full(self._shapes[name], start[name], dtype=np.float32) for name in ("stamps", "steps")}

    def step(
        self,
        scan: ArrayLike,
        pose: ArrayLike,
        object_pose: ArrayLike,
        object_size: ArrayLike,
        observation: ArrayLike,
    ) -> tuple[NDArray[np.float32], float, float]:
        """Take in one scan and decide; once in every policy period.

        Args:
            scan: Ranges [m]; not-a-number has seen nothing.
            pose: Sensor (x [m], y [m], yaw [rad]), world frame.
            object_pose: Object's centre (x [m], y [m], yaw [rad]), world frame.
            object_size: Object's footprint (length, width) [m].
            observation: Robot, object and goal, base frame.

        Returns:
            Action in -1 to 1 as shares of the limits, risk and uncertainty [1].

        Raises:
            ValueError: If an input has another size, one other than the scan is not finite, or the object has no size.
        """  # noqa: DOC502 - raised by what this calls
        seen = {
            name: self._checked(name, value)
            for name, value in zip(_INPUTS, (scan, pose, object_pose, object_size), strict=True)
        }
        given = self._checked("observation", observation)
        stamps, steps, window = self._map.run(["stamps_next", "steps_next", "window"], {**self._state, **seen})
        self._state = {"stamps": stamps, "steps": steps}
        names = ["action", "latent", "atoms", "risk", "uncertainty"]
        values = self._policy.run(names, {"window": window, "observation": given})
        self.outputs = {**self._state, "window": window, **dict(zip(names, values, strict=True))}
        return values[0][0], float(values[3][0, 0]), float(values[4][0, 0])

    def _checked(self, name: str, value: ArrayLike) -> NDArray[np.float32]:
        array, shape = np.asarray(value, dtype=np.float32), self._shapes[name]
        if array.size != shape[1]:
            msg = f"{name} has {array.size} numbers; accepted: {shape[1]}"
            raise ValueError(msg)
        if name != "scan" and not np.isfinite(array).all():
            msg = f"{name} is {array.tolist()}; accepted: finite numbers"
            raise ValueError(msg)
        if name == "object_size" and not (array > 0.0).all():
            msg = f"{name} is {array.tolist()}; accepted: positive numbers [m]"
            raise ValueError(msg)
        return array.reshape(shape)


def replay(runner: Runner) -> dict[str, float]:
    """Play the recorded inputs and compare the answers.

    Args:
        runner: The export.

    Returns:
        Largest difference of action, atoms, risk and uncertainty [1], not a number where there is none, and the median
        time of a step [ms].
    """
    recorded = np.load(runner.folder / "recording.npz")
    worst, times = dict.fromkeys(("action", "atoms", "risk", "uncertainty"), 0.0), []
    for row, is_first in enumerate(recorded["is_first"]):
        if is_first:
            runner.reset()
        inputs = [recorded[name][row] for name in (*_INPUTS, "observation")]
        start = time.perf_counter()
        runner.step(*inputs)
        times.append(time.perf_counter() - start)
        for name in worst:
            difference = np.abs(runner.outputs[name][0] - recorded[name][row]).max()
            worst[name] = float(np.maximum(worst[name], difference))  # unlike max(), it lets no NaN pass
    return {**worst, "milliseconds": float(np.median(times)) * 1e3}


if __name__ == "__main__":
    sys.stdout.write(json.dumps(replay(Runner())) + "\n")
