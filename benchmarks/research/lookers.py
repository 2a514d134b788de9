"""Scripted pushers that know only the obstacles that the LiDAR has hit: straight on, weaving, waiting, peeking."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from recording import PERIOD

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.robots import route
from cura_torchrl.envs.robots.scripted import ScriptedAvoider
from cura_torchrl.trainers.evaluation.active_perception import obstacles_hit

if TYPE_CHECKING:
    from tensordict import TensorDictBase

_PUSH, _OUT, _BACK = 0, 1, 2
"""What a peeking pusher does: push, move aside until it has seen enough, come back behind the object."""


class SeeingPusher(ScriptedAvoider):
    """Push along the shortest route around the obstacles that a ray has hit so far.

    One hit tells where the whole obstacle is and how large. Needs ``TaskConfig.privileged``, to know which it was.

    Args:
        max_range: What a ray that hits nothing reads [m].
        wait: Time that it stands still at the start [s].
        **options: Those of :class:`~cura_torchrl.envs.robots.scripted.ScriptedAvoider`.
    """

    def __init__(self, max_range: float = 10.0, *, wait: float = 0.0, **options: Any) -> None:
        super().__init__(**options)
        self.in_keys = [*self.in_keys, keys.SCAN, keys.ELAPSED_STEPS]
        self.max_range = max_range
        self.wait = wait
        self.known = torch.zeros(0, 6, dtype=torch.bool)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for every row.

        Args:
            tensordict: Holds the in_keys, batch ``[N]``.

        Returns:
            The same tensordict.
        """
        elapsed = tensordict[keys.ELAPSED_STEPS][:, 0]
        fresh = elapsed == 0 if len(self.known) == len(elapsed) else torch.ones_like(elapsed, dtype=torch.bool)
        self._forget(fresh)
        obstacles = tensordict[keys.OBSTACLES].clone()
        hit = obstacles_hit(tensordict[keys.SCAN], tensordict[keys.SENSOR_POSE], obstacles, self.max_range)
        self.known = self.known | hit
        obstacles[..., 3] *= self.known
        seen = super().forward(tensordict.copy().set(keys.OBSTACLES, obstacles))
        waits = (elapsed * PERIOD < self.wait)[:, None]
        return tensordict.set(keys.ACTION, torch.where(waits, 0.0, seen[keys.ACTION]))

    def _forget(self, rows: torch.Tensor) -> None:
        """Begin new episodes in the rows of a mask, which has a new length if the batch has."""
        if len(self.known) != len(rows):
            self.known = torch.zeros(len(rows), 6, dtype=torch.bool)
        self.known[rows] = False


class WeavingPusher(SeeingPusher):
    """Push to the left and to the right of the route in turn, so that the object's shadow sweeps.

    Args:
        angle: Largest angle between the pushing direction and the route [rad].
        turn: Time of a whole weave [s].
        **options: Those of :class:`SeeingPusher`.
    """

    def __init__(self, *, angle: float = 0.6, turn: float = 6.0, **options: Any) -> None:
        super().__init__(**options)
        self.angle = angle
        self.turn = turn

    def _waypoint(self, tensordict: TensorDictBase, parts: dict[str, torch.Tensor]) -> torch.Tensor:
        ahead = super()._waypoint(tensordict, parts)
        centre = parts["object_position"][..., :2]
        phase = tensordict[keys.ELAPSED_STEPS][:, 0] * (2.0 * torch.pi * PERIOD / self.turn)
        # Not beside an obstacle that it knows, and not on the last metre.
        is_there = self._obstacles_b[..., 3] > 0
        gap = geometry.norm(self._obstacles_b[..., :2] - centre[:, None]).masked_fill(~is_there, 99.0).amin(-1)
        is_open = (gap > 2.2) & (geometry.norm(parts["goal_position"] - centre) > 1.5)
        return centre + geometry.rotate(ahead - centre, self.angle * phase.sin() * is_open)


