"""How scripted pushers push: with the hand of an arm, or with the front face of a bare base."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch

from cura_torchrl.envs import geometry

if TYPE_CHECKING:
    from collections.abc import Callable

    from cura_torchrl.envs.config import RobotConfig, RobotName

    KeepClear = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]
    """From centres ``[N, 2]`` and radii [m] ``[N]`` of discs and their velocities, velocities that hit nothing."""

CHASSIS_RADIUS = 0.6
"""Radius of a disc that all but the corners of the chassis lie in [m]."""

_NEAR = 0.1
"""Gap between hand and face below which they count as touching [m]."""

_RUDDER = 2.0
"""Rate at which the line from hand to object is turned towards the goal, per angle [1/s]."""


@dataclass(frozen=True)
class Situation:
    """What a pusher looks at, base frame."""

    tcp: torch.Tensor
    """TCP [m], shape ``[*, 2]``."""
    centre: torch.Tensor
    """Object's centre [m], shape ``[*, 2]``."""
    heading: torch.Tensor
    """Cosine and sine of four times the object's yaw [1], shape ``[*, 2]``."""
    half: torch.Tensor
    """Half the object's edge [m], shape ``[*, 1]``."""
    distance: torch.Tensor
    """Distance from the object to where it should go [m], shape ``[*, 1]``."""
    along: torch.Tensor
    """Unit vector to where it should go [1], shape ``[*, 2]``."""
    top_speed: float
    """Pushing speed [m/s]."""

    @property
    def offset(self) -> torch.Tensor:
        """Object's centre from the TCP [m], shape ``[*, 2]``."""
        return self.centre - self.tcp

    @property
    def turn(self) -> torch.Tensor:
        """Angle from the base's x axis to where the object should go [rad], shape ``[*, 1]``."""
        return geometry.angle_of(self.along)[..., None]

    @property
    def speed(self) -> torch.Tensor:
        """Speed that is right so near to the goal [m/s], shape ``[*, 1]``."""
        return torch.minimum(torch.full_like(self.distance, self.top_speed), 0.12 + 1.2 * self.distance)


class PushingSkill(Protocol):
    """How a robot pushes."""

    def velocity(self, at: Situation) -> torch.Tensor:
        """Return the velocity of the TCP, base frame [m/s], shape ``[*, 2]``."""
        ...

    def share(self, at: Situation, velocity: torch.Tensor, keep_clear: KeepClear) -> torch.Tensor:
        """Return the action for a velocity of the TCP ``[*, 2]`` [m/s], shape ``[*, A]``."""
        ...


