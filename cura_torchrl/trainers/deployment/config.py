"""Configuration of the export: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cura_torchrl.trainers.methods import method
from cura_torchrl.validation import require


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Write a trained policy, with its map and its collision estimator, as graphs that a robot runs without PyTorch."""

    checkpoint: Path | None = None
    """Trained policy: a run's or a checkpoint's folder."""
    method: str | None = None
    """Trained policy: a method whose weights are shipped."""
    out: Path = Path("runs/export")
    """Folder to write; it must be empty or not there."""
    check_steps: int = 50
    """Policy steps of each of the two recorded episodes that the graphs are compared with PyTorch on [1]."""

    def __post_init__(self) -> None:
        given = [str(value) for value in (self.checkpoint, self.method) if value is not None]
        require(len(given) == 1, "policy to export", given, "one of checkpoint, method")
        if self.method is not None:
            method(self.method)
        require(self.check_steps > 0, "check_steps", self.check_steps, "1 or more")
        is_free = not self.out.exists() or (self.out.is_dir() and not any(self.out.iterdir()))
        require(
            is_free and self.out.name not in {"", ".."},
            "out",
            str(self.out),
            "a folder that is empty or not there, by its name",
        )
