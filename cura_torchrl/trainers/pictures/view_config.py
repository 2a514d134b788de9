"""Configuration of the live view: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass

from cura_torchrl.envs.config import ScenarioKind, Simulator
from cura_torchrl.validation import require, require_fields


@dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """Play scenes in the browser: robot, box, obstacles, LiDAR, map, risk and uncertainty, step by step."""

    method: str = "cura-ppo"
    """Who plays: a method whose weights are shipped, or the folder of a run or checkpoint."""
    scenario: ScenarioKind = "adversarial"
    """Where obstacles appear."""
    object_size: float = 1.0
    """Edge of the pushed cube [m]."""
    max_obstacles: int = 6
    """Most obstacles K in a scene [1]. Range: 0 to 6."""
    scene: int = 0
    """Index of the first scene in the evaluation stream [1]; the browser can choose another."""
    seed: int = 0
    """Seed of the scenes [1]."""
    simulator: Simulator = "planar"
    """Which simulator runs the world."""
    recorded: bool = False
    """Whether a scene is played to its end first, and then shown with a slider of time."""
    speed: float = 1.0
    """How much faster than the robot the view is, as far as the machine keeps up [1]."""
    host: str = "127.0.0.1"
    """Address that serves the view; 0.0.0.0 shows it to the whole network."""
    port: int = 8080
    """Port that serves the view [1]; the next free one where it is taken."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(0.3 <= self.object_size <= 1.2, "object_size", self.object_size, "0.3 to 1.2 m")
        require(0 <= self.max_obstacles <= 6, "max_obstacles", self.max_obstacles, "0 to 6")
        require(self.speed > 0.0, "speed", self.speed, "a positive number")
        require(1 <= self.port < 65536, "port", self.port, "1 to 65535")
        for name in ("scene", "seed"):
            require(0 <= getattr(self, name) < 2**31, name, getattr(self, name), "0 to 2147483647")
