"""The file that plots read."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import pytest

from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.errors import UnavailableError
from cura_torchrl.trainers.train import train
from cura_torchrl.trainers.training import progress as module
from cura_torchrl.trainers.training.progress import PROGRESS_NAME, Progress, read_progress

if TYPE_CHECKING:
    from pathlib import Path


def row(frames: int, **others: float) -> dict[str, float]:
    """One update's row."""
    return {"frames": frames, "frames_per_second": 1000.0, "max_obstacles": 2, "success": math.nan, **others}


def test_rows_after_the_checkpoint_are_dropped_on_resume(tmp_path: Path) -> None:
    """Catches a curve that runs back in time after a killed run is resumed."""
    config = TrainConfig(run_dir=tmp_path)
    first = Progress(config, frames=0)
    for frames in (100, 200, 300):
        first.add(row(frames))
    first.close()
    resumed = Progress(config, frames=200)
    resumed.add(row(1_234_567_891, extra=1.5))
    resumed.close()
    rows = read_progress(tmp_path / PROGRESS_NAME)
    assert [entry["frames"] for entry in rows] == [100, 200, 1_234_567_891]
    assert rows[-1]["extra"] == 1.5
    assert "extra" not in rows[0]


def test_a_row_that_was_cut_off_is_left_out(tmp_path: Path) -> None:
    """Catches a run that cannot be resumed because it was killed while writing."""
    path = tmp_path / PROGRESS_NAME
    path.write_text("frames,success\n100,0.5\n20", encoding="utf-8")
    assert [entry["frames"] for entry in read_progress(path)] == [100]


def test_a_run_killed_while_it_adds_a_column_keeps_its_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a file that is emptied before it is written anew: a kill in between would lose the whole curve."""
    path, progress = tmp_path / PROGRESS_NAME, Progress(TrainConfig(run_dir=tmp_path), frames=0)
    for frames in (100, 200):
        progress.add(row(frames))

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(module.csv.DictWriter, "writerows", killed)
    with pytest.raises(KeyboardInterrupt):
        progress.add(row(300, extra=1.5))
    progress.close()
    assert [entry["frames"] for entry in read_progress(path)] == [100, 200]


def test_a_logger_that_is_not_installed_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback from inside of a logger, after the worlds have been built."""
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UnavailableError, match=r"logger is 'wandb', which is not installed; accepted: csv"):
        Progress(TrainConfig(run_dir=tmp_path, logger="wandb"), frames=0)
    with pytest.raises(UnavailableError, match="logger is 'wandb'"):
        train(TrainConfig(run_dir=tmp_path / "run", logger="wandb", perception="none"))
    assert not (tmp_path / "run").exists()
