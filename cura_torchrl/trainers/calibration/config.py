"""Configuration of the calibration of the collision estimator: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cura_torchrl.envs.config import Simulator
from cura_torchrl.trainers.info import shipped_methods
from cura_torchrl.trainers.lists import require_known, split_names
from cura_torchrl.validation import require, require_fields

CONDITIONS: dict[str, dict[str, Any]] = {
    "on-policy": {},
    "big-object": {"object_edges": (1.2,)},
    "adversarial": {"kind": "adversarial"},
    "slippery": {"floor_friction": (0.15, 0.25)},
    "rough": {"floor_friction": (0.6, 0.9)},
}
"""What differs from the scenario of training, as fields of ``ScenarioConfig``."""


@dataclass(frozen=True, kw_only=True)
class CalibrateConfig:
    """Compare what the collision estimator predicts with what comes of it, and how much each policy looks."""

    methods: tuple[str, ...] = ("cura-ppo", "push")
    """Who plays, one after the other or joined by commas: methods whose weights are shipped, or folders of runs."""
    conditions: tuple[str, ...] = ("on-policy", "big-object", "adversarial", "slippery")
    """Under which scenarios, one after the other or joined by commas: on-policy, big-object, adversarial, slippery or
    rough; clones are of the first."""
    episodes: int = 100
    """Episodes of each method and condition [1]."""
    states: int = 60
    """States of each method that are cloned to know the truth, on the planar simulator [1]; 0 leaves that out."""
    futures: int = 256
    """Futures that are simulated from each of them [1]."""
    repeats: int = 4
    """Futures that share hidden obstacles and differ in what is still to come [1]; a divisor of the futures."""
    actions: Literal["mean", "drawn"] = "mean"
    """Whether the policy takes its mean action, as in evaluation, or draws it, as in training; drawn actions are those
    that the estimator was trained on."""
    candidates: int = 8192
    """Draws from the prior among which those are kept that agree with what was seen [1]."""
    simulator: Simulator = "planar"
    """Which simulator runs the worlds."""
    chunk: int = 50
    """Episodes that are played side by side [1]."""
    seed: int = 0
    """Seed of the scenes and of the redrawn obstacles [1]."""
    out: Path = Path("runs/calibrate")
    """Folder for ``calibration.json``, ``calibration.md`` and the figures."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("methods", "conditions"):
            object.__setattr__(self, name, split_names(getattr(self, name)))
            require(bool(getattr(self, name)), name, getattr(self, name), "one or more")
        for name in self.methods:
            if not Path(name).exists():
                require_known("method", name, shipped_methods(), otherwise=", or the folder of a run")
        for name in self.conditions:
            require_known("condition", name, CONDITIONS)
        require(self.candidates >= 1000, "candidates", self.candidates, "1000 or more, for few may agree")
        for name in ("episodes", "futures", "repeats", "chunk"):
            require(getattr(self, name) > 0, name, getattr(self, name), "1 or more")
        require(self.states >= 0, "states", self.states, "0 or more")
        fits = self.futures % self.repeats == 0 and min(self.futures // self.repeats, self.repeats) >= 2
        require(
            fits, "repeats", self.repeats, f"a divisor of {self.futures} futures, with 2 groups or more of 2 or more"
        )
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")
