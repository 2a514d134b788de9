"""How much a policy looks: what is seen ahead of the object, how soon obstacles are, how far the base moves aside."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import torch

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import MapConfig
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.envs.sensors.lidar import ray_angles
from cura_torchrl.envs.transforms import ConfidenceMap

if TYPE_CHECKING:
    from tensordict import TensorDictBase
    from torchrl.envs import TransformedEnv

    from cura_torchrl.envs.config import LidarConfig

SIGHT_MAP = "sight_map"
"""Key of the map that looking is measured by: that of alpha = 0.9, whatever the policy's own map is."""
_MAP = MapConfig(decay=0.9)
MOVING = 0.2
"""Speed above which the object counts as moving [m/s]."""
AHEAD = 2.5
"""How far past the object's face the area ahead of it reaches [m]."""
MARGIN = 0.3
"""How much wider than the object, on either side, the area ahead of it is [m]."""
_HIT = 0.06
"""How far from an obstacle's outline a ray that hit it may end [m]: six deviations of the LiDAR's noise."""


def sight_map(lidar: LidarConfig) -> ConfidenceMap:
    """Return the transform that :class:`LookingMeter` needs, to append to an environment.

    Args:
        lidar: The environment's LiDAR.

    Returns:
        Map of the paper's alpha = 0.9 under :data:`SIGHT_MAP`: comparable between methods whose own maps differ.
    """
    return ConfidenceMap(_MAP, num_rays=lidar.num_rays, max_range=lidar.max_range, out_key=SIGHT_MAP)


def unseen_ahead(
    maps: torch.Tensor, centre: torch.Tensor, half: torch.Tensor, ahead: torch.Tensor, resolution: float
) -> torch.Tensor:
    """Return the mean of 1 - M over the area ahead of the object.

    Args:
        maps: Windows of the map, shape ``[N, C, W, W]``; the first channel is the confidence M.
        centre: Object's centre, base frame [m], shape ``[N, 2]``.
        half: Half its edge [m], shape ``[N, 1]``.
        ahead: Unit vector to where it goes, base frame [1], shape ``[N, 2]``.
        resolution: Edge of a cell [m].

    Returns:
        What has not been seen lately of the :data:`AHEAD` metres past its face, :data:`MARGIN` wider than it is, 0 to 1
        [1], shape ``[N]``.

    Examples:
        >>> seen = torch.ones(1, 2, 100, 100)
        >>> unseen_ahead(seen, torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5]]), torch.tensor([[1.0, 0.0]]), 0.1)
        tensor([0.])
    """
    left = torch.stack([-ahead[:, 1], ahead[:, 0]], dim=-1)
    along = torch.linspace(0.05, AHEAD, 25)[None, :, None, None]
    across = torch.linspace(-1.0, 1.0, 13)[None, None, :, None] * (half + MARGIN)[:, None, None]
    points = centre[:, None, None] + (half[:, None, None] + along) * ahead[:, None, None] + across * left[:, None, None]
    size = maps.shape[-1]
    cell = (points / resolution + size / 2).long().clamp(0, size - 1)
    rows = torch.arange(len(maps))[:, None, None]
    return 1.0 - maps[rows, 0, cell[..., 0], cell[..., 1]].mean((1, 2))


def obstacles_hit(
    scan: torch.Tensor, sensor_pose: torch.Tensor, obstacles: torch.Tensor, max_range: float
) -> torch.Tensor:
    """Tell which obstacles a scan has hit.

    Args:
        scan: Ranges [m], shape ``[N, R]``.
        sensor_pose: Sensor (x [m], y [m], yaw [rad]), world frame, shape ``[N, 3]``.
        obstacles: As under :data:`cura_torchrl.keys.OBSTACLES`, shape ``[N, M, 4]``.
        max_range: What a miss reads [m].

    Returns:
        Whether a ray ends on the obstacle, bool, shape ``[N, M]``.
    """
    angle = ray_angles(scan.shape[-1]).float() + sensor_pose[:, 2:]
    ends = sensor_pose[:, None, :2] + scan[..., None] * torch.stack([angle.cos(), angle.sin()], dim=-1)
    ends = ends[:, None].expand(-1, obstacles.shape[1], -1, -1)
    local = geometry.to_frame(obstacles[:, :, None, :3].expand(*ends.shape[:-1], 3), ends).abs()
    off = (local - obstacles[:, :, None, 3:] / 2).clamp_min(0.0).amax(-1)
    hit = (off < _HIT) & (scan < max_range - _HIT)[:, None]
    return hit.any(-1) & (obstacles[..., 3] > 0)


