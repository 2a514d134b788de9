"""Pushers without learning: proof that physics, kinematics and control can do the job, and a reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict.nn import TensorDictModuleBase

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import RobotConfig
from cura_torchrl.envs.mdp.observations import OBSERVATION_SLICES
from cura_torchrl.envs.robots import route

if TYPE_CHECKING:
    from tensordict import TensorDictBase


_CHASSIS_RADIUS = 0.6
"""Radius of a disc that all but the corners of the chassis lie in [m]."""

_BODY_CLEARANCE = 0.08
"""Distance that the avoider's discs keep from obstacles [m]."""

_NEAR = 0.1
"""Gap between hand and face below which they count as touching [m]."""

_RUDDER = 2.0
"""Rate at which the line from hand to object is turned towards the goal, per angle [1/s]."""


class ScriptedPusher(TensorDictModuleBase):
    """Go behind the object, push it towards the goal, correct sideways.

    Reads ``observation``, writes ``action``; usable wherever a policy is. It looks only at robot, object and goal.

    Args:
        robot: Limits that actions are shares of.
        speed: Pushing speed [m/s].

    Examples:
        >>> from tensordict import TensorDict
        >>> policy = ScriptedPusher()
        >>> policy(TensorDict({"observation": torch.zeros(2, 33)}, [2]))["action"].shape
        torch.Size([2, 6])
    """

    def __init__(self, robot: RobotConfig | None = None, *, speed: float = 0.7) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.ACTION]
        self.robot = RobotConfig() if robot is None else robot
        self.speed = speed

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action for every row.

        Args:
            tensordict: Holds the in_keys, batch ``[N]``.

        Returns:
            The same tensordict.
        """
        parts = {name: tensordict[keys.OBSERVATION][..., part] for name, part in OBSERVATION_SLICES.items()}
        waypoint = self._waypoint(tensordict, parts)
        tensordict[keys.ACTION] = self._action(parts, waypoint)
        return tensordict

    def _waypoint(self, tensordict: TensorDictBase, parts: dict[str, torch.Tensor]) -> torch.Tensor:  # noqa: ARG002
        """Return where the object should go next, base frame [m], shape ``[*, 2]``."""
        return parts["goal_position"]

    def _action(self, parts: dict[str, torch.Tensor], waypoint: torch.Tensor) -> torch.Tensor:
        tcp, centre = parts["tcp_position"][..., :2], parts["object_position"][..., :2]
        half = parts["object_position"][..., 2:]
        to_goal = waypoint - centre
        distance = to_goal.norm(dim=-1, keepdim=True)
        along = to_goal / distance.clamp_min(1e-6)
        offset = centre - tcp
        reach = offset.norm(dim=-1, keepdim=True)
        ahead, aside = _components(offset, along)
        gap = reach - _face_distance(offset, parts["object_heading"], half)
        # Behind the object the hand pushes; beside it, it comes round. Once it is off the object it has to be well
        # behind: else it would meet the same face at the same place again.
        behind = (ahead > 0.0) & (aside.abs() < torch.where(gap > _NEAR, 0.35, 0.7) * half)
        speed = torch.minimum(torch.full_like(distance, self.speed), 0.12 + 1.2 * distance)
        direction = offset / reach.clamp_min(1e-6)
        push = _push(direction, reach, torch.atan2(aside, ahead), gap, speed)
        velocity = torch.where(behind, push, _come_round(direction, along, ahead, aside, gap, half))
        velocity = torch.where(distance < 0.03, torch.zeros_like(velocity), velocity)
        # Half a diagonal: whichever way the object is turned.
        velocity = self._keep_clear(centre, 1.42 * half[..., 0], velocity)
        return self._share(tcp, velocity, geometry.angle_of(along)[..., None])

    def _keep_clear(self, centre: torch.Tensor, radius: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:  # noqa: ARG002
        """Return the velocity of a disc, base frame [m/s], less what would bring it into an obstacle."""
        return velocity

    def _share(self, tcp: torch.Tensor, velocity: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        """Return the action for a TCP velocity: the base carries it, the arm returns to its middle."""
        spin = (1.2 * turn).clamp(-0.6, 0.6)
        home = tcp.new_tensor([0.9, 0.0])
        arm = (1.0 * (home - tcp)).clamp(-0.2, 0.2)
        carried = torch.cat([-spin * tcp[..., 1:], spin * tcp[..., :1]], dim=-1)
        base = velocity - carried - arm
        base = self._keep_clear(torch.zeros_like(tcp), torch.full_like(turn[..., 0], _CHASSIS_RADIUS), base)
        base = base / self.robot.max_base_speed
        base = base / base.norm(dim=-1, keepdim=True).clamp_min(1.0)
        lift = torch.zeros_like(turn)
        return torch.cat([base, spin / self.robot.max_base_yaw_rate, arm / self.robot.max_tcp_speed, lift], dim=-1)


class ScriptedAvoider(ScriptedPusher):
    """Push along the shortest route around every obstacle that has appeared, seen or not: what is possible at all.

    Needs an environment with ``TaskConfig.privileged``. Routes are kept until an obstacle appears or the goal changes.

    Args:
        robot: Limits that actions are shares of.
        speed: Pushing speed [m/s].
        margin: Distance that a route keeps between an obstacle and the wider of the object's inscribed circle and the
            chassis, which follows and cuts corners [m].
        look_ahead: How far along the route the object is sent [m].
    """

    def __init__(
        self, robot: RobotConfig | None = None, *, speed: float = 0.7, margin: float = 0.45, look_ahead: float = 1.2
    ) -> None:
        super().__init__(robot, speed=speed)
        self.in_keys = [keys.OBSERVATION, keys.OBSTACLES, keys.SENSOR_POSE]
        self.margin = margin
        self.look_ahead = look_ahead
        self._known: torch.Tensor | None = None
        self._value = torch.empty(0)
        self._obstacles_b = torch.empty(0)

    def _waypoint(self, tensordict: TensorDictBase, parts: dict[str, torch.Tensor]) -> torch.Tensor:
        base = tensordict[keys.SENSOR_POSE]
        goal = geometry.from_frame(base, parts["goal_position"])
        centre = geometry.from_frame(base, parts["object_position"][..., :2])
        radius = parts["object_position"][..., 2].clamp_min(_CHASSIS_RADIUS) + self.margin
        self._plan(tensordict[keys.OBSTACLES], goal, radius)
        self._obstacles_b = _in_base_frame(base, tensordict[keys.OBSTACLES])
        cells = round(self.look_ahead / route.CELL)
        ahead = route.follow(self._value, centre, cells)
        is_near = geometry.norm(goal - centre) < self.look_ahead
        return geometry.to_frame(base, torch.where(is_near[..., None], goal, ahead))

    def _plan(self, obstacles: torch.Tensor, goal: torch.Tensor, radius: torch.Tensor) -> None:
        scene = torch.cat([obstacles.flatten(1), goal, radius[:, None]], dim=-1)
        if self._known is None or self._known.shape != scene.shape:
            self._known = torch.full_like(scene, torch.nan)
            self._value = scene.new_empty(len(scene), *route.cell_centres().shape[:2])
        # Goal and radius are read back from the base frame: their last bits must not ask for a new plan in every step.
        is_known = ((self._known - scene).abs() < 0.5 * route.CELL).all(-1)
        changed = (~is_known).nonzero().flatten()
        if len(changed):
            cost = route.step_cost(obstacles[changed], radius[changed], soft_margin=0.6)
            self._value[changed] = route.cost_to_go(cost, goal[changed])
            self._known[changed] = scene[changed]

    def _keep_clear(self, centre: torch.Tensor, radius: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:
        for slot in range(self._obstacles_b.shape[1]):
            obstacle = self._obstacles_b[:, slot]
            local = geometry.to_frame(obstacle[:, :3], centre)
            half = obstacle[:, 3:] / 2
            outward = local - local.clamp(-half, half)
            distance = outward.norm(dim=-1, keepdim=True)
            inward = geometry.rotate(-outward / distance.clamp_min(1e-6), obstacle[:, 2])
            # It may close in only as fast as it can stop: proportionally to the gap, and back out of a negative one.
            allowed = 1.5 * (distance - radius[:, None] - _BODY_CLEARANCE)
            excess = ((velocity * inward).sum(-1, keepdim=True) - allowed).clamp_min(0.0)
            velocity = velocity - torch.where(half > 0, excess, 0.0) * inward
        return velocity


def _in_base_frame(base: torch.Tensor, obstacles: torch.Tensor) -> torch.Tensor:
    position = geometry.to_frame(base[:, None].expand(-1, obstacles.shape[1], -1), obstacles[..., :2])
    return torch.cat([position, obstacles[..., 2:3] - base[:, None, 2:], obstacles[..., 3:]], dim=-1)


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
