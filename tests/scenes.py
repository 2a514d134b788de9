"""Analytic scenes for sensor and map tests: rays against rectangles, and a toy environment that scans them.

Everything is NumPy float64 and shares no code with the package, so that expectations stay independent.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

MAX_RANGE = 10.0
NUM_RAYS = 360


def cast_rays(
    rectangles: np.ndarray, pose: np.ndarray, num_rays: int = NUM_RAYS, max_range: float = MAX_RANGE
) -> np.ndarray:
    """Return how far a sensor (x, y, yaw) sees along each ray past rectangles (x, y, yaw, length, width)."""
    angle = -math.pi + np.arange(num_rays) * 2 * math.pi / num_rays + pose[2]
    nearest = np.full(num_rays, max_range)
    for x, y, yaw, length, width in rectangles:
        cos, sin = math.cos(yaw), math.sin(yaw)
        shift = np.array([pose[0] - x, pose[1] - y])
        origin = np.array([cos * shift[0] + sin * shift[1], -sin * shift[0] + cos * shift[1]])
        direction = np.stack([np.cos(angle - yaw), np.sin(angle - yaw)])
        direction = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
        enter = (-np.sign(direction) * [[length / 2], [width / 2]] - origin[:, None]) / direction
        leave = (np.sign(direction) * [[length / 2], [width / 2]] - origin[:, None]) / direction
        start, end = enter.max(0), leave.min(0)
        is_hit = (start <= end) & (start > 0)
        nearest = np.where(is_hit & (start < nearest), start, nearest)
    return nearest


class ReferenceMap:
    """The map's definition, cell by cell in float64: slow, and written from the definition alone."""

    def __init__(self, extent_x, extent_y, resolution, decay, window, robot_size=(0.960, 0.793)) -> None:
        self.low, self.resolution, self.decay, self.window = (extent_x[0], extent_y[0]), resolution, decay, window
        self.count = [round((e[1] - e[0]) / resolution) for e in (extent_x, extent_y)]
        self.robot_size = robot_size
        self.confidence, self.occupancy = np.zeros(self.count), np.zeros(self.count)

    def observe(self, scan, pose, box=None, max_range: float = MAX_RANGE) -> np.ndarray:
        """Integrate a scan and return the window; ``box`` is the known object (x, y, yaw, length, width)."""
        rays = len(scan)
        centre_x, centre_y = np.meshgrid(
            *[low + (np.arange(n) + 0.5) * self.resolution for low, n in zip(self.low, self.count, strict=True)],
            indexing="ij",
        )
        dx, dy = centre_x - pose[0], centre_y - pose[1]
        nearest_ray = np.round((np.arctan2(dy, dx) - pose[2] + math.pi) * rays / (2 * math.pi)).astype(int) % rays
        is_free = np.hypot(dx, dy) < scan[nearest_ray] - self.resolution * math.sqrt(2) / 2
        self.confidence *= self.decay
        self.confidence[is_free], self.occupancy[is_free] = 1.0, 0.0
        known = [(pose[0], pose[1], pose[2], *self.robot_size)]
        if box is not None:
            known.append((*box[:3], box[3] + 2 * self.resolution, box[4] + 2 * self.resolution))
        self._mark(scan, pose, known, max_range)
        return self.read(pose, box)

    def _mark(self, scan, pose, known, max_range: float) -> None:
        rays, hits = len(scan), []
        for i, distance in enumerate(scan):
            if not 0 < distance < max_range - self.resolution / 2:
                continue
            angle = -math.pi + i * 2 * math.pi / rays + pose[2]
            x, y = pose[0] + distance * math.cos(angle), pose[1] + distance * math.sin(angle)
            cell = math.floor((x - self.low[0]) / self.resolution), math.floor((y - self.low[1]) / self.resolution)
            if 0 <= cell[0] < self.count[0] and 0 <= cell[1] < self.count[1]:
                hits.append((cell, any(bool(_inside(x, y, rectangle)) for rectangle in known)))
        for cell, is_known in hits:
            self.confidence[cell] = 1.0
            if is_known:
                self.occupancy[cell] = 0.0
        for cell, is_known in hits:
            if not is_known:
                self.occupancy[cell] = 1.0

    def read(self, pose, box=None) -> np.ndarray:
        """Return the window (confidence, occupancy), row along base x, column along base y."""
        offset = (np.arange(self.window) - (self.window - 1) / 2) * self.resolution
        ahead, left = np.meshgrid(offset, offset, indexing="ij")
        x = pose[0] + math.cos(pose[2]) * ahead - math.sin(pose[2]) * left
        y = pose[1] + math.sin(pose[2]) * ahead + math.cos(pose[2]) * left
        i = np.floor((x - self.low[0]) / self.resolution).astype(int)
        j = np.floor((y - self.low[1]) / self.resolution).astype(int)
        inside = (i >= 0) & (i < self.count[0]) & (j >= 0) & (j < self.count[1])
        i, j = np.clip(i, 0, self.count[0] - 1), np.clip(j, 0, self.count[1] - 1)
        occupancy = self.occupancy[i, j] * inside
        for rectangle in [(*pose, *self.robot_size)] + ([] if box is None else [box]):
            occupancy = np.where(_inside(x, y, rectangle), 0.0, occupancy)
        return np.stack([self.confidence[i, j] * inside, occupancy])