class HandSkill:
    """Push with the hand's tip: where it touches and where it goes steer the object as a rudder does.

    Args:
        robot: Limits that actions are shares of.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self._robot = robot

    def velocity(self, at: Situation) -> torch.Tensor:
        """Return where the hand should move.

        Args:
            at: Robot, object and where it should go.

        Returns:
            Velocity of the TCP, base frame [m/s], shape ``[*, 2]``.
        """
        offset, along, half = at.offset, at.along, at.half
        reach = offset.norm(dim=-1, keepdim=True)
        ahead, aside = _components(offset, along)
        gap = reach - _face_distance(offset, at.heading, half)
        # Behind the object the hand pushes; beside it, it comes round. Once it is off the object it has to be well
        # behind: else it would meet the same face at the same place again.
        behind = (ahead > 0.0) & (aside.abs() < torch.where(gap > _NEAR, 0.35, 0.7) * half)
        direction = offset / reach.clamp_min(1e-6)
        push = _push(direction, reach, torch.atan2(aside, ahead), gap, at.speed)
        return torch.where(behind, push, _come_round(direction, along, ahead, aside, gap, half))

    def share(self, at: Situation, velocity: torch.Tensor, keep_clear: KeepClear) -> torch.Tensor:
        """Return the action for a TCP velocity: the base carries it, the arm returns to its middle.

        Args:
            at: Robot, object and where it should go.
            velocity: Velocity of the TCP, base frame [m/s], shape ``[*, 2]``.
            keep_clear: What keeps the chassis from obstacles.

        Returns:
            Action [1], shape ``[*, 6]``.
        """
        tcp, turn = at.tcp, at.turn
        spin = (1.2 * turn).clamp(-0.6, 0.6)
        home = tcp.new_tensor([0.9, 0.0])
        arm = (1.0 * (home - tcp)).clamp(-0.2, 0.2)
        base = _base_action(self._robot, velocity - _carried(spin, tcp) - arm, spin, keep_clear)
        lift = torch.zeros_like(turn)
        return torch.cat([base, arm / self._robot.max_tcp_speed, lift], dim=-1)


_ENGAGED_ASIDE, _ENGAGED_TURN = 0.3, 1.1
"""How far the object may be off the middle of the face [m], and the goal off its normal [rad], while it is pushed."""

_LINED_UP_ASIDE, _LINED_UP_TURN = 0.12, 0.35
"""The same before the face closes in on the object."""


class FaceSkill:
    """Push with the chassis' front: the object's face lies flat against it, sticks, and turns as the robot turns.

    Args:
        robot: Limits that actions are shares of.
    """

    def __init__(self, robot: RobotConfig) -> None:
        self._robot = robot

    def velocity(self, at: Situation) -> torch.Tensor:
        """Return where the face's centre should move.

        Args:
            at: Robot, object and where it should go.

        Returns:
            Velocity, base frame [m/s], shape ``[*, 2]``.
        """
        ahead, left = at.offset[..., :1], at.offset[..., 1:]
        gap = ahead - _half_extent(at.heading, at.half)
        is_near = gap < _NEAR
        aside, turn = (torch.where(is_near, *pair) for pair in (
            (torch.full_like(gap, _ENGAGED_ASIDE), torch.full_like(gap, _LINED_UP_ASIDE)),
            (torch.full_like(gap, _ENGAGED_TURN), torch.full_like(gap, _LINED_UP_TURN)),
        ))  # fmt: skip
        engages = (ahead > 0.0) & (left.abs() < aside) & (at.turn.abs() < turn)
        # The robot turns about the object's centre, which so moves straight ahead and does not slip along the face.
        forward = at.speed * at.turn.cos().clamp_min(0.3)
        forward = torch.where(is_near, forward, torch.minimum(forward, 0.2 + gap.clamp_min(0.0)))
        swing = torch.where(is_near, 0.0, (2.0 * left).clamp(-0.3, 0.3)) - self._spin(at) * ahead
        push = torch.cat([forward, swing], dim=-1)
        return torch.where(engages, push, self._come_round(at, is_near & (ahead > 0.0)))

    def _come_round(self, at: Situation, is_near: torch.Tensor) -> torch.Tensor:
        """Return the velocity that leads behind the object: off it first, for the face would drag it along."""
        ahead, aside = _components(at.offset, at.along)
        clear = 1.42 * at.half + 0.2
        retreat = (1.5 * (ahead - clear)).clamp(-0.6, 0.3)
        # Half a chassis' width beside the object there is room to go back; sideways only once it is ahead.
        is_behind = ahead > clear - 0.1
        round_it = retreat * at.along + torch.where(is_behind, 2.0 * aside, 0.0).clamp(-0.5, 0.5) * _left(at.along)
        back = torch.cat([torch.full_like(ahead, -0.5), torch.zeros_like(ahead)], dim=-1)
        return torch.where(is_near, back, round_it)

    def _spin(self, at: Situation) -> torch.Tensor:
        return (1.2 * at.turn).clamp(-0.4, 0.4)

    def share(self, at: Situation, velocity: torch.Tensor, keep_clear: KeepClear) -> torch.Tensor:
        """Return the action for a velocity of the face's centre.

        Args:
            at: Robot, object and where it should go.
            velocity: Velocity of the face's centre, base frame [m/s], shape ``[*, 2]``.
            keep_clear: What keeps the chassis from obstacles.

        Returns:
            Action [1], shape ``[*, 3]``.
        """
        spin = self._spin(at)
        return _base_action(self._robot, velocity - _carried(spin, at.tcp), spin, keep_clear)


SKILLS: dict[RobotName, type[HandSkill | FaceSkill]] = {"ridgeback_franka": HandSkill, "ridgeback": FaceSkill}
"""How each robot pushes."""


def _base_action(robot: RobotConfig, velocity: torch.Tensor, spin: torch.Tensor, keep_clear: KeepClear) -> torch.Tensor:
    """Return the base's share of an action ``[*, 3]``, within its limits, from velocity [m/s] and yaw rate [rad/s]."""
    radius = torch.full_like(spin[..., 0], CHASSIS_RADIUS)
    base = keep_clear(torch.zeros_like(velocity), radius, velocity)
    base = base / robot.max_base_speed
    base = base / base.norm(dim=-1, keepdim=True).clamp_min(1.0)
    return torch.cat([base, spin / robot.max_base_yaw_rate], dim=-1)


