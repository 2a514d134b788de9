"""Planar pushing mechanics of N worlds: a cube on the floor, pushed by rectangles that the robot carries.

Everything is an impulse over one tick, found by projected Gauss-Seidel sweeps that start from the last tick's impulses:
the cube's four corners rub on the floor, and each pusher touches it in up to two points. As in :mod:`.contact` every
component is a tensor of its own, worlds last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from cura_torchrl.envs.simulation.contact import Rectangle, rectangle_manifold

if TYPE_CHECKING:
    from cura_torchrl.envs.config import PhysicsConfig

_CORNER_MASS = 1.0 / 14.0
"""Impulse per velocity of a corner in one sweep [cube masses].

All four corners change at once. A solid cube's turning answers impulses at its corners with 12 / mass, a little more
when its centre of mass is off the middle: a larger step would overshoot.
"""

_TOUCHING = 0.01
"""Gap below which a pusher takes part in the share of the cube's mass [m]."""

_TINY = 1e-12


@dataclass
class Cube:
    """The pushed cubes of N worlds, world frame. Positions and velocities are those of the centre of mass."""

    pose: torch.Tensor
    """Centre of mass (x [m], y [m]) and yaw [rad], shape ``[N, 3]``."""
    twist: torch.Tensor
    """Velocity (x [m/s], y [m/s], yaw [rad/s]), shape ``[N, 3]``."""
    edge: torch.Tensor
    """Edge [m], shape ``[N]``."""
    mass: torch.Tensor
    """Mass [kg], shape ``[N]``."""
    friction: torch.Tensor
    """Coulomb friction with the floor [1], shape ``[N]``."""
    com_offset: torch.Tensor
    """Centre of mass from the cube's centre, cube's frame [m], shape ``[N, 3]``."""

    @property
    def inertia(self) -> torch.Tensor:
        """Inertia about the vertical axis of a solid cube [kg m^2], shape ``[N]``."""
        return self.mass * self.edge**2 / 6


@dataclass
class Pushers:
    """Rectangles that push, B in each world, fixed to the robot."""

    rectangle: Rectangle
    """Where they are, components of shape ``[B, N]``."""
    height: torch.Tensor
    """Height at which they push [m], shape ``[B, N]``."""
    anchor: tuple[torch.Tensor, torch.Tensor]
    """Point that their twists are about, x and y [m], shape ``[B, N]`` each."""
    twist: torch.Tensor
    """Velocity (x, y, z [m/s], yaw [rad/s]) at the anchor, shape ``[4, B, N]``."""
    mobility: torch.Tensor
    """Change of twist (first dimension) for an impulse (x, y, z [N s], yaw [N m s]) there, shape ``[4, 4, B, N]``."""


