"""The task whose scenes are evaluated, shown and drawn: frozen, and the same for whoever plays them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from cura_torchrl.envs.config import PhysicsConfig, ScenarioConfig, TaskConfig

if TYPE_CHECKING:
    from cura_torchrl.envs.config import PushEnvConfig, ScenarioKind


class SceneChoice(Protocol):
    """What configurations that play evaluation scenes have in common."""

    @property
    def scenario(self) -> ScenarioKind:
        """Where obstacles appear."""
        ...

    @property
    def object_size(self) -> float:
        """Edge of the pushed cube [m]."""
        ...

    @property
    def max_obstacles(self) -> int:
        """Most obstacles K in an episode [1]."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the scenes [1]."""
        ...


def evaluation_task(task: TaskConfig, config: SceneChoice) -> TaskConfig:
    """Return the task whose scenes a configuration chooses.

    Args:
        task: What the policy was trained on.
        config: Scenarios.

    Returns:
        The task.
    """
    edges = (config.object_size,)
    return frozen_task(
        task, ScenarioConfig(kind=config.scenario, object_edges=edges, max_obstacles=config.max_obstacles)
    )


def frozen_task(task: TaskConfig, scenario: ScenarioConfig) -> TaskConfig:
    """Return the task that is evaluated, and the true obstacles in what is emitted.

    Objects, obstacles, tolerances and times are the defaults, whatever a policy was trained on: scenes are paired, and
    outcomes compared, between policies. Of its own a policy has only the time between two actions.

    Args:
        task: What the policy was trained on.
        scenario: What differs from the default scenario, and the default elsewhere.

    Returns:
        The task.
    """
    # The obstacles are there for meters and pictures; a policy reads them only if it says so.
    return TaskConfig(scenario=scenario, stream="eval", privileged=True, policy_period=task.policy_period)


def evaluation_physics(env: PushEnvConfig) -> PhysicsConfig:
    """Return the physics in which policies are evaluated: the defaults, whatever a policy was trained in.

    Args:
        env: What the policy was trained in; whether the planar simulator captures a graph is kept, and, beside another
            time between two actions than the default, the clock that divides it.

    Returns:
        The physics.
    """
    kept = ["planar_graph"]
    if env.task.policy_period != TaskConfig().policy_period:
        kept += ["control_period", "planar_period"]
    return PhysicsConfig(**{name: getattr(env.physics, name) for name in kept})
