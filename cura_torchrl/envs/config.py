"""Frozen configuration of the task, the robot, the LiDAR, the map and the physics: pure data, no torch, no simulator.

The only place where a default is written down. A field's docstring gives its unit, and ``cura-torchrl train --help``
prints it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, get_args

from cura_torchrl.validation import require, require_fields

ScenarioKind = Literal["uniform", "adversarial", "mixed"]
Stream = Literal["train", "eval", "vae"]
Simulator = Literal["bullet", "planar"]
RobotName = Literal["ridgeback_franka", "ridgeback"]

STREAMS: tuple[Stream, ...] = get_args(Stream)
"""Streams of scenarios; the number of each keys its draws."""


@dataclass(frozen=True, kw_only=True)
class ScenarioConfig:
    """What an episode looks like before it starts. World frame: x points from start to goal."""

    kind: ScenarioKind = "mixed"
    """Where obstacles appear: anywhere in the region, on the object-to-goal line, or either with equal chance."""
    object_edges: tuple[float, ...] = (0.5, 0.75, 1.0)
    """Edge lengths of the pushed cube [m]; one is drawn with equal chance."""
    max_obstacles: int = 6
    """Most obstacles K in an episode; the count is uniform in 0..K. Range: 0 to 6."""
    obstacle_edges: tuple[float, ...] = (0.4, 0.6, 1.0)
    """Edge lengths of an obstacle cube [m]; one is drawn with equal chance."""
    obstacle_x: tuple[float, float] = (3.0, 11.0)
    """Where obstacles may appear, world x [m]."""
    obstacle_y: tuple[float, float] = (-3.0, 3.0)
    """Where obstacles may appear, world y [m]."""
    obstacle_time: tuple[float, float] = (0.0, 15.0)
    """When an obstacle appears [s]."""
    obstacle_clearance: float = 1.0
    """Least distance of an appearing obstacle from the surfaces of robot and object [m]."""
    obstacle_gap: float = 0.1
    """Least distance between the circumscribed circles of an appearing obstacle and one that is there already [m]."""
    adversarial_jitter: float = 0.3
    """Lateral offset from the object-to-goal line in the adversarial scenario, uniform in plus or minus this [m]."""
    num_fallbacks: int = 8
    """Ordered places an obstacle tries before it waits for the next policy step [1]."""
    object_y: tuple[float, float] = (-1.0, 1.0)
    """Object's start, world y [m]; its x is 0."""
    object_yaw: tuple[float, float] = (-0.6, 0.6)
    """Object's start yaw [rad]."""
    goal_x: tuple[float, float] = (12.0, 14.0)
    """Goal, world x [m]."""
    goal_y: tuple[float, float] = (-2.0, 2.0)
    """Goal, world y [m]; its yaw is uniform over the circle."""
    start_gap: tuple[float, float] = (0.2, 0.6)
    """Distance from the TCP to the nearest face at the start [m]."""
    start_lateral: tuple[float, float] = (-0.5, 0.5)
    """Lateral offset of the robot behind the object at the start [m]."""
    start_yaw: tuple[float, float] = (-0.3, 0.3)
    """Robot's start yaw [rad]."""
    object_mass: tuple[float, float] = (3.0, 10.0)
    """Object's mass [kg]."""
    floor_friction: tuple[float, float] = (0.25, 0.6)
    """Coulomb friction between object and floor [1]."""
    com_shift: float = 0.1
    """Offset of the object's centre of mass along each axis, a share of the edge, uniform in plus or minus this [1]."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(0 <= self.max_obstacles <= 6, "max_obstacles", self.max_obstacles, "0 to 6")
        require(self.num_fallbacks >= 1, "num_fallbacks", self.num_fallbacks, "1 or more")
        for name in ("object_edges", "obstacle_edges"):
            edges = getattr(self, name)
            require(bool(edges) and min(edges, default=0.0) > 0, name, edges, "one or more positive lengths [m]")
        for name in _RANGES:
            low, high = getattr(self, name)
            require(low <= high, name, (low, high), "a range whose first number is not the larger one")
        for name in ("object_mass", "floor_friction"):
            require(getattr(self, name)[0] > 0, name, getattr(self, name), "positive numbers")
        for name in ("obstacle_clearance", "obstacle_gap", "adversarial_jitter"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a length that is not negative [m]")
        require(0 <= self.com_shift < 0.5, "com_shift", self.com_shift, "0 to below 0.5, inside of the object")


_RANGES = (
    "obstacle_x", "obstacle_y", "obstacle_time", "object_y", "object_yaw", "goal_x", "goal_y",
    "start_gap", "start_lateral", "start_yaw", "object_mass", "floor_friction",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Weights and scales of the paper's reward (Table I)."""

    keypoint_weight: float = 4.0
    """w1, weight of the distance between the object's and the goal's corners [1]."""
    progress_weight: float = 2.0
    """w2, weight of the direction of the object's velocity [1]."""
    velocity_weight: float = 1.0
    """w3, weight of the object's speed [1]."""
    contact_weight: float = 1.0
    """w4, weight of the distance from the end-effector to a point on the object's surface [1]."""
    action_rate_weight: float = -0.1
    """w5, weight of the change of the action [1]."""
    acceleration_weight: float = -0.1
    """w6, weight of the joint acceleration [1]."""
    keypoint_scale: float = 0.25
    """Decay of the keypoint term [1/m]."""
    progress_scale: float = 5.0
    """Sharpness of the progress term [1]."""
    contact_scale: float = 0.1
    """Decay of the contact-point term [1/m]."""
    max_speed: float = 0.8
    """v_max, speed that the velocity term divides by: the base's maximum [m/s]."""
    slow_speed: float = 0.25
    """Below this the object's velocity counts as zero in the progress term [m/s]; 0 is the letter of the paper."""
    near_goal: float = 0.02
    """Below this distance the direction to the goal counts as zero [m]."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(self.max_speed > 0, "max_speed", self.max_speed, "a positive speed [m/s]")


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """The task: scenario, reward, and what ends an episode."""

    scenario: ScenarioConfig = field(default_factory=ScenarioConfig)
    """Layout, object and obstacles."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """Reward weights and scales."""
    stream: Stream = "train"
    """Which independent stream of scenarios is played."""
    policy_period: float = 0.2
    """Time between two actions [s]; the paper's 5 Hz."""
    episode_time: float = 50.0
    """Time limit of an episode [s]."""
    success_time: float = 5.0
    """Time the episode plays on after the goal is first reached [s]."""
    tolerances: tuple[float, float, float] = (0.5, 0.25, 0.10)
    """Distance from object to goal that counts as success [m]; the first is the headline."""
    yaw_tolerance: float = math.radians(10.0)
    """Yaw error allowed by the last tolerance, modulo a quarter turn [rad]."""
    tilt_limit: float = math.radians(30.0)
    """Tilt of the object beyond which it counts as tipped [rad]."""
    random_first_age: bool = False
    """Whether the first episode of each world starts at a random age of the time limit, so that resets spread out."""
    privileged: bool = False
    """Whether observations include the true obstacles, for scripted policies and diagnosis."""
    curriculum: tuple[tuple[int, int], ...] = ()
    """Steps (frames, K): from this many frames on, at most K obstacles; if empty, always ``scenario.max_obstacles``."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(self.policy_period > 0, "policy_period", self.policy_period, "a positive time [s]")
        require(self.success_time >= 0, "success_time", self.success_time, "a time that is not negative [s]")
        least = self.policy_period
        require(self.episode_time >= least, "episode_time", self.episode_time, "at least one policy period [s]")
        frames = [step[0] for step in self.curriculum]
        require(frames == sorted(frames), "curriculum", self.curriculum, "steps in increasing frames")
        require(all(0 <= step[1] <= 6 for step in self.curriculum), "curriculum", self.curriculum, "0 to 6 obstacles")

    @property
    def max_steps(self) -> int:
        """Time limit of an episode in policy steps [1]."""
        return round(self.episode_time / self.policy_period)

    def max_obstacles(self, frames: int) -> int:
        """Return K, the most obstacles of an episode that starts now.

        Args:
            frames: Environment steps so far [1].

        Returns:
            Number of obstacles [1].

        Examples:
            >>> TaskConfig(curriculum=((0, 0), (1000, 2))).max_obstacles(999)
            0
        """
        if not self.curriculum:
            return self.scenario.max_obstacles
        reached = [most for start, most in self.curriculum if start <= frames]
        return reached[-1] if reached else 0


@dataclass(frozen=True, kw_only=True)
class RobotConfig:
    """Limits and control gains of Ridgeback and Panda."""

    model: RobotName = "ridgeback_franka"
    """Which robot: Ridgeback with a Franka arm, which pushes with its hand; or without, which pushes with its front."""
    max_base_speed: float = 0.8
    """Largest base speed [m/s]; the paper's v_max."""
    max_base_yaw_rate: float = 1.0
    """Largest base yaw rate [rad/s]."""
    max_base_acceleration: float = 2.5
    """Largest base acceleration [m/s^2]; ridgeback_control's control.yaml."""
    max_base_yaw_acceleration: float = 1.0
    """Largest base yaw acceleration [rad/s^2]; ridgeback_control's control.yaml."""
    max_tcp_speed: float = 0.5
    """Largest end-effector speed relative to the base, per axis [m/s]."""
    ik_damping: float = 0.02
    """Damping factor lambda of the damped least squares; the paper's value [1]."""
    ik_rate: float = 25.0
    """Rate at which the differential IK is solved [Hz]; in between, references are integrated at the control rate."""
    posture_gain: float = 1.0
    """Gain of the null-space posture task [1/s]."""
    position_gain: float = 5.0
    """Gain with which the joint reference follows the TCP's reference [1/s]."""
    tcp_leash: float = 0.05
    """Furthest the TCP's reference may be from that of the joints, per axis [m]."""
    orientation_gain: float = 4.0
    """Gain of the hand's orientation task [1/s]."""
    max_hand_yaw: float = 0.8
    """Largest angle between the hand's axis and the base's x axis in the plane [rad]."""
    hand_tilt: float = 0.9
    """Downward tilt of the hand's axis below the horizontal [rad]."""
    workspace_x: tuple[float, float] = (0.76, 1.03)
    """Where the TCP reference may be, base frame x [m]."""
    workspace_y: tuple[float, float] = (-0.4, 0.4)
    """Where the TCP reference may be, base frame y [m]."""
    workspace_z: tuple[float, float] = (0.2, 0.45)
    """Where the TCP reference may be, height above the ground [m]; the tipping bound lowers the upper end."""
    stiffness: tuple[float, ...] = (600.0, 600.0, 600.0, 600.0, 250.0, 150.0, 50.0)
    """Joint stiffness K [N m/rad]; franka-interface."""
    damping: tuple[float, ...] = (50.0, 50.0, 50.0, 50.0, 30.0, 25.0, 15.0)
    """Joint damping D [N m s/rad]; franka-interface."""
    base_time_constant: float = 0.02
    """Time constant of the base's velocity servo [s]."""
    max_hand_rate: float = 1.0
    """Largest angular speed of the hand's orientation task, per axis [rad/s]."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in _POSITIVE:
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        gains = (self.stiffness, self.damping)
        require(all(len(gain) == 7 for gain in gains), "stiffness, damping", gains, "7 each")
        require(min(map(min, gains)) > 0, "stiffness, damping", gains, "positive numbers")


_POSITIVE = (
    "max_base_speed", "max_base_yaw_rate", "max_base_acceleration", "max_base_yaw_acceleration", "max_tcp_speed",
    "ik_damping", "ik_rate", "base_time_constant",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LidarConfig:
    """The base-mounted planar LiDAR."""

    num_rays: int = 360
    """Rays per turn [1]."""
    max_range: float = 10.0
    """Largest range, and what a miss reads [m]; Hokuyo UST-10LX."""
    height: float = 0.26
    """Height of the scan plane above the ground [m]; ridgeback_description."""
    noise: float = 0.01
    """Standard deviation of the range noise [m]."""
    occlusion: bool = True
    """Whether rays see the pushed object; off, they pass through it."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(8 <= self.num_rays <= 8192, "num_rays", self.num_rays, "8 to 8192")
        lengths = (self.max_range, self.noise)
        require(self.max_range > 0 and self.noise >= 0, "max_range, noise", lengths, "positive, not negative [m]")