class PushContact:
    """Impulses between cubes, floor and pushers.

    The floor carries the cube at its corners. Their loads balance the weight, the centre of mass's offset and the
    moments of the horizontal forces at their heights; of all such loads the most even ones are taken. Coulomb friction
    at the corners gives the limit surface of that support. The pushers' friction has a vertical part too.

    Args:
        num_worlds: Number of worlds N.
        num_pushers: Pushers B in each.
        physics: Clock, weight, friction, and the fields that begin with ``planar``.
        device: Where the tensors live.

    Source:
        Goyal, Ruina and Papadopoulos (1991), "Planar sliding with dry friction" (limit surface of a support of points);
        Catto (2005), "Iterative dynamics with temporal coherence" (sequential impulses, warm start).
    """

    def __init__(
        self, num_worlds: int, num_pushers: int, physics: PhysicsConfig, device: torch.device | None = None
    ) -> None:
        self._physics, self._period = physics, physics.planar_period

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(*shape, num_worlds, dtype=torch.float64, device=device)

        self._floor_impulse = zeros(2, 4)
        self._impulse = zeros(2, 3, num_pushers)  # at each point, on the cube: along the normal, to its left, up
        self._load = zeros(4)
        self._signs = torch.tensor([[0.5, -0.5, -0.5, 0.5], [0.5, 0.5, -0.5, -0.5]], dtype=torch.float64, device=device)

    def reset(self, rows: torch.Tensor, cube: Cube) -> None:
        """Forget the impulses of worlds; their cubes rest.

        Args:
            rows: Indices of the worlds, shape ``[B]``.
            cube: All cubes.
        """
        self._floor_impulse[..., rows] = 0.0
        self._impulse[..., rows] = 0.0
        self._load[:, rows] = (cube.mass * self._physics.gravity / 4)[rows]

    def state(self) -> tuple[torch.Tensor, ...]:
        """Return what a tick changes, beside the cubes: it keeps its memory."""
        return self._floor_impulse, self._impulse, self._load

    def solve(self, cube: Cube, pushers: Pushers) -> torch.Tensor:
        """Change the cubes' twists by the impulses of one tick.

        Args:
            cube: The cubes; ``twist`` is changed in place.
            pushers: What pushes, with the twists that they would have without contact.

        Returns:
            Impulses on the pushers at their anchors (x, y, z [N s], yaw [N m s]), shape ``[4, B, N]``.
        """
        footprint = _Footprint(cube, self._signs)
        floor = _Floor(cube, footprint, cube.friction * self._load * self._period)
        touch = _Touch(cube, footprint, pushers, self._physics)
        twist, pusher_twist = cube.twist.T.contiguous(), pushers.twist
        rubbing = self._floor_impulse
        twist = floor.push(twist, rubbing)
        points: list[torch.Tensor] = list(self._impulse)
        for point, impulse in enumerate(points):
            twist, pusher_twist = touch.push(point, twist, pusher_twist, impulse)
        for _ in range(self._physics.planar_sweeps):
            last, rubbing = rubbing, floor.impulse(rubbing, twist)
            twist = floor.push(twist, rubbing - last)
            for point, before in enumerate(points):
                points[point] = touch.impulse(point, before, twist, pusher_twist)
                twist, pusher_twist = touch.push(point, twist, pusher_twist, points[point] - before)
        self._floor_impulse[...] = rubbing
        self._impulse[...] = torch.stack(points)
        cube.twist[...] = twist.T
        self._spread_load(cube, footprint, pushers.height, touch)
        return -touch.wrench(self._impulse)

    def _spread_load(self, cube: Cube, footprint: _Footprint, height: torch.Tensor, touch: _Touch) -> None:
        """Set the load on each corner from the forces of this tick [N]."""
        com_height = cube.edge / 2 + cube.com_offset[:, 2]
        level_x, level_y, lift = touch.forces(self._impulse)
        above = height - com_height
        rub_x, rub_y = self._floor_impulse.sum(1)
        lift_x, lift_y = ((lever * lift).sum((0, 1)) for lever in touch.levers)
        moment_x = (above * level_x.sum(0)).sum(0) - com_height * rub_x - lift_x
        moment_y = (above * level_y.sum(0)).sum(0) - com_height * rub_y - lift_y
        total = (cube.mass * self._physics.gravity - lift.sum((0, 1)) / self._period).clamp_min(0.0)
        about_x = moment_x / self._period + footprint.offset_x * total
        about_y = moment_y / self._period + footprint.offset_y * total
        share = (footprint.corner_x * about_x + footprint.corner_y * about_y) / cube.edge**2
        load = (total / 4 + share).clamp_min(0.0)
        self._load[...] = load * (total / load.sum(0).clamp_min(_TINY))


class _Footprint:
    """Where the cube stands: its rectangle, and its corners from its centre, world frame [m], ``[4, N]``."""

    def __init__(self, cube: Cube, signs: torch.Tensor) -> None:
        x, y, yaw = cube.pose.T
        cos, sin = yaw.cos(), yaw.sin()
        along, across, _ = cube.com_offset.T
        self.offset_x, self.offset_y = cos * along - sin * across, sin * along + cos * across
        half = cube.edge / 2
        self.rectangle = Rectangle(x - self.offset_x, y - self.offset_y, cos, sin, half, half)
        ahead, left = signs[:, :, None] * cube.edge
        self.corner_x, self.corner_y = cos * ahead - sin * left, sin * ahead + cos * left


class _Floor:
    """Friction at the cube's corners in one tick. Impulses ``[2, 4, N]``, the cube's twist ``[3, N]``."""

    def __init__(self, cube: Cube, footprint: _Footprint, limit: torch.Tensor) -> None:
        self._x, self._y = footprint.corner_x - footprint.offset_x, footprint.corner_y - footprint.offset_y
        self._limit, self._step = limit, _CORNER_MASS * cube.mass
        self._inverse = torch.stack([1 / cube.mass, 1 / cube.mass, 1 / cube.inertia])

    def impulse(self, impulse: torch.Tensor, twist: torch.Tensor) -> torch.Tensor:
        velocity = torch.stack([twist[0] - twist[2] * self._y, twist[1] + twist[2] * self._x])
        wanted = impulse - self._step * velocity
        size = _length(wanted[0], wanted[1]).clamp_min(_TINY)
        return wanted * (self._limit / size).clamp_max(1.0)

    def push(self, twist: torch.Tensor, impulse: torch.Tensor) -> torch.Tensor:
        turning = (self._x * impulse[1] - self._y * impulse[0]).sum(0, keepdim=True)
        return twist + self._inverse * torch.cat([impulse.sum(1), turning])


