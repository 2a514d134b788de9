"""One world of the pushing task, with the map's code that a method's policy sees, behind Gymnasium's interface.

TorchRL's own ``EnvBase.register_gym`` hands out batches of one, does not begin anew with a seed, and fails Gymnasium's
checker.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch

from cura_torchrl import keys
from cura_torchrl.trainers.build import LATENT_SIZE, make_env
from cura_torchrl.trainers.methods import method as preset
from cura_torchrl.validation import require

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from tensordict import TensorDictBase

    from cura_torchrl.envs.config import ScenarioKind, Simulator, Stream
    from cura_torchrl.trainers.config import TrainConfig


class PushGym(gymnasium.Env):
    """Push a box to a goal, for learners that speak Gymnasium.

    The observation is the vector of :mod:`cura_torchrl.envs.mdp.observations` (33 numbers, without an arm 30), then the
    code of the confidence map (32). ``info`` holds ``cost`` (1 on collision), ``contact`` (base, arm, object),
    ``success`` (for each of ``TaskConfig.tolerances``), ``is_success`` (the first of them) and ``scenario`` (its
    index). Episodes end by themselves: a collision terminates, time truncates.

    ``reset(seed=s)`` starts the scenarios of seed s anew, and every further reset plays the next one;
    ``reset(options={"scenario": i})`` plays the i-th.

    Args:
        method: Whose map and LiDAR: a name in :data:`cura_torchrl.trainers.methods.PRESETS`.
        simulator: Where the world is.
        scenario: Where obstacles appear.
        max_obstacles: Most obstacles K in an episode [1]. Range: 0 to 6.
        stream: Which independent stream of scenarios is played.

    Examples:
        >>> env = PushGym(simulator="planar")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, env.action_space.shape
        ((65,), (6,))
        >>> env.close()
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    def __init__(
        self,
        *,
        method: str = "cura-ppo",
        simulator: Simulator = "bullet",
        scenario: ScenarioKind = "mixed",
        max_obstacles: int = 6,
        stream: Stream = "train",
    ) -> None:
        config = _configured(preset(method), simulator, scenario, max_obstacles, stream)
        self._env = make_env(config, 1)
        self._state: TensorDictBase | None = None
        self._next = 0
        (seen,), (actions,) = (
            spec.shape[1:] for spec in (self._env.observation_spec[keys.OBSERVATION], self._env.action_spec)
        )
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (seen + LATENT_SIZE,), dtype=np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (actions,), dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Args:
            seed: Seed of the scenarios and of the LiDAR's noise; the first reset draws one when it is left out.
            options: ``scenario``, the index of the one to play; the next one when left out.

        Returns:
            Observation and info.
        """
        super().reset(seed=seed)
        given = {} if options is None else dict(options)
        if seed is not None or self._state is None:
            self._env.set_seed(int(self.np_random.integers(2**31)) if seed is None else seed)
            self._next = 0
        scenario = given.pop("scenario", self._next)
        require(not given, "options", sorted(given), "scenario")
        is_index = isinstance(scenario, int) and scenario >= 0
        require(is_index, "scenario", scenario, "0 or a greater integer")
        self._next = scenario + 1
        with torch.no_grad():
            self._state = self._env.reset(episodes=torch.tensor([scenario]))
        return _observation(self._state), _info(self._state, 0.0)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Play a policy step.

        Args:
            action: Base (vx, vy, wz) and end-effector (vx, vy, vz) as shares of their maxima, shape ``[6]``;
                without an arm the first three alone.

        Returns:
            Observation, reward, whether a collision ended the episode, whether time did, and info.

        Raises:
            RuntimeError: If the environment has not been reset.
        """
        if self._state is None:
            msg = "the environment has not been reset; accepted: reset() before step()"
            raise RuntimeError(msg)
        given = self._state.set(keys.ACTION, torch.as_tensor(action, dtype=torch.float32).reshape(1, -1))
        with torch.no_grad():
            self._state = state = self._env.step(given)["next"]
        ends = bool(state["terminated"]), bool(state["truncated"])
        return _observation(state), float(state[keys.REWARD]), *ends, _info(state, float(state[keys.COST]))

    def close(self) -> None:
        """Disconnect the simulator; harmless when done twice."""
        self._env.close(raise_if_closed=False)


def _configured(
    config: TrainConfig, simulator: Simulator, scenario: ScenarioKind, max_obstacles: int, stream: Stream
) -> TrainConfig:
    """Return a method's configuration, played alone and without a curriculum."""
    scene = dataclasses.replace(config.env.task.scenario, kind=scenario, max_obstacles=max_obstacles)
    task = dataclasses.replace(config.env.task, scenario=scene, stream=stream, random_first_age=False, curriculum=())
    return config.replace(env=dataclasses.replace(config.env, task=task, simulator=simulator), simulator=simulator)


def _observation(state: TensorDictBase) -> NDArray[np.float32]:
    values: NDArray[np.float32] = torch.cat([state[keys.OBSERVATION], state[keys.LATENT]], -1)[0].numpy()
    return values


def _info(state: TensorDictBase, cost: float) -> dict[str, Any]:
    success = state[keys.SUCCESS][0].numpy()
    return {
        "cost": cost,
        "contact": state[keys.CONTACT][0].numpy(),
        "success": success,
        "is_success": bool(success[0]),
        "scenario": int(state[keys.EPISODE]),
    }