@dataclass(frozen=True, kw_only=True)
class MapConfig:
    """The confidence map and the window that the policy sees."""

    decay: float = 0.9
    """alpha: an unseen cell's confidence is multiplied by this each step [1]; 1 accumulates. Range: 0 to 1."""
    resolution: float = 0.1
    """Edge of a cell [m]."""
    window: int = 100
    """Cells along the edge of the robot-centred window [1]."""
    extent_x: tuple[float, float] = (-6.0, 18.0)
    """World x covered by the global map [m]; outside everything is unseen."""
    extent_y: tuple[float, float] = (-8.0, 8.0)
    """World y covered by the global map [m]; outside everything is unseen."""
    channels: Literal["confidence+occupancy", "product", "confidence"] = "confidence+occupancy"
    """What the window holds: M and O; M times O; or M alone (the letter of the paper's Eq. 2)."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(0.0 <= self.decay <= 1.0, "decay", self.decay, "0 to 1")
        size = (self.resolution, self.window)
        require(min(size) > 0, "resolution, window", size, "positive numbers")

    @property
    def num_channels(self) -> int:
        """Channels of the window."""
        return 2 if self.channels == "confidence+occupancy" else 1


@dataclass(frozen=True, kw_only=True)
class PhysicsConfig:
    """The simulator's clock and contact."""

    control_period: float = 0.005
    """Time step of control and physics [s]; the paper's 200 Hz."""
    gravity: float = 9.81
    """Weight of the object per mass [m/s^2]; the arm is gravity-compensated and feels none."""
    hand_friction: float = 1.5
    """Bullet's friction of the robot's links; Bullet multiplies it by the object's [1]."""
    solver_iterations: int = 50
    """Bullet's constraint solver iterations per tick [1]."""
    planar_period: float = 0.02
    """Time step of control and physics in the planar simulator [s]; a shorter one hardly changes its paths."""
    planar_sweeps: int = 2
    """Gauss-Seidel sweeps over the planar simulator's contacts per tick [1]."""
    planar_correction: float = 0.2
    """Share of an overlap that the planar simulator takes back in a tick; Bullet's default [1]."""
    planar_creep: float = 0.0165
    """Slip of a sticking hand in the planar simulator, per force ratio and friction squared; fits Bullet's [m/s]."""
    planar_graph: bool = False
    """Whether the planar simulator captures a policy step as a CUDA graph and replays it, one launch in place of
    thousands. On the CPU it changes nothing."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("control_period", "planar_period"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive time [s]")
        require(self.gravity > 0, "gravity", self.gravity, "a positive acceleration [m/s^2]")
        require(self.planar_sweeps >= 1, "planar_sweeps", self.planar_sweeps, "1 or more")


@dataclass(frozen=True, kw_only=True)
class PushEnvConfig:
    """Everything that :class:`cura_torchrl.envs.push.PushEnv` is built from."""

    task: TaskConfig = field(default_factory=TaskConfig)
    """Scenario, reward, endings."""
    robot: RobotConfig = field(default_factory=RobotConfig)
    """Limits and gains."""
    lidar: LidarConfig = field(default_factory=LidarConfig)
    """Range sensor."""
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    """Clock and contact."""
    simulator: Simulator = "bullet"
    """Which simulator runs the worlds: PyBullet, the reference; or tensors in the plane, for speed."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("control_period", "planar_period"):
            period = getattr(self.physics, name)
            ticks = self.task.policy_period / period
            require(abs(ticks - round(ticks)) < 1e-6, name, period, "a divisor of policy_period")
        if self.simulator == "planar":
            least = min(*self.task.scenario.object_edges, *self.task.scenario.obstacle_edges)
            accepted = f"below the lowest cube's {least} m, for a plane has no heights"
            require(self.lidar.height < least, "height of the planar simulator's LiDAR", self.lidar.height, accepted)