class _Touch:
    """Contact of the pushers with the cube in one tick. Impulses at a point ``[3, B, N]``: normal, left, up."""

    def __init__(self, cube: Cube, footprint: _Footprint, pushers: Pushers, physics: PhysicsConfig) -> None:
        contact = rectangle_manifold(pushers.rectangle, _expanded(footprint.rectangle, pushers.height))
        self._x, self._y = contact.normal_x, contact.normal_y
        own_x, own_y = contact.x - cube.pose[:, 0], contact.y - cube.pose[:, 1]
        far_x, far_y = contact.x - pushers.anchor[0], contact.y - pushers.anchor[1]
        self.levers = own_x, own_y  # from the cube's centre of mass [m], [2, B, N]
        self._far = far_x, far_y  # from the pusher's anchor
        self._friction, self._mobility = physics.hand_friction * cube.friction, pushers.mobility
        self._inverse_mass, self._inverse_inertia = 1 / cube.mass, 1 / cube.inertia
        # Pushers are swept at once: where several touch, each takes its share of the cube's mass.
        sharing = (contact.gap < _TOUCHING).any(0).sum(0).clamp_min(1)
        along = self._answer(self._x, self._y, sharing)
        beside = torch.maximum(self._answer(-self._y, self._x, sharing), pushers.mobility[2, 2])
        self._normal_step, self._tangent_weight = 1 / along, beside
        self._creep = physics.planar_creep / self._friction**2
        # The least rate at which a gap has to open [m/s]: negative where there is room to close.
        rate = torch.where(contact.gap > 0, -contact.gap, -physics.planar_correction * contact.gap)
        self._least_rate = (rate / physics.planar_period).clamp_min(-1e6)

    def _answer(self, x: torch.Tensor, y: torch.Tensor, sharing: torch.Tensor) -> torch.Tensor:
        """Return the change of relative velocity along a direction for an impulse along it [1/kg], ``[2, B, N]``."""
        (own_x, own_y), (far_x, far_y) = self.levers, self._far
        arm, lever, mobility = own_x * y - own_y * x, far_x * y - far_y * x, self._mobility
        level = mobility[0, 0] * x * x + 2 * mobility[0, 1] * x * y + mobility[1, 1] * y * y
        turning = 2 * lever * (mobility[0, 3] * x + mobility[1, 3] * y) + mobility[3, 3] * lever * lever
        return sharing * (self._inverse_mass + self._inverse_inertia * arm * arm) + level + turning

    def impulse(
        self, point: int, impulse: torch.Tensor, twist: torch.Tensor, pusher_twist: torch.Tensor
    ) -> torch.Tensor:
        (own_x, own_y), (far_x, far_y) = self.levers, self._far
        rate_x = twist[0] - twist[2] * own_y[point] - (pusher_twist[0] - pusher_twist[3] * far_y[point])
        rate_y = twist[1] + twist[2] * own_x[point] - (pusher_twist[1] + pusher_twist[3] * far_x[point])
        opening = rate_x * self._x + rate_y * self._y
        normal = impulse[0] + (self._least_rate[point] - opening) * self._normal_step[point]
        normal = normal.clamp_min(0.0)
        # Creep: sticking contacts slip at a speed that grows with their load.
        softness = self._creep / normal.clamp_min(_TINY)
        step = 1 / (self._tangent_weight[point] + softness)
        left = impulse[1] - (rate_y * self._x - rate_x * self._y + softness * impulse[1]) * step
        up = impulse[2] + (pusher_twist[2] - softness * impulse[2]) * step
        scale = (self._friction * normal / _length(left, up).clamp_min(_TINY)).clamp_max(1.0)
        return torch.stack([normal, left * scale, up * scale])

    def push(
        self, point: int, twist: torch.Tensor, pusher_twist: torch.Tensor, impulse: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the twists of cubes and pushers after an impulse."""
        (own_x, own_y), (far_x, far_y) = self.levers, self._far
        x = impulse[0] * self._x - impulse[1] * self._y
        y = impulse[0] * self._y + impulse[1] * self._x
        moved = torch.stack([x, y]).sum(1) * self._inverse_mass
        turned = (own_x[point] * y - own_y[point] * x).sum(0, keepdim=True) * self._inverse_inertia
        wrench = torch.stack([x, y, impulse[2], far_x[point] * y - far_y[point] * x])
        return twist + torch.cat([moved, turned]), pusher_twist - (self._mobility * wrench).sum(1)

    def forces(self, impulse: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the impulses on the cube along x, along y and up [N s], ``[2, B, N]`` each."""
        normal, left, up = impulse.unbind(1)
        return normal * self._x - left * self._y, normal * self._y + left * self._x, up

    def wrench(self, impulse: torch.Tensor) -> torch.Tensor:
        """Return the impulses of both points at the pushers' anchors (x, y, z, yaw), ``[4, B, N]``."""
        x, y, up = self.forces(impulse)
        far_x, far_y = self._far
        return torch.stack([x, y, up, far_x * y - far_y * x]).sum(1)


def _length(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return (x * x + y * y).sqrt()


def _expanded(rectangle: Rectangle, like: torch.Tensor) -> Rectangle:
    parts = (rectangle.x, rectangle.y, rectangle.cos, rectangle.sin, rectangle.half_length, rectangle.half_width)
    return Rectangle(*(part.expand_as(like) for part in parts))
