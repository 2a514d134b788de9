"""Configuration of the figures: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from cura_torchrl.envs.config import ScenarioKind, Simulator
from cura_torchrl.trainers.info import shipped_methods
from cura_torchrl.trainers.lists import require_known, split_names
from cura_torchrl.validation import require, require_fields

FigureName = Literal["paths", "snapshots", "distribution", "appearance", "layout"]
"""Figures of the paper: paths; paths with maps; the DCE's distribution; how an obstacle appears; the environment."""
StillFormat = Literal["png", "svg"]
AnimationFormat = Literal["mp4", "gif", "webp"]
ViewName = Literal["top", "3d", "both"]
FIGURES: tuple[FigureName, ...] = get_args(FigureName)
STILL_FORMATS: tuple[StillFormat, ...] = get_args(StillFormat)
ANIMATION_FORMATS: tuple[AnimationFormat, ...] = get_args(AnimationFormat)


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Play one frozen scene with any methods, and write the paper's figures of it and animations."""

    methods: tuple[str, ...] = ("push", "cura-ppo")
    """Who plays, shown side by side, one after the other or joined by commas: methods whose weights are shipped, or
    folders of runs or checkpoints."""
    scene: int = 0
    """Which scene: that which evaluate and table play under this index with the same scenario, size and seed [1]."""
    scenario: ScenarioKind = "adversarial"
    """Where obstacles appear."""
    object_size: float = 1.0
    """Edge of the pushed cube [m]; the paper's are 0.5, 0.75 and 1.0."""
    max_obstacles: int = 6
    """Most obstacles K in an episode; the count is uniform in 0..K. Range: 0 to 6."""
    seed: int = 0
    """Seed of the scenes [1]."""
    simulator: Simulator = "bullet"
    """Which simulator runs the worlds."""
    figures: tuple[str, ...] = ("all",)
    """What is drawn: paths, snapshots (paths with maps), distribution (the estimator's), appearance (of an obstacle),
    layout (of the environment); all is every one, none leaves still pictures out."""
    formats: tuple[str, ...] = ("png", "webp")
    """Files to write, joined by commas: png and svg for figures; mp4 (extra "video"), gif and webp for animations."""
    view: ViewName = "top"
    """What animations show: the scene from above with map and estimate, the scene in 3-D, or both, as files of their
    own."""
    times: tuple[float, ...] = ()
    """Moments of snapshots and distributions [s], at most 6; none takes the first obstacle's appearance, the highest
    uncertainty, and the end."""
    every: int = 3
    """Policy steps from one frame of an animation to the next [1]."""
    fps: float = 10.0
    """Frames of an animation shown per second [Hz]; with 3 steps of 0.2 s from one to the next, 10 is six times as fast
    as it was."""
    size: tuple[int, int] = (640, 480)
    """Width and height of a method's 3-D picture [pixel]; the time for a frame grows with their product."""
    out: Path = Path("runs/render")
    """Folder for the files."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("methods", "figures", "formats"):
            object.__setattr__(self, name, split_names(getattr(self, name)))
        self._require_names()
        for name in ("scene", "seed"):
            require(0 <= getattr(self, name) < 2**31, name, getattr(self, name), "0 to 2147483647")
        require(0.3 <= self.object_size <= 1.2, "object_size", self.object_size, "0.3 to 1.2 m")
        require(0 <= self.max_obstacles <= 6, "max_obstacles", self.max_obstacles, "0 to 6")
        require(self.every > 0, "every", self.every, "1 or more")
        require(1.0 <= self.fps <= 60.0, "fps", self.fps, "1 to 60 Hz")
        are_sizes = all(
            least <= edge <= 2048 and edge % 2 == 0 for least, edge in zip((480, 240), self.size, strict=True)
        )
        require(are_sizes, "size", self.size, "even numbers, 480 to 2048 by 240 to 2048 pixels")
        are_times = list(self.times) == sorted(set(self.times)) and min(self.times, default=0.0) >= 0.0
        require(are_times and len(self.times) <= 6, "times", self.times, "at most 6 growing times [s]")

    def _require_names(self) -> None:
        require(1 <= len(self.methods) <= 4, "methods", self.methods, "1 to 4 methods")
        for name in self.methods:
            if not Path(name).is_dir():
                require_known("method", name, shipped_methods(), otherwise=", or the folder of a run or checkpoint")
        for name in self.figures:
            require_known("figure", name, ("all", "none", *FIGURES))
        known_formats = (*STILL_FORMATS, *ANIMATION_FORMATS)
        require(bool(self.formats), "formats", self.formats, f"one or more of {', '.join(known_formats)}")
        for name in self.formats:
            require(name in known_formats, "format", name, ", ".join(known_formats))

    @property
    def drawn(self) -> tuple[FigureName, ...]:
        """Figures that are drawn."""
        return tuple(name for name in FIGURES if {name, "all"} & set(self.figures))

    @property
    def still_formats(self) -> tuple[StillFormat, ...]:
        """Formats of figures."""
        return tuple(name for name in STILL_FORMATS if name in self.formats)

    @property
    def animation_formats(self) -> tuple[AnimationFormat, ...]:
        """Formats of animations."""
        return tuple(name for name in ANIMATION_FORMATS if name in self.formats)

    @property
    def views(self) -> tuple[Literal["top", "3d"], ...]:
        """Views that are animated."""
        return ("top", "3d") if self.view == "both" else (self.view,)
