"""The report from end to end, with untrained networks and episodes of a second."""

from __future__ import annotations

import base64
import io
import re
from typing import TYPE_CHECKING

import pytest
import torch
from PIL import Image

from cura_torchrl.envs.config import ScenarioConfig
from cura_torchrl.envs.mdp import scenarios
from cura_torchrl.trainers import report as report_module
from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.pictures.recording import choose_scenes, find_scene
from cura_torchrl.trainers.report import ReportConfig, report
from tests.pages import Reader
from tests.runs import short_evaluation, tiny_run

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="4" height="3"/>'


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Scenes are over after five steps."""
    with short_evaluation():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two tiny runs, a table and a calibration."""
    path = tmp_path_factory.mktemp("report")
    for name in ("cura-ppo", "push"):
        tiny_run(name, path)
    (path / "table").mkdir()
    sha256 = load_policy(path / "cura-ppo").weights_sha256[:12]
    text = f"# Success rates\n\n| Method | uniform |\n|---|---|\n| CURA-PPO | 91.2 |\n\nWeights {sha256}\n"
    (path / "table" / "table.md").write_text(text, encoding="utf-8")
    (path / "calibration").mkdir()
    (path / "calibration" / "calibration.md").write_text("| n |\n|---|\n| 3 |\n\n![Bars](bars.png)\n", encoding="utf-8")
    for name in ("bars", "auroc"):
        Image.new("RGB", (4, 3), "red").save(path / "calibration" / f"{name}.png")
    (path / "calibration" / "auroc.svg").write_text(SVG, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    """The page with all its sections."""
    config = ReportConfig(
        runs=(str(folder / "cura-ppo"),),
        baseline=str(folder / "push"),
        table=folder / "table",
        calibration=folder / "calibration",
        out=folder / "pages" / "report.html",
        simulator="planar",
        max_obstacles=2,
    )
    return report(config).read_text(encoding="utf-8")


def test_the_page_is_one_whole_file(page: str) -> None:
    """Catches what is fetched from outside, a tag that is left open, a link to no section, a picture without text."""
    reader = Reader(page)
    inside = [reference[1:] for reference in reader.references if reference.startswith("#")]
    assert set(inside) <= set(reader.ids)
    assert len(inside) == 6
    assert all(reference.startswith(("data:image/", "#")) for reference in reader.references)
    assert {"script", "link", "iframe", "object"}.isdisjoint(reader.tags)
    without_pictures = re.sub(r"data:image/[\w+]+;base64,[A-Za-z0-9+/=]+", "", page)
    assert re.search(r"https?:|file:|url\(|@import|//\w", without_pictures) is None
    assert (reader.misnested, reader.open, reader.without_text) == ([], [], [])


def test_pictures_are_those_of_curves_scene_and_calibration(page: str) -> None:
    """Catches a picture that is missing, cut off or there twice in two formats."""
    found = re.findall(r'src="data:image/([\w+]+);base64,([^"]*)" alt="([^"]*)"', page)
    # Columns reward and lr; paths, animation, snapshots, distributions; bars and auroc, whose smaller file is the SVG.
    assert [kind for kind, _, _ in found] == ["png", "png", "png", "webp", "png", "png", "png", "svg+xml"]
    assert [text for _, _, text in found[-2:]] == ["Bars", "Auroc"]
    assert base64.b64decode(found[-1][1]).decode() == SVG
    for kind, data, _ in found[:-1]:
        with Image.open(io.BytesIO(base64.b64decode(data, validate=True))) as image:
            assert image.format == kind.upper()


def test_the_page_tells_what_the_run_is(page: str) -> None:
    """Catches a report that cannot be traced to weights, steps and settings, or that marks another's rows."""
    assert "3,000 environment steps on bullet" in page
    assert "CURA-PPO (cura-ppo)" in page
    assert "The rows that stand out are of the weights of this report." in page
    rows = Reader(page).rows
    assert ["CURA-PPO", "91.2"] in rows
    # Two rows of progress: (1.0 + 1.5) / 2.
    assert ["CURA-PPO", "3,000", "1.250"] in rows
    assert any(row[:3] == ["episode_time", "1.0", "100.0"] or row[:2] == ["episode_time", "1.0"] for row in rows)


def test_curves_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    """Catches a curve that takes the place of another whose file has the same name."""
    paths = tuple(tmp_path / name / "progress.csv" for name in ("one", "two"))
    for path in paths:
        path.parent.mkdir()
        path.write_text("frames,kl\n8,0.5\n", encoding="utf-8")
    assert list(report_module._more_curves(paths, taken=["progress"])) == [path.as_posix() for path in paths]
    assert list(report_module._more_curves(paths[:1], taken=["push"])) == ["progress"]


def test_what_is_not_given_is_told_with_its_command(folder: Path, tmp_path: Path) -> None:
    """Catches an empty section, and a run without progress or baseline that fails."""
    weights = load_policy(folder / "push").path
    copy = tmp_path / "weights"
    copy.mkdir()
    for file in (file for file in weights.rglob("*") if file.is_file()):
        target = copy / file.relative_to(weights)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(file.read_bytes())
    (tmp_path / "elsewhere.csv").write_text("frames,kl\n8,0.5\n", encoding="utf-8")
    out = tmp_path / "report.html"
    config = ReportConfig(
        runs=(str(copy),), baseline=None, out=out, simulator="planar", curves=(tmp_path / "elsewhere.csv",), scene=3
    )
    text = report(config).read_text(encoding="utf-8")
    assert "cura-torchrl table --methods push-no-occlusion,push --cells all" in text
    assert "cura-torchrl calibrate" in text
    assert "There is no <code>progress.csv</code>" in text
    assert ["elsewhere", "8"] in Reader(text).rows
    assert 'id="scene-3"' in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"table": "none"}, "no table.md in"),
        ({"calibration": "none"}, "no calibration.md in"),
        ({"curves": "push/none.csv"}, "no rows of progress in"),
        ({"out": "table"}, "a folder; accepted: a file to write"),
    ],
)
def test_bad_input_is_told_before_anything_is_played(
    folder: Path, changes: dict[str, str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches minutes of play that end in an error about a file."""
    monkeypatch.setattr(report_module, "record", None)
    paths = {name: (folder / value,) if name == "curves" else folder / value for name, value in changes.items()}
    with pytest.raises(RunError, match=message):
        report(ReportConfig(**{"runs": (str(folder / "push"),), "baseline": None, **paths}))


def test_a_table_of_other_weights_is_called_so(folder: Path, tmp_path: Path) -> None:
    """Catches a page that shows another policy's rates as those of its own."""
    (tmp_path / "table.md").write_text("| Method |\n|---|\n| Push w/ Occlusion |\n", encoding="utf-8")
    config = ReportConfig(
        runs=(str(folder / "push"),), baseline=None, table=tmp_path, out=tmp_path / "a.html", simulator="planar"
    )
    text = report(config).read_text(encoding="utf-8")
    assert "None of the rows is of the weights of this report" in text
    assert 'class="marked"><td class="text">Push' not in text


def test_a_scene_is_found_by_its_index() -> None:
    """Catches a scene other than the one that evaluate plays, and a scene that shows little by default."""
    chosen = choose_scenes(ScenarioConfig(kind="mixed"), seed=5, count=1)
    for scene in chosen:
        assert find_scene(ScenarioConfig(kind="mixed"), seed=5, index=scene.index) == scene
    drawn = scenarios.sample_scenarios(
        ScenarioConfig(kind="mixed"),
        stream="eval",
        seed=5,
        episodes=torch.arange(100),
        max_obstacles=6,
        tcp_reach=0.9,
    )
    first = next(index for index, count in enumerate(drawn["num_obstacles"].tolist()) if count == 6)
    assert find_scene(ScenarioConfig(kind="mixed"), seed=5).index == first