def _inside(x, y, rectangle) -> np.ndarray:
    cx, cy, yaw, length, width = rectangle
    along = math.cos(yaw) * (x - cx) + math.sin(yaw) * (y - cy)
    across = -math.sin(yaw) * (x - cx) + math.cos(yaw) * (y - cy)
    return (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)


class ScanEnv(EnvBase):
    """A sensor that drives in a curve past two boxes and, if asked, an object that moves ahead of it.

    Row ``i``'s episodes last ``3 + i % 3`` steps, so that rows are reset at different times; what a row sees depends on
    its label, its episode and its step alone.
    """

    batch_locked = True

    def __init__(
        self, labels: tuple[int, ...] = (0, 1), *, has_object: bool = True, dtype: torch.dtype = torch.float32
    ) -> None:
        rows = len(labels)
        super().__init__(batch_size=torch.Size([rows]))
        self.labels, self.has_object, self.dtype_ = labels, has_object, dtype
        self.episode, self.time = np.zeros(rows, dtype=int), np.zeros(rows, dtype=int)
        leaves = {
            "scan": Bounded(0.0, MAX_RANGE, shape=(rows, NUM_RAYS), dtype=dtype),
            "sensor_pose": Unbounded(shape=(rows, 3), dtype=dtype),
        }
        if has_object:
            leaves |= {
                "object_pose": Unbounded(shape=(rows, 3), dtype=dtype),
                "object_size": Unbounded(shape=(rows, 2), dtype=dtype),
            }
        self.observation_spec = Composite(leaves, shape=(rows,))
        self.action_spec = Bounded(-1.0, 1.0, shape=(rows, 1))
        self.reward_spec = Unbounded(shape=(rows, 1))
        flag = {name: Binary(n=1, shape=(rows, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(flag, shape=(rows,))

    def situation(self, row: int) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
        """Return scan, sensor pose and object of a row."""
        label, episode, time = self.labels[row], int(self.episode[row]), int(self.time[row])
        pose = np.array([0.13 * time + 0.3 * label, 0.21 * episode - 0.17 * label, 0.4 * label + 0.11 * time + 0.05])
        ahead = np.array([math.cos(pose[2]), math.sin(pose[2])]) * 1.6
        box = (pose[0] + ahead[0], pose[1] + ahead[1], 0.3 + 0.1 * time, 0.75, 0.5)
        walls = [(4.0 + label, 1.0, 0.5, 1.0, 0.6), (-2.03, -3.04 + 0.5 * episode, 0.0, 0.4, 0.4)]
        return cast_rays(np.array([*walls, *([box] if self.has_object else [])]), pose), pose, box

    def _emit(self) -> TensorDict:
        scan, pose, box = (np.stack(part) for part in zip(*map(self.situation, range(len(self.labels))), strict=True))
        out = {"scan": scan, "sensor_pose": pose}
        if self.has_object:
            out |= {"object_pose": box[:, :3], "object_size": box[:, 3:]}
        return TensorDict(
            {key: torch.tensor(value, dtype=self.dtype_) for key, value in out.items()}, batch_size=self.batch_size
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = np.ones(len(self.labels), dtype=bool) if mask is None else mask.numpy().reshape(-1)
        self.episode[rows] += 1
        self.time[rows] = 0
        return self._emit()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self.time += 1
        done = torch.tensor([[t >= 3 + label % 3] for t, label in zip(self.time, self.labels, strict=True)])
        ends = {"done": done, "truncated": done, "terminated": torch.zeros_like(done)}
        return self._emit().update({"reward": torch.zeros(len(self.labels), 1), **ends})

    def _set_seed(self, seed: int | None) -> None:
        pass
