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
from cura_torchrl.envs.robots.pushing_skills import CHASSIS_RADIUS, SKILLS, PushingSkill, Situation

if TYPE_CHECKING:
    from tensordict import TensorDictBase


_BODY_CLEARANCE = 0.08
"""Distance that the avoider's discs keep from obstacles [m]."""


class ScriptedPusher(TensorDictModuleBase):
    """Go behind the object, push it towards the goal, correct sideways.

    Reads ``observation``, writes ``action``; usable wherever a policy is. It looks only at robot, object and goal.

    Args:
        robot: Which robot pushes, and limits that actions are shares of.
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
        self._skill: PushingSkill = SKILLS[self.robot.model](self.robot)

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
        centre, half = parts["object_position"][..., :2], parts["object_position"][..., 2:]
        to_goal = waypoint - centre
        distance = to_goal.norm(dim=-1, keepdim=True)
        at = Situation(
            tcp=parts["tcp_position"][..., :2],
            centre=centre,
            heading=parts["object_heading"],
            half=half,
            distance=distance,
            along=to_goal / distance.clamp_min(1e-6),
            top_speed=self.speed,
        )
        velocity = self._skill.velocity(at)
        velocity = torch.where(distance < 0.03, torch.zeros_like(velocity), velocity)
        # Half a diagonal: whichever way the object is turned.
        velocity = self._keep_clear(centre, 1.42 * half[..., 0], velocity)
        return self._skill.share(at, velocity, self._keep_clear)

    def _keep_clear(self, centre: torch.Tensor, radius: torch.Tensor, velocity: torch.Tensor) -> torch.Tensor:  # noqa: ARG002
        """Return the velocity of a disc, base frame [m/s], less what would bring it into an obstacle."""
        return velocity


class ScriptedAvoider(ScriptedPusher):
    """Push along the shortest route around every obstacle that has appeared, seen or not: what is possible at all.

    Needs an environment with ``TaskConfig.privileged``. Routes are kept until an obstacle appears or the goal changes.

    Args:
        robot: Which robot pushes, and limits that actions are shares of.
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
        radius = parts["object_position"][..., 2].clamp_min(CHASSIS_RADIUS) + self.margin
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
