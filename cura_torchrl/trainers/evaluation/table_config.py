"""Configuration of the table of success rates: pure data, importable without torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

from cura_torchrl.envs.config import ScenarioKind, Simulator
from cura_torchrl.trainers.evaluation.paper_table import PAPER_CELLS
from cura_torchrl.trainers.info import shipped_methods
from cura_torchrl.trainers.lists import Numbers, require_known, split_names
from cura_torchrl.trainers.methods import PRESETS
from cura_torchrl.validation import require, require_fields

if TYPE_CHECKING:
    from collections.abc import Iterable

CHUNKS: dict[Simulator, int] = {"bullet": 20, "planar": 250}
"""Episodes that are played side by side by default [1]: worlds made of tensors are cheaper in large batches."""

_CELL_NAMES = f"all, or SCENARIO-SIZE with {', '.join(get_args(ScenarioKind))} and 0.3 to 1.2 m, such as uniform-0.5"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """Where scenes are alike: one column of the table."""

    scenario: ScenarioKind
    """Where obstacles appear."""
    object_size: float
    """Edge of the pushed cube [m]."""

    @property
    def name(self) -> str:
        """Name on the command line, such as ``uniform-0.5``."""
        return f"{self.scenario}-{self.object_size}"


def parse_cell(name: str) -> Cell:
    """Return the cell that a name stands for.

    Args:
        name: Scenario and edge of the pushed cube [m], joined by a hyphen.

    Returns:
        The cell.

    Raises:
        ValueError: If there is no such cell; one line.

    Examples:
        >>> parse_cell("adversarial-0.75")
        Cell(scenario='adversarial', object_size=0.75)
    """  # noqa: DOC502 - raised by what this calls
    scenario, _, size = name.rpartition("-")
    try:
        edge = float(size)
    except ValueError:
        edge = 0.0
    require(scenario in get_args(ScenarioKind) and 0.3 <= edge <= 1.2, "cell", name, _CELL_NAMES)
    return Cell(scenario=cast("ScenarioKind", scenario), object_size=edge)


@dataclass(frozen=True, kw_only=True)
class TableConfig:
    """Play every method in every cell and write the table of success rates; what is played already is kept."""

    methods: tuple[str, ...] = ("push-no-occlusion", "push", "cura-ppo")
    """Who plays, one after the other or joined by commas: methods whose weights are shipped, or, with seeds, any."""
    cells: tuple[str, ...] = ("all",)
    """Scenario and edge of the pushed cube, such as uniform-0.5 or adversarial-0.75, one after the other or joined by
    commas; all is the paper's six."""
    episodes: int = 100
    """Scenes of each cell [1]."""
    max_obstacles: int = 6
    """Most obstacles K in an episode; the count is uniform in 0..K. Range: 0 to 6."""
    seed: int = 0
    """Seed of the scenes [1]."""
    seeds: Numbers = ()
    """Training seeds, one after the other or joined by commas: the policies are then the runs METHOD-SEED in the folder
    of runs; none takes shipped weights."""
    runs: Path = Path("runs")
    """Folder of runs, for the training seeds."""
    simulator: Simulator = "bullet"
    """Which simulator runs the worlds."""
    out: Path = Path("runs/table")
    """Folder for the outcomes and the table."""
    num_workers: int = 2
    """Processes that play [1]; results do not depend on it."""
    chunk: int | None = None
    """Episodes that a process plays side by side [1], 20 on PyBullet and 250 on planar if not given; results do not
    depend on it."""
    compare_with: Path | None = None
    """File of outcomes, of this or the other simulator: tells how many of the same scenes ended alike."""

    def __post_init__(self) -> None:
        require_fields(self)
        object.__setattr__(self, "methods", split_names(self.methods))
        object.__setattr__(self, "cells", tuple(cell.name for cell in _cells(split_names(self.cells))))
        require(bool(self.methods), "methods", self.methods, "one or more methods")
        require(bool(self.cells), "cells", self.cells, _CELL_NAMES)
        known = tuple(PRESETS) if self.seeds else tuple(shipped_methods())
        for name in self.methods:
            require_known("method", name, known)
        require(0 <= self.max_obstacles <= 6, "max_obstacles", self.max_obstacles, "0 to 6")
        for field in ("episodes", "num_workers", "side_by_side"):
            require(getattr(self, field) > 0, field.replace("side_by_side", "chunk"), getattr(self, field), "1 or more")
        where = self.compare_with
        require(where is None or where.is_file(), "compare_with", str(where), "a file of outcomes")
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")
        are_seeds = all(0 <= seed < 2**31 for seed in self.seeds) and len(set(self.seeds)) == len(self.seeds)
        require(are_seeds, "seeds", self.seeds, "different ones of 0 to 2147483647")

    @property
    def side_by_side(self) -> int:
        """Episodes that a process plays side by side [1]."""
        return CHUNKS[self.simulator] if self.chunk is None else self.chunk


def _cells(names: Iterable[str]) -> list[Cell]:
    """Return the cells, each once."""
    spelt = [part for name in names for part in (PAPER_CELLS if name == "all" else (name,))]
    return list(dict.fromkeys(parse_cell(name) for name in spelt))
