"""The confidence map: what the LiDAR has seen of the world and how long ago, in a window around the robot.

The global map lives in buffers of the transform, indexed with the reset mask, and never enters a tensordict: at 1024
environments and 24 steps even the window would fill gigabytes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase, unravel_key
from torchrl.data import Bounded, Composite
from torchrl.envs.transforms import Transform

from cura_torchrl import keys
from cura_torchrl.envs.config import MapConfig
from cura_torchrl.envs.sensors import map_kernels, map_tensors, visibility, window
from cura_torchrl.envs.sensors.lidar import ray_angles
from cura_torchrl.envs.sensors.visibility import MapGrid
from cura_torchrl.envs.transforms.reset_mask import reset_mask
from cura_torchrl.validation import require

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

    from tensordict import NestedKey

_NOWHERE = 1e5
"""How far away the object is where there is none [m]."""

_MAX_AGE = 2**16
"""Age [steps] at which a cell's confidence is 0, whatever the decay."""


class ConfidenceMap(Transform):
    """Keep a map of what the LiDAR has seen and write the window around the robot.

    Each cell has a confidence, 1 when observed in this step and else ``decay`` times the last one, and an occupancy in
    {0, 1}: what was there when it was last observed, which does not decay. A cell is observed free if its centre is
    nearer than the range measured at its bearing (by the nearest ray), less half a cell's diagonal; the cell in which a
    ray ends on something is observed occupied; all other cells are unseen in this step, and before their first
    observation both values are 0. The cells of the robot and of the known object are left out of the occupancy: a ray
    that ends on the object (or within a cell of its sides, for noise and for the grid) marks its cell as seen, without
    an obstacle, and inside of both footprints the window shows none.

    The window ``[*, C, W, W]`` turns with the base: row ``i`` lies at base-frame ``x = (i - (W - 1) / 2) * resolution``
    (ahead of the robot for large ``i``), column ``j`` at base-frame ``y = (j - (W - 1) / 2) * resolution`` (to its left
    for large ``j``); each takes the map cell that its centre lies in. Outside of the map's extent everything is unseen.

    ================== ====== ==================================================================== ================
    Key (default)      Access Content                                                              Shape
    ================== ====== ==================================================================== ================
    ``scan``           read   Ranges [m], rays as in :func:`~cura_torchrl.envs.sensors.ray_angles` ``[*, R]``
    ``sensor_pose``    read   Sensor (x [m], y [m], yaw [rad]), world frame                        ``[*, 3]``
    ``object_pose``    read   Object's centre (x [m], y [m], yaw [rad]), world frame               ``[*, 3]``
    ``object_size``    read   Object's footprint (length, width) [m]                               ``[*, 2]``
    ``confidence_map`` write  Window of the map [1]; channels as in ``config.channels``            ``[*, C, W, W]``
    ================== ====== ==================================================================== ================

    A reset forgets the rows that are reset and integrates their first scan; in the other rows the window that
    ``_reset`` returns is 0, for TorchRL keeps their old value. Rows never depend on one another. A range that is not a
    number has seen nothing; a pose that is not finite, or an object's size that is not finite and positive, raises
    ``RuntimeError``. Called as a module, outside of an environment, the transform integrates one more scan; it is no
    transform for a replay buffer, whose samples are in no order. The time of a step grows with the cells of the extent.

    Args:
        config: Decay, extent, window and channels.
        num_rays: Rays per turn [1].
        max_range: Largest range [m]. A miss has to read this, more, or infinity; less would be an obstacle there.
        robot_size: Robot's footprint (length, width), a rectangle around the sensor [m].
        in_keys: Keys of the scan and of the sensor's pose.
        object_keys: Keys of the object's pose and footprint; None if there is no known object.
        out_key: Key of the window.

    Raises:
        ValueError: If ``in_keys`` or ``object_keys`` are not pairs, or a number is out of range.

    Source:
        Paper Eq. (2) and section "Sensor Encoding"; footprint of the Ridgeback: ridgeback_description.

    Examples:
        >>> from tensordict import TensorDict
        >>> transform = ConfidenceMap(MapConfig(window=4), num_rays=8, max_range=10.0, object_keys=None)
        >>> data = TensorDict(scan=torch.full((2, 8), 5.0), sensor_pose=torch.zeros(2, 3), batch_size=[2])
        >>> transform(data)["confidence_map"].shape
        torch.Size([2, 2, 4, 4])
        >>> transform(data)["confidence_map"][:, 0].unique().tolist()
        [1.0]
    """

    _stamps: torch.Tensor
    _steps: torch.Tensor

    def __init__(
        self,
        config: MapConfig | None = None,
        *,
        num_rays: int,
        max_range: float,
        robot_size: tuple[float, float] = (0.960, 0.793),
        in_keys: Sequence[NestedKey] = (keys.SCAN, keys.SENSOR_POSE),
        object_keys: Sequence[NestedKey] | None = (keys.OBJECT_POSE, keys.OBJECT_SIZE),
        out_key: NestedKey = keys.CONFIDENCE_MAP,
    ) -> None:
        require(len(in_keys) == 2, "in_keys", in_keys, "the keys of the scan and of the sensor's pose")
        require(
            object_keys is None or len(object_keys) == 2, "object_keys", object_keys, "None, or two keys: pose and size"
        )
        require(num_rays >= 1 and max_range > 0, "num_rays, max_range", (num_rays, max_range), "positive numbers")
        super().__init__(in_keys=[*in_keys, *(object_keys or ())], out_keys=[out_key])
        self.config = config = MapConfig() if config is None else config
        self.num_rays = num_rays
        self.max_range = max_range
        self.grid = MapGrid(extent_x=config.extent_x, extent_y=config.extent_y, resolution=config.resolution)
        offsets = window.window_offsets(config.window, config.resolution)
        origin, powers = torch.zeros(1, 3), _decay_powers(config.decay)
        robot = window.footprint_frame(offsets, origin, origin, torch.tensor(robot_size))
        tables = {
            "_row_x": self.grid.row_x(),
            "_column_y": self.grid.column_y(),
            "_offsets": offsets,
            "_directions": torch.stack(visibility.unit_vector(ray_angles(num_rays))),
            "_powers": powers,
            "_robot_size": torch.tensor(robot_size),
            # Times two, for what tells an obstacle from free space is half a step.
            "_robot_mask": 2.0 - 2.0 * window.inside_footprint(robot.points())[0],
        }
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)
        # t: seen free at time t; t + 1/2: seen occupied at time t; 0: never seen. So the greatest one counts. Episodes
        # begin at a time at which a cell never seen is older than the table of powers is long. Exact for 2**20 steps.
        self._start = float(len(powers))
        self.register_buffer("_stamps", torch.zeros(0, self.grid.num_rows, self.grid.num_columns), persistent=False)
        self.register_buffer("_steps", torch.zeros(0), persistent=False)
        self._batch_shape = torch.Size([])

    @property
    def num_channels(self) -> int:
        """Channels of the window."""
        return self.config.num_channels

    def initial_state(self, num_rows: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the maps of the start of an episode, in which nothing has been seen.

        Args:
            num_rows: Number of maps N.

        Returns:
            Stored maps [1], shape ``[N, num_rows, num_columns]`` of the grid, and the time before the first scan [1],
            shape ``[N]``.
        """
        stamps = self._stamps.new_zeros(num_rows, *self._stamps.shape[1:])
        return stamps, self._steps.new_full((num_rows,), self._start)

    def advance(
        self,
        stamps: torch.Tensor,
        steps: torch.Tensor,
        scan: torch.Tensor,
        sensor_pose: torch.Tensor,
        object_pose: torch.Tensor,
        object_size: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Integrate one scan into maps that the caller keeps: a pure function of tensor operations, for export.

        Args:
            stamps: Stored maps as from :meth:`initial_state`, or as returned.
            steps: Their time [1], shape ``[N]``.
            scan: Ranges [m], shape ``[N, R]``.
            sensor_pose: Sensor (x [m], y [m], yaw [rad]), world frame, finite, shape ``[N, 3]``.
            object_pose: Object's centre (x [m], y [m], yaw [rad]), world frame, finite, shape ``[N, 3]``.
            object_size: Object's footprint (length, width) [m], finite and positive, shape ``[N, 2]``.

        Returns:
            The maps and their time after the scan, and the windows, shape ``[N, C, W, W]``.

        Examples:
            >>> transform = ConfidenceMap(MapConfig(window=4), num_rays=8, max_range=10.0)
            >>> far, size = torch.full((1, 3), 99.0), torch.ones(1, 2)
            >>> state = transform.initial_state(1)
            >>> *state, window = transform.advance(*state, torch.full((1, 8), 5.0), torch.zeros(1, 3), far, size)
            >>> window.shape, window[:, 0].unique().tolist()
            (torch.Size([1, 2, 4, 4]), [1.0])
        """
        stamps, steps = stamps.clone(), steps + 1
        inputs = [visibility.clean_scan(scan, self.max_range), sensor_pose, object_pose, object_size]
        return stamps, steps, self._integrate(map_tensors, stamps, steps, inputs)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Integrate one more scan and write the window.

        Args:
            tensordict: Holds the in_keys; modified in place.

        Returns:
            The same tensordict.
        """
        if len(self._stamps) == 0:
            return self._reset(tensordict.empty(), tensordict)
        return self._call(tensordict)

    def age(self) -> torch.Tensor:
        """Return how long ago each cell of the global map was last observed, as free or as occupied.

        Returns:
            Steps, 0 for what the last scan has observed and infinite for what none has, in the layout of ``grid``,
            shape ``[N, num_rows, num_columns]``.
        """
        stamps = self._stamps.floor()
        return torch.where(stamps > 0, self._steps[:, None, None] - stamps, torch.inf)

    @torch.no_grad()
    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        inputs = self._read(next_tensordict)
        num_rows = inputs[0].shape[0]
        if len(self._stamps) != num_rows:
            msg = (
                f"step with {num_rows} rows, maps for {len(self._stamps)}; accepted: the batch of the last whole reset"
            )
            raise ValueError(msg)
        return self._write(next_tensordict, self._observe(self._stamps, self._steps, inputs))

    @torch.no_grad()
    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        inputs = self._read(tensordict_reset)
        num_rows, device = inputs[0].shape[0], inputs[0].device
        mask = reset_mask(self, tensordict).expand(self._batch_shape).reshape(-1)
        if len(self._stamps) != num_rows or self._stamps.device != device:
            require(bool(mask.all()), "reset mask", mask.tolist(), "a whole reset where the batch or the device is new")
            self._stamps = torch.zeros(num_rows, *self._stamps.shape[1:], device=device)
            self._steps = torch.full((num_rows,), self._start, device=device)
        rows = mask.nonzero().squeeze(-1)
        stamps, steps = self.initial_state(rows.numel())
        fresh = self._observe(stamps, steps, [item[rows] for item in inputs])
        self._stamps[rows], self._steps[rows] = stamps, steps
        window = fresh.new_zeros(num_rows, *fresh.shape[1:])
        window[rows] = fresh
        return self._write(tensordict_reset, window)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the window's spec.

        Args:
            observation_spec: Spec of the environment so far.

        Returns:
            The same spec with the out_key.

        Raises:
            KeyError: If an in_key is missing.
            ValueError: If the scan has another number of rays, or is bounded below ``max_range``.
        """  # noqa: DOC502 - raised by what this calls
        for key in self.in_keys:
            if unravel_key(key) not in observation_spec.keys(include_nested=True, leaves_only=True):
                msg = f"environment has no {key!r}; accepted: one that emits {self.in_keys}"
                raise KeyError(msg)
        scan = observation_spec[self.in_keys[0]]
        require(
            scan.shape[-1] == self.num_rays, "number of rays of the scan", scan.shape[-1], f"num_rays = {self.num_rays}"
        )
        if isinstance(scan, Bounded):
            high = scan.space.high
            is_enough = bool((high >= torch.as_tensor(self.max_range).to(high)).all())
            require(is_enough, "bound of the scan", high.min().item(), f"max_range = {self.max_range} or more")
        shape = (*scan.shape[:-1], self.num_channels, self.config.window, self.config.window)
        observation_spec[self.out_keys[0]] = Bounded(0.0, 1.0, shape=shape, dtype=torch.float32, device=scan.device)
        return observation_spec

    def _observe(self, stamps: torch.Tensor, steps: torch.Tensor, inputs: list[torch.Tensor]) -> torch.Tensor:
        """Return the windows after one scan is integrated into ``stamps`` and ``steps``, in place."""
        steps += 1
        scan, pose = visibility.clean_scan(inputs[0], self.max_range), inputs[1].contiguous()
        _require_all(pose.isfinite(), "a sensor's pose is out of bounds: accepted are finite numbers")
        _require_all(inputs[2].isfinite(), "an object's pose is out of bounds: accepted are finite numbers")
        size = inputs[3]
        _require_all(size.isfinite() & (size > 0.0), "an object's size is out of bounds: accepted are positive numbers")
        cells = map_kernels if scan.device.type == "cpu" else map_tensors
        return self._integrate(cells, stamps, steps, [scan, pose, *inputs[2:]])

    def _integrate(
        self, cells: ModuleType, stamps: torch.Tensor, steps: torch.Tensor, inputs: list[torch.Tensor]
    ) -> torch.Tensor:
        """Return the windows after a clean scan is integrated into ``stamps``, in place, at the time ``steps``."""
        scan, pose, object_pose, object_size = inputs
        cells.mark_free((self._row_x, self._column_y), stamps, steps, scan, pose, self.grid.half_diagonal)
        # Half a cell below the maximum is five times the LiDAR's noise: a noisy miss is no obstacle.
        longest = self.max_range - 0.5 * self.config.resolution
        known = object_size + 2.0 * self.config.resolution
        rectangles = (pose, self._robot_size.expand(len(pose), 2), object_pose, known)
        cells.mark_hits(self.grid, stamps, steps, scan, self._directions, rectangles, longest)
        frames = (
            window.map_frame(self.grid, self._offsets, pose),
            window.footprint_frame(self._offsets, pose, object_pose, object_size),
        )
        channels = 1 if self.config.channels == "confidence" else 2
        windows = scan.new_empty(len(scan), channels, self.config.window, self.config.window)
        cells.fill_windows(self.grid, windows, stamps, steps, frames, (self._robot_mask, self._powers))
        return windows.prod(1, keepdim=True) if self.config.channels == "product" else windows

    def _read(self, tensordict: TensorDictBase) -> list[torch.Tensor]:
        # The inputs with one batch dimension, an object among them; the batch's shape is noted.
        values = [tensordict.get(key) for key in self.in_keys]
        if any(value is None for value in values):
            given = sorted(map(str, tensordict.keys(True, True)))
            msg = f"tensordict has only {given}; accepted: one that holds {self.in_keys}"
            raise KeyError(msg)
        require(
            values[0].shape[-1] == self.num_rays, "number of rays", values[0].shape[-1], f"num_rays = {self.num_rays}"
        )
        self._batch_shape = values[0].shape[:-1]
        inputs = [value.reshape(-1, value.shape[-1]).float() for value in values]
        return inputs if len(inputs) > 2 else [*inputs, inputs[1] + _NOWHERE, inputs[1].new_ones(len(inputs[1]), 2)]

    def _write(self, tensordict: TensorDictBase, window: torch.Tensor) -> TensorDictBase:
        tensordict.set(self.out_keys[0], window.view(*self._batch_shape, *window.shape[1:]))
        return tensordict


def _require_all(holds: torch.Tensor, message: str) -> None:
    """Raise ``RuntimeError`` unless a condition holds everywhere: at once on the CPU, without waiting elsewhere."""
    torch._assert_async(holds.all(), message)


def _decay_powers(decay: float) -> torch.Tensor:
    """Return ``decay ** k`` for ``k = 0, 1, ...`` until it is 0 in float32 or the greatest age is reached, then a 0."""
    if decay <= 0.0:
        return torch.tensor([1.0, 0.0])
    steps = _MAX_AGE if decay >= 1.0 else min(_MAX_AGE, math.ceil(math.log(1e-46) / math.log(decay)))
    powers = torch.pow(torch.tensor(decay, dtype=torch.float64), torch.arange(steps + 1)).float()
    return torch.cat([powers, torch.zeros(1)])
