"""Learning curves: nothing is left out, and means are those of the updates around."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image, ImageColor

from cura_torchrl.trainers.pictures import raster
from cura_torchrl.trainers.pictures.curves import columns_by_group, curves_figure, label_of, smooth, window_of


def count(content: bytes, colour: str) -> int:
    """Return how many pixels have nearly a colour."""
    with Image.open(io.BytesIO(content)) as image:
        picture = np.asarray(image.convert("RGB")).astype(int)
    return int((np.abs(picture - ImageColor.getrgb(colour)) < 12).all(-1).sum())


def test_means_do_not_lag_and_skip_what_is_not_known() -> None:
    """Catches a mean over the past alone, which draws a drop later than it is, and a NaN that swallows the rest."""
    values = [0.0, 0.0, 0.0, float("nan"), 6.0, 6.0, 6.0]
    rows = [{"frames": 2e6 * i, "x": value} for i, value in enumerate(values)]
    frames, means = smooth(rows, "x", 3)
    assert frames.tolist() == [0.0, 2.0, 4.0, 8.0, 10.0, 12.0]
    assert means.tolist() == [0.0, 0.0, 2.0, 4.0, 6.0, 6.0]
    assert smooth(rows, "y")[0].size == 0


@pytest.mark.parametrize("updates", [1, 2, 29, 31, 204, 5000])
def test_windows_are_odd_and_small(updates: int) -> None:
    """Catches a window that is not around its point."""
    window = window_of([{}] * updates)
    assert window % 2 == 1
    assert window <= max(1, updates / 10)


def test_every_column_is_drawn_once() -> None:
    """Catches a reward term or a column of one's own that no plot shows, and columns that hold no number."""
    row = {"frames": 1.0, "success": 0.1, "success_0.50m": 0.2, "reward": 1.0, "reward/own_term": 2.0, "own": 3.0}
    groups = columns_by_group({"a": [row], "b": [{"frames": 1.0, "kl": 0.1, "entropy": float("nan")}]})
    assert groups["How episodes end"] == ["success", "success_0.50m"]
    assert groups["Reward"] == ["reward", "reward/own_term"]
    assert groups["Optimisation"] == ["kl"]
    assert groups["Other columns"] == ["own"]
    assert [name for columns in groups.values() for name in columns].count("success") == 1


def test_labels_carry_units() -> None:
    """Catches an axis without a unit for a column that training writes."""
    names = ("success", "success_1.00m", "reward/contact", "object_speed", "kl", "lr", "frames_per_second", "episodes")
    assert all(label_of(name).endswith("]") for name in names)


def test_each_run_is_drawn_in_its_colour() -> None:
    """Catches a run that is missing, or that covers another one."""
    rising = [{"frames": 1e6 * i, "success": i / 40, "lr": 1e-4} for i in range(40)]
    falling = [{**row, "success": 1.0 - row["success"]} for row in rising]
    alone = curves_figure({"rising": rising}, ["success", "lr"])
    both = curves_figure({"rising": rising, "falling": falling}, ["success", "lr"])
    assert count(alone, raster.RISK) == 0
    assert min(count(both, raster.RISK), count(both, raster.UNCERTAINTY)) > 200
