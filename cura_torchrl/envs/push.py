"""The pushing task as one natively batched TorchRL environment: N worlds in this process, reset row by row."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from cura_torchrl import keys
from cura_torchrl.envs import geometry
from cura_torchrl.envs.config import STREAMS, PushEnvConfig
from cura_torchrl.envs.mdp import scenarios
from cura_torchrl.envs.mdp.inputs import checked_action, checked_episodes
from cura_torchrl.envs.mdp.observations import observation_size, observe
from cura_torchrl.envs.mdp.rewards import REWARD_TERM_NAMES, reward_terms
from cura_torchrl.envs.mdp.terminations import endings, latch_success, success_flags
from cura_torchrl.envs.robots.robot import ROBOT_MODELS
from cura_torchrl.envs.sensors.lidar import Lidar
from cura_torchrl.envs.sensors.noise import noise_key
from cura_torchrl.envs.simulation.bullet import BulletWorlds
from cura_torchrl.envs.simulation.interface import SceneState, Worlds, WorldState
from cura_torchrl.envs.simulation.planar import PlanarWorlds

if TYPE_CHECKING:
    from cura_torchrl.envs.robots.base_controller import BaseController


class PushEnv(EnvBase):
    """Push a box to a goal with a mobile manipulator that sees through one planar LiDAR.

    Every key it reads and writes is described in :mod:`cura_torchrl.keys`. A row plays the scenarios
    ``first_episode + row``, then every ``episode_stride``-th: which scene an episode is never depends on batch size,
    worker count or the order of resets. ``set_seed`` begins this sequence again, with the scenes of the new seed.
    Processes without seeds of their own play the same scenes: worker w of W gets ``first_episode=w * N`` and
    ``episode_stride=W * N``. A row that is stepped after its end, rather than reset, stands still.

    Args:
        num_envs: Number of worlds N.
        config: Task, robot, LiDAR, physics.
        seed: Seed of the scenarios and of the LiDAR's noise.
        device: Device of the tensordicts, and of the planar simulator; None casts nothing.
        first_episode: Scenario of row 0's first episode.
        episode_stride: Step from one scenario of a row to its next; N when None.
        frames_done: Frames played before, which the curriculum goes on from.
        frames_per_step: Frames that the curriculum counts for each step, all workers taken together; N when None.

    Examples:
        >>> env = PushEnv(2)
        >>> rollout = env.rollout(3)
        >>> rollout["next", "scan"].shape
        torch.Size([2, 3, 360])
        >>> env.close()
    """

    batch_locked = True

    def __init__(
        self,
        num_envs: int = 1,
        config: PushEnvConfig | None = None,
        *,
        seed: int = 0,
        device: torch.device | str | None = None,
        first_episode: int = 0,
        episode_stride: int | None = None,
        frames_done: int = 0,
        frames_per_step: int | None = None,
    ) -> None:
        if num_envs < 1:
            msg = f"num_envs is {num_envs}; accepted: 1 or more"
            raise ValueError(msg)
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.config = PushEnvConfig() if config is None else config
        self.num_envs = num_envs
        self._robot = ROBOT_MODELS[self.config.robot.model]
        self.frames_done = frames_done
        self._frames_per_step = num_envs if frames_per_step is None else frames_per_step
        self._stride = num_envs if episode_stride is None else episode_stride
        is_planar = self.config.simulator == "planar"
        # Where the worlds live: PyBullet's on the CPU, whatever the device of the tensordicts.
        self._home = torch.device("cpu") if self.device is None or not is_planar else self.device
        self._first_episode = first_episode
        self.set_seed(seed)
        self._make_specs()
        self._worlds, self._controller = self._make_worlds()
        self._lidar = Lidar(num_envs, self.config.lidar, self._worlds.cast, self._home)
        self._make_buffers()

    def _make_worlds(self) -> tuple[Worlds, BaseController]:
        config, rows, robot = self.config, self.num_envs, self._robot
        if config.simulator == "planar":
            period = config.physics.planar_period
            controller = robot.controller(rows, config.robot, period, device=self._home)
            worlds = PlanarWorlds(rows, robot.dynamics(self._home), robot.shape, config.physics, self._home)
            return worlds, controller
        controller = robot.controller(rows, config.robot, config.physics.control_period)
        return BulletWorlds(rows, robot.urdf, robot.joints, config.physics), controller

    def _make_specs(self) -> None:
        rows, rays = self.num_envs, self.config.lidar.num_rays

        def real(*shape: int) -> Unbounded:
            return Unbounded(shape=(rows, *shape), dtype=torch.float32)

        def flag(size: int) -> Binary:
            return Binary(n=size, shape=(rows, size), dtype=torch.bool)

        def count() -> Unbounded:
            return Unbounded(shape=(rows, 1), dtype=torch.int64)

        self.observation_spec = Composite(
            {
                keys.OBSERVATION: real(observation_size(self._robot.action_size)),
                keys.SCAN: Bounded(0.0, self.config.lidar.max_range, shape=(rows, rays), dtype=torch.float32),
                keys.SENSOR_POSE: real(3),
                keys.OBJECT_POSE: real(3),
                keys.OBJECT_SIZE: real(2),
                keys.REWARD_TERMS: real(len(REWARD_TERM_NAMES)),
                keys.CONTACT: flag(3),
                keys.SUCCESS: flag(len(self.config.task.tolerances)),
                keys.TIPPED: flag(1),
                keys.EPISODE: count(),
                keys.ELAPSED_STEPS: count(),
            },
            shape=(rows,),
        )
        if self.config.task.privileged:
            self.observation_spec[keys.OBSTACLES] = real(scenarios.OBSTACLE_SLOTS, 4)
        self.action_spec = Bounded(-1.0, 1.0, shape=(rows, self._robot.action_size), dtype=torch.float32)
        self.full_reward_spec = Composite({keys.REWARD: real(1), keys.COST: real(1)}, shape=(rows,))
        self.full_done_spec = Composite({"done": flag(1), "terminated": flag(1), "truncated": flag(1)}, shape=(rows,))

    def _make_buffers(self) -> None:
        rows, slots = self.num_envs, scenarios.OBSTACLE_SLOTS

        def zeros(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
            return torch.zeros(rows, *shape, dtype=dtype, device=self._home)

        self._obstacle_active, self._obstacle_pose = zeros(slots, dtype=torch.bool), zeros(slots, 3)
        self._elapsed, self._age, self._episode = (zeros(dtype=torch.int64) for _ in range(3))
        self._since_success = zeros(dtype=torch.int64) - 1
        self._success = zeros(len(self.config.task.tolerances), dtype=torch.bool)
        self._tipped, self._is_over = (zeros(dtype=torch.bool) for _ in range(2))
        self._previous_action = zeros(self._robot.action_size, dtype=torch.float32)
        self._terms = zeros(len(REWARD_TERM_NAMES), dtype=torch.float32)
        self._state: WorldState | None = None
        self._scan = zeros(self.config.lidar.num_rays, dtype=torch.float32)
        self._all_rows = torch.arange(rows, device=self._home)
        self.scenario = self._sample(self._all_rows)

    @property
    def world_state(self) -> WorldState:
        """State of the worlds after the last step.

        Raises:
            RuntimeError: If the environment has not been reset.
        """
        if self._state is None:
            msg = "the environment has not been reset; accepted: reset() before world_state"
            raise RuntimeError(msg)
        return self._state

    @property
    def obstacles(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Which obstacles have appeared ``[N, 6]``, (x [m], y [m], yaw [rad]) ``[N, 6, 3]``, edge [m] ``[N, 6]``."""
        return self._obstacle_active.clone(), self._obstacle_pose.clone(), self.scenario["obstacle_edge"].clone()

    @property
    def max_obstacles(self) -> int:
        """Most obstacles K in an episode that starts now."""
        return self.config.task.max_obstacles(self.frames_done)

    def _sample(self, episodes: torch.Tensor) -> TensorDict:
        task = self.config.task
        return scenarios.sample_scenarios(
            task.scenario, stream=task.stream, seed=self._scenario_seed, episodes=episodes,
            max_obstacles=self.max_obstacles, tcp_reach=self._robot.tcp[0],
        )  # fmt: skip

    def _set_seed(self, seed: int | None) -> None:
        self._scenario_seed = 0 if seed is None else int(seed)
        self._next_episode = torch.arange(self.num_envs, device=self._home) + self._first_episode
        self._is_first = torch.ones(self.num_envs, dtype=torch.bool, device=self._home)

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, episodes: torch.Tensor | None = None, **_: Any
    ) -> TensorDict:
        """Reset the rows of the mask, or all.

        Args:
            tensordict: May hold the mask ``_reset``.
            episodes: Scenarios to play, int64, shape ``[N]``; each row's next one when left out.

        Returns:
            What every row observes now.

        Raises:
            ValueError: If the episodes are not one index for each row.
        """  # noqa: DOC502 - raised by what this calls
        mask = None if tensordict is None else tensordict.get("_reset", None)
        rows = self._all_rows if mask is None else mask.reshape(self.num_envs).nonzero().flatten().to(self._home)
        asked = self._next_episode if episodes is None else checked_episodes(episodes, self.num_envs, self._home)
        self._episode[rows] = asked[rows]
        self._next_episode[rows] = self._episode[rows] + self._stride
        self.scenario[rows] = self._sample(self._episode[rows])
        self._clear(rows)
        self._build(rows)
        self._read()
        self._spawn()
        self._measure(rows)
        return self._emit()

    def _clear(self, rows: torch.Tensor) -> None:
        self._obstacle_active[rows] = False
        self._obstacle_pose[rows] = 0.0
        self._elapsed[rows] = 0
        self._since_success[rows] = -1
        self._success[rows] = False
        self._tipped[rows] = False
        self._previous_action[rows] = 0.0
        self._is_over[rows] = False
        self._terms[rows] = 0.0
        self._age[rows] = 0
        first = rows[self._is_first[rows]]
        if self.config.task.random_first_age and len(first):
            # Spread by the golden ratio: even over any number of rows, and no draw to keep.
            share = (self._episode[first].double() * 0.6180339887498949) % 1.0
            self._age[first] = (share * self.config.task.max_steps).long()
        self._is_first[rows] = False

    def _build(self, rows: torch.Tensor) -> None:
        scene = self.scenario[rows]
        task, edge = self.config.task.scenario, scene["object_edge"]
        arm = edge.new_tensor(self._robot.home).expand(len(rows), -1)
        start = SceneState(
            joint_position=torch.cat([scene["robot_pose"], arm], dim=-1),
            object_edge=edge,
            object_mass=scene["object_mass"],
            floor_friction=scene["floor_friction"],
            com_offset=scene["com_offset"],
            object_pose=scene["object_pose"],
            num_slots=scenarios.OBSTACLE_SLOTS,
        )
        self._worlds.reset(rows, start)
        # Pushing higher than (edge / 2 - CoM shift) / mu would tip the object; 0.9 is the margin.
        self._controller.reset(rows, 0.9 * edge * (0.5 - task.com_shift) / task.floor_friction[1])
        stream = STREAMS.index(self.config.task.stream)
        self._lidar.reset(rows, noise_key(stream, self._scenario_seed, self._episode[rows]))

    def _read(self) -> None:
        """Read the state of all worlds, and where it puts the TCP."""
        self._state = self._worlds.state()
        self._tcp, self._hand_rotation, self._jacobian = self._controller.kinematics.forward(self._state.joint_position)

    def _spawn(self) -> None:
        """Let obstacles appear whose time has come."""
        time = self._elapsed.double() * self.config.task.policy_period
        if not bool(scenarios.due_obstacles(self.scenario, self._obstacle_active, time).any()):
            return
        state, tcp = self.world_state, self._tcp
        active, pose = scenarios.spawn_obstacles(
            self.config.task.scenario, self.scenario, self._obstacle_active, self._obstacle_pose,
            time=time, base_pose=state.base_pose,
            tcp_position=geometry.from_frame(state.base_pose, tcp[:, :2]), object_pose=_planar(state),
        )  # fmt: skip
        self._worlds.place_obstacles(active & ~self._obstacle_active, pose, self.scenario["obstacle_edge"])
        self._obstacle_active, self._obstacle_pose = active, pose

    def _measure(self, rows: torch.Tensor) -> None:
        """Scan in the given rows."""
        state = self.world_state
        edge = torch.where(self._obstacle_active, self.scenario["obstacle_edge"], 0.0)
        bodies = torch.cat([self._obstacle_pose, _planar(state)[:, None]], dim=1)
        object_edge = self.scenario["object_edge"][:, None]
        edges = torch.cat([edge, object_edge if self.config.lidar.occlusion else torch.zeros_like(object_edge)], dim=1)
        # A fresh tensor: what was emitted before must not change.
        scan = self._scan.clone()
        scan[rows] = self._lidar.scan(rows, state.base_pose[rows], bodies[rows], edges[rows])
        self._scan = scan

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = checked_action(tensordict[keys.ACTION], self._previous_action.shape, self._home)
        action = action.masked_fill(self._is_over[:, None], 0.0)
        before = self.world_state
        to_object = geometry.to_frame(before.base_pose, before.object_position[:, :2])
        self._controller.command(action, to_object, self._worlds.mass_matrix())
        self._worlds.advance(self._controller, round(self.config.task.policy_period / self._controller.period))
        self.frames_done += self._frames_per_step
        self._elapsed = self._elapsed + 1
        self._read()
        self._spawn()
        self._measure(self._all_rows)
        cost, reward = self._judge(action, before)
        terminated, truncated = endings(
            self.config.task,
            contact=self.world_state.contact,
            elapsed_steps=self._elapsed + self._age,
            steps_since_success=self._since_success,
        )
        self._previous_action, self._is_over = action.float(), terminated | truncated
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        columns = {name: flag[:, None] for name, flag in ends.items()}
        return self._emit().update({keys.REWARD: reward, keys.COST: cost, **columns})

    def _judge(self, action: torch.Tensor, before: WorldState) -> tuple[torch.Tensor, torch.Tensor]:
        """Update success and tipping.

        Returns:
            Cost and reward, shape ``[N, 1]`` each.
        """
        state, scene, task = self.world_state, self.scenario, self.config.task
        position, quaternion, edge = state.object_position, state.object_quaternion, scene["object_edge"]
        flags = success_flags(task, _planar(state), scene["goal_pose"])
        self._success, self._since_success = latch_success(
            self._success, self._since_success, flags=flags, contact=state.contact
        )
        self._tipped = self._tipped | (geometry.tilt_from_quaternion(quaternion) > task.tilt_limit)
        goal = torch.cat([scene["goal_pose"][:, :2], edge[:, None] / 2], dim=-1)
        goal_quaternion = geometry.quaternion_from_yaw(scene["goal_pose"][:, 2])
        tcp_w = torch.cat([geometry.from_frame(state.base_pose, self._tcp[:, :2]), self._tcp[:, 2:]], dim=-1)
        terms = reward_terms(
            task.reward,
            object_corners=geometry.cube_corners(position, quaternion, edge),
            goal_corners=geometry.cube_corners(goal, goal_quaternion, edge),
            object_velocity=state.object_velocity[:, :2],
            object_position=position[:, :2],
            goal_position=goal[:, :2],
            surface_point_w=geometry.transform_point(position, quaternion, scene["surface_point"]),
            tcp_position=tcp_w,
            action=action.double(),
            previous_action=self._previous_action.double(),
            joint_acceleration=self._robot.rewarded_acceleration(before, state, task.policy_period),
        )
        self._terms = terms.float()
        return state.contact.any(-1, keepdim=True).float(), self._terms.sum(-1, keepdim=True)

    def _emit(self) -> TensorDict:
        """Return every observation as fresh tensors."""
        state, scene = self.world_state, self.scenario
        pose = _planar(state)
        out = {
            keys.OBSERVATION: observe(
                base_pose=state.base_pose,
                base_velocity=state.base_velocity,
                tcp_position_b=self._tcp,
                hand_rotation_b=self._hand_rotation,
                tcp_velocity_b=self._tcp_velocity(),
                previous_action=self._previous_action,
                object_position=state.object_position,
                object_yaw=pose[:, 2],
                object_velocity=state.object_velocity,
                object_yaw_rate=state.object_angular_velocity[:, 2],
                goal_pose=scene["goal_pose"],
            ),
            keys.SCAN: self._scan.clone(),
            keys.SENSOR_POSE: state.base_pose.float(),
            keys.OBJECT_POSE: pose.float(),
            keys.OBJECT_SIZE: scene["object_edge"].float()[:, None].repeat(1, 2),
            keys.REWARD_TERMS: self._terms.clone(),
            keys.CONTACT: state.contact.clone(),
            keys.SUCCESS: self._success.clone(),
            keys.TIPPED: self._tipped[:, None].clone(),
            keys.EPISODE: self._episode[:, None].clone(),
            keys.ELAPSED_STEPS: self._elapsed[:, None].clone(),
        }
        if self.config.task.privileged:
            edge = torch.where(self._obstacle_active, scene["obstacle_edge"], 0.0)
            out[keys.OBSTACLES] = torch.cat([self._obstacle_pose, edge[..., None]], dim=-1).float()
        emitted = TensorDict(out, batch_size=self.batch_size)
        return emitted if self.device is None else emitted.to(self.device)

    def _tcp_velocity(self) -> torch.Tensor:
        """Return the velocity of the TCP relative to the world, in the base frame [m/s], shape ``[N, 3]``."""
        state, tcp = self.world_state, self._tcp
        base = geometry.rotate(state.base_velocity[:, :2], -state.base_pose[:, 2])
        spin = state.base_velocity[:, 2]
        arm = geometry.matvec(self._jacobian[:, :3], state.joint_velocity)
        carried = [base[:, 0] - spin * tcp[:, 1], base[:, 1] + spin * tcp[:, 0], torch.zeros_like(spin)]
        return arm + torch.stack(carried, dim=-1)

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Disconnect the simulator; harmless when done twice."""
        self._worlds.close()
        if not self.is_closed:
            super().close(raise_if_closed=raise_if_closed)


def _planar(state: WorldState) -> torch.Tensor:
    """Return the object's (x [m], y [m], yaw [rad]), shape ``[N, 3]``."""
    yaw = geometry.yaw_from_quaternion(state.object_quaternion)
    return torch.cat([state.object_position[:, :2], yaw[:, None]], dim=-1)
