"""The task whose scenes are evaluated, shown and drawn: frozen, and the same for whoever plays them."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from cura_torchrl.envs.config import ScenarioKind, TaskConfig


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


def evaluation_task(task: TaskConfig, config: SceneChoice) -> TaskConfig:
    """Return a task with the scenes that are evaluated, and the true obstacles in what is emitted.

    Args:
        task: What the policy was trained on.
        config: Scenarios.

    Returns:
        The task.
    """
    scenario = dataclasses.replace(
        task.scenario, kind=config.scenario, object_edges=(config.object_size,), max_obstacles=config.max_obstacles
    )
    # The obstacles are there for meters and pictures; a policy reads them only if it says so.
    return dataclasses.replace(
        task, scenario=scenario, stream="eval", random_first_age=False, curriculum=(), privileged=True
    )
