"""Configuration of the report: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from cura_torchrl.envs.config import ScenarioKind, Simulator
from cura_torchrl.validation import require, require_fields


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """Write one HTML page about a trained policy: learning curves, table, a scene, calibration, configuration."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """What is reported: a method whose weights are shipped, or the folder of a run or checkpoint. The page is about the
    first one; the others add their learning curves."""
    out: Path = Path("report.html")
    """File to write; all pictures are in it."""
    table: Path | None = None
    """Folder that the command table wrote to; none leaves the success rates out."""
    calibration: Path | None = None
    """Folder that the command calibrate wrote to; none leaves the calibration out."""
    curves: tuple[Path, ...] = ()
    """Files like a run's progress.csv whose curves are drawn too."""
    baseline: str | None = "push"
    """Who plays the scene beside the run, and whose curves are drawn beside its own: as for runs; None is nobody."""
    scene: int | None = None
    """Index of the scene in the evaluation stream [1]; None is the first one with K obstacles."""
    scenario: ScenarioKind = "adversarial"
    """Where obstacles appear in the scene."""
    object_size: float = 1.0
    """Edge of the pushed cube in the scene [m]."""
    max_obstacles: int = 6
    """Most obstacles K in the scene [1]. Range: 0 to 6."""
    seed: int = 0
    """Seed of the scene [1]."""
    simulator: Simulator | None = None
    """Which simulator plays the scene; None is that of the run's training."""
    frame_stride: int = 3
    """Policy steps between two frames of the animation [1]."""

    def __post_init__(self) -> None:
        require_fields(self)
        require(bool(self.runs), "runs", self.runs, "one or more methods or folders")
        require(0.3 <= self.object_size <= 1.2, "object_size", self.object_size, "0.3 to 1.2 m")
        require(0 <= self.max_obstacles <= 6, "max_obstacles", self.max_obstacles, "0 to 6")
        require(self.scene is None or 0 <= self.scene < 2**31, "scene", self.scene, "0 to 2147483647")
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")
        require(self.frame_stride > 0, "frame_stride", self.frame_stride, "1 or more")
