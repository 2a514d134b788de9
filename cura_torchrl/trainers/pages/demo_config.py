"""Configuration of the demo: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cura_torchrl.envs.config import Simulator
from cura_torchrl.validation import require, require_fields


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """Play two trained policies on the same frozen scenes, write a page to look at, and train on for a little."""

    run_dir: Path = Path("runs/demo")
    """Folder for the page and for what is trained."""
    policies: tuple[str, str] = ("cura-ppo", "push")
    """Who plays: methods whose weights are shipped, or folders of runs; the first one is trained on."""
    scenes: int = 6
    """Scenes of each scenario, adversarial and uniform [1]."""
    simulator: Simulator = "bullet"
    """Which simulator runs the worlds that are shown; training goes on where it was begun."""
    object_sizes: tuple[float, ...] = (0.5, 0.75, 1.0)
    """Edges of the pushed cube, which take turns [m]."""
    max_obstacles: int = 6
    """Most obstacles K in a scene [1]; scenes have at least one. Range: 1 to 6."""
    seed: int = 1
    """Seed of the scenes [1]; scene i of a seed is the one that evaluate plays with mixed scenarios. Seed 0 is
    that of the results."""
    frame_stride: int = 3
    """Policy steps between two recorded scans and maps [1]; an animation shows one of them in a frame."""
    telling_scenes: int = 3
    """Scenes that come first, smoothly animated [1]; the others show every second frame."""
    train_iterations: int = 5
    """Updates that the first policy is trained on for [1]; 0 leaves training out."""
    train_envs: int = 32
    """Worlds that are played side by side while training [1]."""
    num_workers: int = 2
    """Processes that play and draw [1]; 1 does it in this process."""
    docs_dir: Path | None = None
    """Folder to write the documentation's pictures to; none writes no pictures."""
    open_browser: bool = False
    """Whether the page is opened in the web browser in the end."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("scenes", "frame_stride", "train_envs", "num_workers"):
            require(getattr(self, name) > 0, name, getattr(self, name), "1 or more")
        for name in ("telling_scenes", "train_iterations"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "0 or more")
        require(1 <= self.max_obstacles <= 6, "max_obstacles", self.max_obstacles, "1 to 6")
        sizes_fit = bool(self.object_sizes) and all(0.3 <= size <= 1.2 for size in self.object_sizes)
        require(sizes_fit, "object_sizes", self.object_sizes, "one or more of 0.3 to 1.2 m")
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")
