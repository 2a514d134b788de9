"""What is measured of an episode while it is played: clearance, errors, ways, and when its obstacles are seen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.mdp import scenarios
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.trainers.evaluation.active_perception import Sightings

if TYPE_CHECKING:
    from tensordict import TensorDictBase

_DIGITS = 6
"""Digits that are kept: states are float32."""


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What was measured of one episode, until its outcome unless said otherwise. None is what there was none of."""

    min_clearance: float | None
    """Least distance of chassis, arm and object from any obstacle [m]; None where none appeared."""
    goal_distance: float
    """Distance from object to goal at the end of the episode [m], which goes on for a while after a success."""
    yaw_error: float
    """Angle between object and goal at the end of the episode, modulo a quarter turn, 0 to pi/4 [rad]."""
    base_path: float
    """Length of the base's path [m]."""
    object_path: float
    """Length of the object's path [m]."""
    obstacles: int
    """Obstacles that appeared [1]."""
    obstacles_unseen: int
    """Those of them that no ray hit [1]."""
    first_sighting: float | None
    """Time at which a ray first hit an obstacle [s]; None where none did."""
    mean_delay: float | None
    """Time from an obstacle's appearance to the first ray that hits it, mean over those that are hit [s]."""
    longest_delay: float | None
    """The longest of these times [s]."""


def clearance(pose: torch.Tensor, half: torch.Tensor, obstacles: torch.Tensor) -> torch.Tensor:
    """Return how far the nearest of three bodies is from an obstacle.

    Args:
        pose: The bodies' (x [m], y [m], yaw [rad]), shape ``[*, 3, 3]``.
        half: Their half extents [m], shape ``[*, 3, 2]``.
        obstacles: Obstacles (x [m], y [m], yaw [rad], edge [m]), edge 0 where there is none, shape ``[*, 4]``.

    Returns:
        Distances [m], zero where they overlap, infinite where there is no obstacle, shape ``[*]``.

    Examples:
        >>> pose, half = torch.zeros(3, 3), torch.full((3, 2), 0.5)
        >>> clearance(pose, half, torch.tensor([3.0, 0.0, 0.0, 1.0])).item()
        2.0
    """
    edge = obstacles[..., 3]
    square = (edge / 2)[..., None, None].expand(*edge.shape, 1, 2)
    distance = geometry.rectangle_distance(pose, half, obstacles[..., None, :3], square).amin(-1)
    return torch.where(edge > 0, distance, math.inf)


class EpisodeMeter:
    """Measures episodes that N worlds play side by side.

    Args:
        period: Time of a policy step [s].
        max_range: What a ray of the LiDAR that hits nothing reads [m].
    """

    def __init__(self, *, period: float, max_range: float) -> None:
        self._period = period
        self._sightings = Sightings(max_range)
        self._clearance = torch.empty(0)
        self._path = torch.empty(0)
        self._place = torch.empty(0)

    def watch(self, state: TensorDictBase, is_open: torch.Tensor) -> None:
        """Note what a state says; the first state of an episode, and every one that follows.

        Args:
            state: What the environment emits, with the true obstacles (``TaskConfig.privileged``), batch size ``[N]``.
            is_open: Rows whose episode had no outcome before this state, bool, shape ``[N]``.
        """
        place = torch.stack([state[keys.SENSOR_POSE][:, :2], state[keys.OBJECT_POSE][:, :2]], 1).double()
        self._sightings.update(state, is_open)
        if self._place.shape != place.shape:
            self._place, self._path = place, torch.zeros_like(place[..., 0])
            self._clearance = torch.full_like(self._path[:, 0], math.inf)
        fresh = self._sightings.is_fresh
        self._clearance = self._clearance.masked_fill(fresh, math.inf)
        way = geometry.norm(place - self._place)
        self._path = (self._path + torch.where(is_open[:, None], way, 0.0)).masked_fill(fresh[:, None], 0.0)
        self._place = place
        self._note_clearance(state, is_open)

    def measures(self, state: TensorDictBase, row: int) -> Measures:
        """Return what was measured of the episode that a row has played.

        Args:
            state: The episode's last state.
            row: The row.

        Returns:
            The measures.
        """
        goal, yaw = self._errors(state[row])
        appeared, seen = self._sightings.appeared[row], self._sightings.seen[row]
        delay = (seen - appeared)[seen.isfinite()] * self._period
        is_seen = len(delay) > 0
        nearest = float(self._clearance[row])
        base_path, object_path = self._path[row].tolist()
        return Measures(
            min_clearance=_rounded(nearest) if math.isfinite(nearest) else None,
            goal_distance=_rounded(goal),
            yaw_error=_rounded(yaw),
            base_path=_rounded(base_path),
            object_path=_rounded(object_path),
            obstacles=int(appeared.isfinite().sum()),
            obstacles_unseen=int((appeared.isfinite() & seen.isnan()).sum()),
            first_sighting=_rounded(float(seen[seen.isfinite()].min()) * self._period) if is_seen else None,
            mean_delay=_rounded(float(delay.mean())) if is_seen else None,
            longest_delay=_rounded(float(delay.max())) if is_seen else None,
        )

    def _note_clearance(self, state: TensorDictBase, is_open: torch.Tensor) -> None:
        obstacles = state[keys.OBSTACLES].double()
        base, reach = state[keys.SENSOR_POSE].double(), state[keys.OBSERVATION][:, OBSERVATION_SLICES["tcp_position"]]
        tcp = geometry.from_frame(base, reach[:, :2].double())
        pose, half = scenarios.bodies(
            base, tcp, state[keys.OBJECT_POSE].double(), state[keys.OBJECT_SIZE][:, 0].double()
        )
        # Circles around the shapes bound their distance from below: most obstacles are too far away to matter.
        apart = geometry.norm(pose[:, None, :, :2] - obstacles[:, :, None, :2]) - geometry.norm(half)[:, None]
        bound = apart.amin(-1) - obstacles[..., 3] * math.sqrt(0.5)
        near = is_open[:, None] & (obstacles[..., 3] > 0) & (bound < self._clearance[:, None])
        rows, slots = near.nonzero(as_tuple=True)
        if len(rows):
            distance = clearance(pose[rows], half[rows], obstacles[rows, slots])
            self._clearance = self._clearance.scatter_reduce(0, rows, distance, "amin")

    @staticmethod
    def _errors(last: TensorDictBase) -> tuple[float, float]:
        parts = {name: last[keys.OBSERVATION][part].double() for name, part in OBSERVATION_SLICES.items()}
        distance = geometry.norm(parts["goal_position"] - parts["object_position"][:2])
        goal, heading = (geometry.angle_of(parts[name]) for name in ("goal_heading", "object_heading"))
        return float(distance), float(geometry.quarter_turn((goal - heading) / 4).abs())


def _rounded(value: float) -> float:
    return round(value, _DIGITS)