class SwingingPusher(SeeingPusher):
    """Push on while the base swings about the hand to either side, from where the LiDAR sees past the object.

    The base drives in any direction and the hand turns against it, so that it costs no contact.

    Args:
        angle: Largest angle between the base's heading and the pushing direction [rad].
        turn: Time of a whole swing, to both sides [s].
        **options: Those of :class:`SeeingPusher`.
    """

    def __init__(self, *, angle: float = 1.05, turn: float = 6.0, **options: Any) -> None:
        super().__init__(**options)
        self.angle = angle
        self.turn = turn
        self._swing = torch.zeros(0)

    def _waypoint(self, tensordict: TensorDictBase, parts: dict[str, torch.Tensor]) -> torch.Tensor:
        phase = tensordict[keys.ELAPSED_STEPS] * (2.0 * torch.pi * PERIOD / self.turn)
        self._swing = self.angle * phase.sin()
        return super()._waypoint(tensordict, parts)

    def _share(self, tcp: torch.Tensor, velocity: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        return super()._share(tcp, velocity, turn + self._swing)


class PeekingPusher(SeeingPusher):
    """Leave the object and look past it whenever the route ahead has not been seen for a while, then push on.

    Args:
        stale: Age from which on what was seen does not count any more [s].
        reach: How far along the route from the object's centre it has to have been seen [cells of the route].
        tolerated: Share of the route ahead that may be unseen [1].
        patience: Longest time that it looks [s].
        pause: Least time between two looks [s].
        **options: Those of :class:`SeeingPusher`.
    """

    def __init__(
        self,
        *,
        stale: float = 5.0,
        reach: int = 15,
        tolerated: float = 0.3,
        patience: float = 4.0,
        pause: float = 2.0,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.stale, self.reach, self.tolerated = stale, reach, tolerated
        self.patience, self.pause = patience, pause
        self._mode = torch.zeros(0, dtype=torch.int64)

    def _forget(self, rows: torch.Tensor) -> None:
        if len(self._mode) != len(rows):
            self._mode, self._since = torch.zeros(len(rows), dtype=torch.int64), torch.zeros(len(rows))
            self._seen_at = torch.zeros(len(rows), *route.cell_centres().shape[:2])
            self._axis, self._side = torch.zeros(len(rows), 2), torch.ones(len(rows))
        self._mode[rows], self._since[rows], self._seen_at[rows] = _PUSH, self.pause, -1e3
        super()._forget(rows)

    def _waypoint(self, tensordict: TensorDictBase, parts: dict[str, torch.Tensor]) -> torch.Tensor:
        ahead = super()._waypoint(tensordict, parts)
        base = tensordict[keys.SENSOR_POSE]
        time = tensordict[keys.ELAPSED_STEPS][:, 0] * PERIOD
        self._seen_at = torch.where(self._visible(tensordict), time[:, None, None], self._seen_at)
        unseen = self._unseen(base, parts, time)
        is_far = geometry.norm(parts["goal_position"] - parts["object_position"][..., :2]) > 1.5
        is_waiting = time < self.wait
        starts = (self._mode == _PUSH) & (unseen > self.tolerated) & (self._since >= self.pause) & is_far & ~is_waiting
        stops = (self._mode == _OUT) & ((unseen <= 0.05) | (self._since >= self.patience))
        returned = (self._mode == _BACK) & (self._is_behind(base, parts) | (self._since >= self.patience))
        self._choose(starts, base, parts, ahead)
        self._since = torch.where(starts | stops | returned, 0.0, self._since + PERIOD)
        self._mode = (self._mode + starts.long() + stops.long()) * ~returned
        return ahead

    def _choose(
        self, rows: torch.Tensor, base: torch.Tensor, parts: dict[str, torch.Tensor], ahead: torch.Tensor
    ) -> None:
        """Set the direction of the route and the side to look from, where a look starts."""
        centre = parts["object_position"][..., :2]
        axis = ahead - centre
        axis = axis / geometry.norm(axis)[:, None].clamp_min(1e-6)
        left = torch.stack([-axis[:, 1], axis[:, 0]], dim=-1)
        room = []
        for side in (1.0, -1.0):
            place = centre + side * self._aside(parts)[:, None] * left
            gap = geometry.norm(self._obstacles_b[..., :2] - place[:, None]) - self._obstacles_b[..., 3]
            room.append(gap.masked_fill(self._obstacles_b[..., 3] == 0, 2.0).amin(-1).clamp_max(2.0))
        # The nearer side where there is room on both: the base is seldom right behind.
        nearer = (-(centre * left).sum(-1)).clamp(-0.5, 0.5)
        side = torch.where(room[0] - room[1] + nearer >= 0, 1.0, -1.0)
        self._axis = torch.where(rows[:, None], geometry.rotate(axis, base[:, 2]), self._axis)
        self._side = torch.where(rows, side, self._side)

    def _aside(self, parts: dict[str, torch.Tensor]) -> torch.Tensor:
        return 1.2 * parts["object_position"][..., 2] + 0.75

    def _visible(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Return which cells of the route's grid the scan reaches, bool, ``[N, W, H]``."""
        scan, pose = tensordict[keys.SCAN], tensordict[keys.SENSOR_POSE]
        offset = route.cell_centres() - pose[:, None, None, :2]
        bearing = geometry.wrap_angle(geometry.angle_of(offset) - pose[:, 2, None, None]) + torch.pi
        ray = (bearing * (scan.shape[-1] / (2 * torch.pi))).round().long() % scan.shape[-1]
        return geometry.norm(offset) < scan.gather(1, ray.flatten(1)).view_as(ray) + 0.1

    def _unseen(self, base: torch.Tensor, parts: dict[str, torch.Tensor], time: torch.Tensor) -> torch.Tensor:
        """Return the share of the route ahead of the object that has not been seen lately, ``[N]``."""
        half = parts["object_position"][..., 2]
        centre = geometry.from_frame(base, parts["object_position"][..., :2])
        rows, point, stale, counts = torch.arange(len(base)), centre, torch.zeros_like(half), torch.zeros_like(half)
        for _ in range(0, self.reach, 3):
            before, point = point, route.follow(self._value, point, 3)
            step = point - before
            left = torch.stack([-step[:, 1], step[:, 0]], dim=-1) / geometry.norm(step)[:, None].clamp_min(0.1)
            for across in (-0.8, 0.0, 0.8):
                place = point + across * half[:, None] * left
                counted = geometry.norm(place - centre) > 1.42 * half + 0.2
                column, row = route.cell_of(place)
                stale = stale + (counted & (time - self._seen_at[rows, column, row] > self.stale))
                counts = counts + counted
        return stale / counts.clamp_min(1)

    def _is_behind(self, base: torch.Tensor, parts: dict[str, torch.Tensor]) -> torch.Tensor:
        axis = geometry.rotate(self._axis, -base[:, 2])
        offset = parts["object_position"][..., :2] - parts["tcp_position"][..., :2]
        aside = geometry.dot(offset, torch.stack([-axis[:, 1], axis[:, 0]], dim=-1))
        half = parts["object_position"][..., 2]
        return (geometry.dot(offset, axis) > half) & (aside.abs() < 0.35 * half)

    def _action(self, parts: dict[str, torch.Tensor], waypoint: torch.Tensor) -> torch.Tensor:
        looks = (self._mode != _PUSH)[:, None]
        return torch.where(looks, self._look(parts, waypoint), super()._action(parts, waypoint))

    def _look(self, parts: dict[str, torch.Tensor], waypoint: torch.Tensor) -> torch.Tensor:
        """Return the action that takes the base to where it looks from, or back behind the object."""
        centre, half = parts["object_position"][..., :2], parts["object_position"][..., 2:]
        tcp = parts["tcp_position"][..., :2]
        axis = waypoint - centre
        axis = axis / geometry.norm(axis)[:, None].clamp_min(1e-6)
        left = torch.stack([-axis[:, 1], axis[:, 0]], dim=-1)
        beside = centre + (self._side * self._aside(parts))[:, None] * left
        behind = centre - (half + 1.2) * axis
        place = torch.where((self._mode == _OUT)[:, None], beside, behind)
        velocity = 2.0 * place
        velocity = velocity / (geometry.norm(velocity)[:, None] / 0.75).clamp_min(1.0)
        yaw = torch.atan2(parts["object_heading"][..., 1], parts["object_heading"][..., 0]) / 4
        box = torch.cat([centre, yaw[:, None], 2.0 * half], dim=-1)[:, None]
        velocity = self._off(box, tcp, 0.15, velocity)
        velocity = self._off(torch.cat([box, self._obstacles_b], dim=1), torch.zeros_like(tcp), 0.6, velocity)
        base = velocity / self.robot.max_base_speed
        base = base / geometry.norm(base)[:, None].clamp_min(1.0)
        spin = (1.2 * geometry.angle_of(axis)).clamp(-0.6, 0.6)[:, None] / self.robot.max_base_yaw_rate
        arm = (tcp.new_tensor([0.9, 0.0]) - tcp).clamp(-0.2, 0.2) / self.robot.max_tcp_speed
        return torch.cat([base, spin, arm, torch.zeros_like(spin)], dim=-1)

    def _off(self, bodies: torch.Tensor, centre: torch.Tensor, radius: float, velocity: torch.Tensor) -> torch.Tensor:
        """Return the velocity of a disc less what would bring it into some bodies."""
        known, self._obstacles_b = self._obstacles_b, bodies
        kept = self._keep_clear(centre, torch.full_like(centre[:, 0], radius), velocity)
        self._obstacles_b = known
        return kept