class Sightings:
    """When obstacles appear, and when a ray first hits them, in the episodes that N worlds play.

    Args:
        max_range: What a ray of the LiDAR that hits nothing reads [m].
    """

    def __init__(self, max_range: float) -> None:
        self._max_range = max_range
        self._episode = torch.empty(0)
        self._elapsed = torch.empty(0)
        self.appeared = torch.empty(0)
        """Policy step of the episode in which each obstacle appeared [1], NaN before, shape ``[N, M]``."""
        self.seen = torch.empty(0)
        """Policy step in which a ray first hit it [1], NaN before, shape ``[N, M]``."""
        self.is_fresh = torch.empty(0, dtype=torch.bool)
        """Rows in which the last state was the first of an episode, bool, shape ``[N]``."""

    @property
    def is_known(self) -> torch.Tensor:
        """Whether a ray has hit each obstacle, bool, shape ``[N, M]``."""
        return self.seen.isfinite()

    def update(self, state: TensorDictBase, playing: torch.Tensor) -> torch.Tensor:
        """Note what a state says.

        Args:
            state: What the environment emits, with the true obstacles, batch size ``[N]``.
            playing: Rows that count, bool, shape ``[N]``.

        Returns:
            Which obstacles are hit for the first time, bool, shape ``[N, M]``.
        """
        obstacles, elapsed, episode = state[keys.OBSTACLES], state[keys.ELAPSED_STEPS].float(), state[keys.EPISODE]
        if self._episode.shape != episode.shape:
            self._episode, self._elapsed = torch.full_like(episode, -1), elapsed
            self.appeared = torch.full_like(obstacles[..., 0], torch.nan)
            self.seen = self.appeared
        fresh = (episode != self._episode) | (elapsed < self._elapsed)
        self._episode, self._elapsed, self.is_fresh = episode.clone(), elapsed, fresh[:, 0]
        is_there = playing[:, None] & (obstacles[..., 3] > 0)
        appeared, seen = (times.masked_fill(fresh, torch.nan) for times in (self.appeared, self.seen))
        self.appeared = torch.where(is_there & appeared.isnan(), elapsed, appeared)
        rows, slots = (is_there & seen.isnan()).nonzero(as_tuple=True)
        first = torch.zeros_like(is_there)
        if len(rows):
            scan, pose = state[keys.SCAN][rows], state[keys.SENSOR_POSE][rows]
            first[rows, slots] = obstacles_hit(scan, pose, obstacles[rows, slots][:, None], self._max_range)[:, 0]
        self.seen = torch.where(first, elapsed, seen)
        return first


class LookingMeter:
    """Measure how much is looked while episodes are played, as the ``watch`` of :func:`~.episodes.play_episodes`.

    Args:
        env: Environment with ``TaskConfig.privileged``; a map is appended to it.
        lidar: Its LiDAR.
        period: Time of a policy step [s].
    """

    def __init__(self, env: TransformedEnv, lidar: LidarConfig, period: float) -> None:
        env.append_transform(sight_map(lidar))
        self._period = period
        self._sightings = Sightings(lidar.max_range)
        self._notes: dict[str, list[tuple[torch.Tensor, torch.Tensor]]] = defaultdict(list)

    def watch(self, state: TensorDictBase, playing: torch.Tensor) -> None:
        """Note what a state says.

        Args:
            state: What the environment emits, batch size ``[N]``.
            playing: Rows that count, bool, shape ``[N]``.
        """
        parts = {name: state[keys.OBSERVATION][:, part] for name, part in OBSERVATION_SLICES.items()}
        centre, velocity = parts["object_position"][:, :2], parts["object_velocity"]
        speed, episode = geometry.norm(velocity), state[keys.EPISODE][:, 0]
        moves = playing & (speed > MOVING)
        ahead = velocity / speed.clamp_min(1e-6)[:, None]
        self._notes["object_speed"].append((speed[playing], episode[playing]))
        beside = (ahead[:, 0] * centre[:, 1] - ahead[:, 1] * centre[:, 0]).abs()
        self._notes["beside_m"].append((beside[moves], episode[moves]))
        half = parts["object_position"][:, 2:]
        moving = (state[SIGHT_MAP][moves], centre[moves], half[moves], ahead[moves])
        unseen = unseen_ahead(*moving, _MAP.resolution)
        area = AHEAD * 2.0 * (half[moves, 0] + MARGIN)
        self._notes["unseen_ahead"].append((unseen, episode[moves]))
        self._notes["seen_ahead_m2"].append(((1.0 - unseen) * area, episode[moves]))
        self._note_sightings(state, playing)

    def _note_sightings(self, state: TensorDictBase, playing: torch.Tensor) -> None:
        first = self._sightings.update(state, playing)
        wait = self._period * (self._sightings.seen - self._sightings.appeared)
        away = geometry.norm(state[keys.OBSTACLES][..., :2] - state[keys.OBJECT_POSE][:, None, :2])
        episode = state[keys.EPISODE].expand_as(first)[first]
        self._notes["first_seen_s"].append((wait[first], episode))
        self._notes["first_seen_m"].append((away[first], episode))

    def samples(self) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return what was noted, and in which episode.

        Returns:
            By measure the values and the episodes' indices, both of shape ``[M]``: ``object_speed`` [m/s] in every
            state; while the object moves, ``beside_m``, how far the base is beside its way, ``unseen_ahead``, the
            unseen share of the area ahead [1], and ``seen_ahead_m2``, the seen part of it, each cell weighted by its
            confidence; for every obstacle that is ever hit by a ray, ``first_seen_s``, the time from its appearance to
            the first hit, and ``first_seen_m``, the object's distance from it then.
        """
        return {
            name: (torch.cat([value for value, _ in notes]), torch.cat([owner for _, owner in notes]))
            for name, notes in self._notes.items()
        }

    def summary(self) -> dict[str, float]:
        """Return the measures.

        Returns:
            ``object_speed`` [m/s]; while the object moves, how far the base is beside its way, median and 90 % quantile
            [m], and the mean unseen share of the area ahead [1]; time from an obstacle's appearance to the first ray
            that hits it, mean [s], and the object's distance from it then, mean [m].
        """
        found = {name: values for name, (values, _) in self.samples().items()}
        return {
            "object_speed": found["object_speed"].mean().item(),
            "beside_median_m": found["beside_m"].quantile(0.5).item(),
            "beside_q90_m": found["beside_m"].quantile(0.9).item(),
            "unseen_ahead": found["unseen_ahead"].mean().item(),
            "first_seen_s": found["first_seen_s"].mean().item(),
            "first_seen_m": found["first_seen_m"].mean().item(),
        }
