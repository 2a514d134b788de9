"""From what is emitted to numbers, tables and figures: which states count, and what is written."""

from __future__ import annotations

import io
import json
import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from cura_torchrl.trainers.calibrate import _LOOKING, Track, _write, calibrate, looking
from cura_torchrl.trainers.calibration.config import CalibrateConfig
from cura_torchrl.trainers.calibration.figures import coverage_figure, reliability_figure, truth_figure
from cura_torchrl.trainers.calibration.futures import decompose, summarise
from cura_torchrl.trainers.calibration.report import as_markdown
from cura_torchrl.trainers.calibration.scores import LEVELS, PROBABILITY_EDGES, Predictions, measure

if TYPE_CHECKING:
    from pathlib import Path


def _estimator(state: TensorDict) -> TensorDict:
    return state.set("collision_atoms", state["observation"][:, :1].expand(-1, 50).clone())


def _watch(track: Track, episode: int, *, steps: int, goal: int, terminated: bool) -> None:
    """Let one world play an episode whose observation is its step, reaching the goal at a step."""
    for step in range(steps + 1):
        content = {
            "observation": torch.tensor([[float(step)]]),
            "latent": torch.zeros(1, 1),
            "episode": torch.tensor([[episode]]),
            "elapsed_steps": torch.tensor([[step]]),
            "success": torch.tensor([[step >= goal] * 3]),
            "terminated": torch.tensor([[terminated and step == steps]]),
        }
        track.watch(TensorDict(content, [1]), torch.tensor([True]))


def test_states_count_before_goal_end_and_time_limit():
    """Catches states after the goal, the last state, and outcomes of another episode."""
    track = Track(_estimator)
    _watch(track, 7, steps=60, goal=10, terminated=False)  # known: 60 - 9 steps are left at the last one
    _watch(track, 3, steps=4, goal=99, terminated=True)
    _watch(track, 5, steps=60, goal=99, terminated=False)  # known until step 16, with 44 left, beyond the limit
    found = track.predictions(gamma=0.9, limit=15)
    assert found.episode.tolist() == [3] * 4 + [5] * 15 + [7] * 10
    assert found.atoms[:, 0].tolist() == [*range(4), *range(15), *range(10)]
    assert found.possibility.tolist() == pytest.approx([0.729, 0.81, 0.9, 1.0] + [0.0] * 25)


def test_looking_is_averaged_over_states_and_resampled_over_episodes():
    """Catches intervals over states: two episodes of one value each give bounds at these values."""
    values, episodes = torch.tensor([1.0] * 9 + [3.0] * 9), torch.tensor([4] * 9 + [8] * 9)
    samples = dict.fromkeys(_LOOKING, (values, episodes))
    samples["first_seen_s"] = (values[:0], episodes[:0])
    found = looking(samples)
    assert found["beside_m"] == [2.0, 1.0, 3.0]
    assert all(math.isnan(value) for value in found["first_seen_s"])


def test_variance_splits_between_hidden_layouts_and_their_futures():
    """Catches biased components: normal layouts of variance 4, futures of variance 1."""
    rng = np.random.default_rng(0)
    values = 2.0 * rng.standard_normal((4000, 1)) + rng.standard_normal((4000, 3)) + 5.0
    found = decompose(values)
    assert found["true_mean"] == pytest.approx(5.0, abs=0.15)
    assert found["hidden_variance"] == pytest.approx(4.0, rel=0.1)
    assert found["future_variance"] == pytest.approx(1.0, rel=0.05)
    assert found["true_variance"] == pytest.approx(5.0, rel=0.08)
    assert found["mean_error"] == pytest.approx(math.sqrt((4 + 1 / 3) / 4000), rel=0.1)


def _truth(count: int = 40) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    true = rng.random(count)
    return {
        "true_mean": true, "predicted_mean": true + 0.1, "true_variance": 0.2 * true, "predicted_variance": 0.1 * true,
        "hidden_variance": 0.15 * true, "future_variance": 0.05 * true, "mean_error": np.full(count, 0.01),
        "hidden": np.ones(count), "hidden_drawn": np.full(count, 1.2), "kept": np.full(count, 500),
        "episode": np.arange(count) // 2, "by_risk": np.arange(count) % 2 == 1,
    }  # fmt: skip