def _carried(spin: torch.Tensor, point: torch.Tensor) -> torch.Tensor:
    """Return the velocity of a point of the base [m], base frame [m/s], by turning alone ``[*, 2]``."""
    return torch.cat([-spin * point[..., 1:], spin * point[..., :1]], dim=-1)


def _push(
    direction: torch.Tensor, reach: torch.Tensor, error: torch.Tensor, gap: torch.Tensor, speed: torch.Tensor
) -> torch.Tensor:
    """Return the hand's velocity behind the object.

    The hand sticks to the face, so the object follows the line from the hand through its centre, and turns with what
    the hand moves across that line. So the line is turned towards the goal as by a rudder.
    """
    forward = speed * error.cos().clamp_min(0.3)
    forward = torch.where(gap > _NEAR, torch.minimum(forward, 0.2 + gap), forward)
    rudder = (_RUDDER * reach * error).clamp(-0.4, 0.4)
    return forward * direction + rudder * _left(direction)


def _come_round(
    direction: torch.Tensor,
    along: torch.Tensor,
    ahead: torch.Tensor,
    aside: torch.Tensor,
    gap: torch.Tensor,
    half: torch.Tensor,
) -> torch.Tensor:
    """Return the hand's velocity beside the object: off it first, for it would drag it along, then behind it."""
    retreat = (1.5 * (ahead - 1.25 * half - 0.1)).clamp(-0.6, 0.3)
    round_it = retreat * along + (4.0 * aside).clamp(-0.6, 0.6) * _left(along)
    return torch.where(gap > _NEAR, round_it, -0.5 * direction)


def _left(direction: torch.Tensor) -> torch.Tensor:
    return torch.stack([-direction[..., 1], direction[..., 0]], dim=-1)


def _components(vector: torch.Tensor, along: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a vector's components along a direction and to its left, shape ``[*, 1]`` each."""
    return (vector * along).sum(-1, keepdim=True), (vector * _left(along)).sum(-1, keepdim=True)


def _face_distance(offset: torch.Tensor, heading: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """Return how far a square's outline is from its centre, seen from a point [m], shape ``[*, 1]``.

    Args:
        offset: From the point to the centre [m], shape ``[*, 2]``.
        heading: Cosine and sine of four times the square's yaw [1], shape ``[*, 2]``.
        half: Half its edge [m], shape ``[*, 1]``.
    """
    yaw = torch.atan2(heading[..., 1], heading[..., 0]) / 4
    bearing = geometry.quarter_turn(geometry.angle_of(offset) - yaw)
    return half / bearing.cos()[..., None]


def _half_extent(heading: torch.Tensor, half: torch.Tensor) -> torch.Tensor:
    """Return how far a square reaches from its centre along the base's x axis [m], shape ``[*, 1]``.

    Args:
        heading: Cosine and sine of four times the square's yaw [1], shape ``[*, 2]``.
        half: Half its edge [m], shape ``[*, 1]``.
    """
    yaw = torch.atan2(heading[..., 1:], heading[..., :1]) / 4
    return half * (yaw.cos() + yaw.sin().abs())
