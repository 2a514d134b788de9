"""Trained networks with all that is needed to run them: loaded from a checkpoint, or written as shipped weights are."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule

from cura_torchrl.trainers.build import Networks, make_env
from cura_torchrl.trainers.checkpoint import (
    find_checkpoint,
    read_config,
    restore,
    weights_sha256,
)
from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.evaluation.task import evaluation_physics, evaluation_task
from cura_torchrl.trainers.info import shipped_methods
from cura_torchrl.trainers.methods import PRESETS

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import PhysicsConfig, Simulator, TaskConfig
    from cura_torchrl.trainers.evaluation.task import SceneChoice

SHIPPED_FOLDER = Path(__file__).parent / "weights"
"""Folder of the weights that come with the package, one folder a method."""


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """Trained networks with all that is needed to run them."""

    policy: ProbabilisticTensorDictSequential
    """Actor; under TorchRL's ``ExplorationType.DETERMINISTIC`` it returns its mean."""
    critic: TensorDictModule
    """State value."""
    collision_estimator: TensorDictModule
    """Distribution of the collision possibility, risk and uncertainty."""
    config: TrainConfig
    """What the networks were trained with."""
    record: dict[str, Any]
    """Content of ``config.json``: frames, seed, versions, commit."""
    path: Path
    """Where the networks came from."""

    @property
    def weights_sha256(self) -> str:
        """SHA-256 that tells these weights from others."""
        return weights_sha256(self.path)

    def double(self) -> LoadedPolicy:
        """Let networks, and encoders of environments that are made from now on, compute in float64, in place.

        Float32 rounds differently on another processor and in batches of another size; over an episode that grows
        until one scene in fifty ends in another way. Evaluations compute in float64.

        Returns:
            The same policy.
        """
        for network in (self.policy, self.critic, self.collision_estimator):
            network.double()
        return self

    def make_env(
        self,
        num_envs: int,
        *,
        task: TaskConfig | None = None,
        physics: PhysicsConfig | None = None,
        simulator: Simulator | None = None,
        keep_map: bool = False,
        **options: Any,
    ) -> EnvBase:
        """Return the environment that the policy was trained for, on the frozen evaluation scenarios.

        Args:
            num_envs: Number of worlds N.
            task: Task to play; None is the trained one with all its obstacles.
            physics: Clock and contact; None are those of the training.
            simulator: Where to play; None is where the policy was trained.
            keep_map: Whether the window of the map stays in the tensordict under ``confidence_map``.
            **options: Keyword arguments of :class:`~cura_torchrl.envs.push.PushEnv`, such as ``seed``.

        Returns:
            The environment with its transforms.
        """
        played = self.config.env.task if task is None else task
        played = dataclasses.replace(played, stream="eval", random_first_age=False, curriculum=())
        where = simulator or self.config.simulator
        trained = self.config.env
        env = dataclasses.replace(trained, task=played, physics=physics or trained.physics, simulator=where)
        config = self.config.replace(env=env, simulator=where)
        dtype = next(self.policy.parameters()).dtype
        return make_env(config, num_envs, keep_map=keep_map, dtype=dtype, **options)

    def make_evaluation_env(
        self, num_envs: int, scenes: SceneChoice, *, simulator: Simulator | None = None, keep_map: bool = False
    ) -> EnvBase:
        """Return the environment in which all policies are evaluated, with this one's robot, sensors and clock.

        Args:
            num_envs: Number of worlds N.
            scenes: Which scenes.
            simulator: Where to play; None is where the policy was trained.
            keep_map: Whether the window of the map stays in the tensordict under ``confidence_map``.

        Returns:
            The environment with its transforms, and the true obstacles in what it emits.
        """
        trained = self.config.env
        return self.make_env(
            num_envs,
            task=evaluation_task(trained.task, scenes),
            physics=evaluation_physics(trained),
            simulator=simulator,
            keep_map=keep_map,
            seed=scenes.seed,
        )


def load_policy(source: str | Path) -> LoadedPolicy:
    """Load trained networks.

    Args:
        source: Name of a method whose weights are shipped, or the path of a run or checkpoint.

    Returns:
        Networks in evaluation mode on the CPU, and their configuration.

    Raises:
        CheckpointError: If there is no such method or path, or the checkpoint is damaged.
    """  # noqa: DOC502 - raised by what this calls
    path = find_checkpoint(_resolve(source))
    config, record = read_config(path)
    networks = read_networks(path, config).requires_grad_(False).eval()
    return LoadedPolicy(
        policy=networks.actor,
        critic=networks.critic,
        collision_estimator=networks.collision_network,
        config=config,
        record=record,
        path=path,
    )


def read_networks(path: Path, config: TrainConfig) -> Networks:
    """Return the networks of a checkpoint.

    Args:
        path: The checkpoint's folder; verify it first.
        config: Its configuration.

    Returns:
        Networks in training mode on the CPU.

    Raises:
        CheckpointError: If they do not fit the configuration.
    """  # noqa: DOC502 - raised by what this calls
    networks = Networks(config)
    restore(path, {"networks": networks})
    return networks


def _resolve(source: str | Path) -> Path:
    if isinstance(source, str) and source in PRESETS:
        shipped = SHIPPED_FOLDER / source
        if not shipped.exists():
            available = ", ".join(shipped_methods()) or "none"
            msg = f"no weights of method {source!r} are shipped; accepted: {available}, or the path of a checkpoint"
            raise CheckpointError(msg)
        return shipped
    path = Path(source)
    if not path.exists():
        msg = f"no checkpoint at {source}; accepted: the path of a run or checkpoint, or one of {', '.join(PRESETS)}"
        raise CheckpointError(msg)
    return path