def test_the_truth_is_compared_by_correlation_bias_and_root_mean_square():
    """Catches signs that are turned round: 0.1 too high everywhere, and half of the variance."""
    found = summarise(_truth())
    assert set(found) == {"all", "at_random"}
    assert (found["all"]["states"], found["at_random"]["states"], found["all"]["episodes"]) == (40, 20, 20)
    assert found["all"]["mean_pearson"][0] == pytest.approx(1.0)
    assert found["all"]["mean_bias"] == pytest.approx([0.1] * 3)
    assert found["all"]["mean_rmse"] == pytest.approx([0.1] * 3)
    assert found["all"]["variance_bias"][0] == pytest.approx(-0.1 * _truth()["true_mean"].mean())
    shares = [found["all"][f"share_{name}"][0] for name in ("states", "hidden", "future")]
    assert sum(shares) == pytest.approx(1.0)
    assert shares[1] == pytest.approx(3 * shares[2])


def _result() -> dict[str, object]:
    rng = np.random.default_rng(2)
    risk = rng.random(4000) ** 4
    atoms = np.where(np.arange(50) < 50 * risk[:, None], 0.6, 0.001).astype(np.float32)
    data = Predictions(
        atoms=atoms,
        possibility=np.where(rng.random(4000) < risk, 0.6, 0.0),
        episode=np.arange(4000) // 40,
        gamma=0.9,
    )
    numbers = measure(data, draws=20) | {"looking": {name: [1.0, 0.5, 1.5] for name in _LOOKING}}
    parts = {"on-policy": numbers, "slippery": numbers, "truth": summarise(_truth())}
    config = {"seed": 0, "episodes": 100, "simulator": "planar", "futures": 64}
    return {"command": "cura-torchrl calibrate", "commit": "abc", "config": config, "methods": {"a": parts, "b": parts}}


def test_the_page_has_a_row_for_each_method_and_condition():
    """Catches a condition or a method that is left out, and tables whose rows have other columns than their head."""
    page = as_markdown(_result())
    for method in ("a", "b"):
        for condition in ("on-policy", "slippery"):
            assert page.count(f"| {method} | {condition} |") == 4
    assert "a, at random (20)" in page
    columns = [[line.count("|") for line in part.splitlines()] for part in page.split("\n\n") if part.startswith("|")]
    assert len(columns) == 5
    assert all(len(set(counts)) == 1 for counts in columns)


def test_the_figures_are_small_pictures():
    """Catches a figure that cannot be drawn, or that is too large for the documentation."""
    methods = _result()["methods"]
    assert len(LEVELS) == len(PROBABILITY_EDGES) - 1 == 9
    for content in (
        reliability_figure(methods),
        coverage_figure(methods),
        truth_figure({"a": _truth(), "b": _truth()}),
    ):
        assert len(content) < 200_000
        width, height = Image.open(io.BytesIO(content)).size
        assert min(width, height) > 300


def test_what_is_written_is_strict_json_with_every_state(tmp_path: Path):
    """Catches NaN, which no JSON reader has to accept, and states that are lost."""
    result = _result()
    result["methods"]["a"]["on-policy"]["numbers"]["auroc"] = [math.nan] * 3
    page = _write(tmp_path, result, {"a": _truth()})
    assert (tmp_path / "calibration.md").read_text(encoding="utf-8") == page
    content = (tmp_path / "calibration.json").read_text(encoding="utf-8")
    assert "NaN" not in content
    found = json.loads(content)
    assert found["methods"]["a"]["on-policy"]["numbers"]["auroc"] == [None] * 3
    assert len(found["truth_states"]["a"]["true_mean"]) == 40
    assert {path.name for path in tmp_path.glob("*.png")} == {"reliability.png", "coverage.png", "truth.png"}
    for name in ("reliability", "coverage", "truth"):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert picture.width > 300


def test_drawn_actions_are_played_and_looked_ahead_with_and_come_again(tmp_path: Path):
    """Catches states or futures of mean actions where drawn ones were asked for, and draws that change between runs."""
    found = []
    for number, actions in enumerate(("mean", "drawn", "drawn")):
        config = CalibrateConfig(
            methods=("cura-ppo",), conditions=("adversarial",), episodes=2, chunk=2, states=1, futures=4, repeats=2,
            candidates=1000, actions=actions, out=tmp_path / str(number),
        )  # fmt: skip
        calibrate(config)
        page = json.loads((config.out / "calibration.json").read_text(encoding="utf-8"))
        looking, truth = page["methods"]["cura-ppo"]["adversarial"]["looking"], page["truth_states"]["cura-ppo"]
        found.append((looking["beside_m"], truth["predicted_mean"]))
    assert found[1] == found[2]
    assert all(mean != drawn for mean, drawn in zip(*found[:2], strict=True))
