"""The table is what the outcomes say, however often playing was broken off."""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch

from cura_torchrl.trainers.build import Networks
from cura_torchrl.trainers.checkpoint import CHECKPOINT_FOLDER, save_checkpoint
from cura_torchrl.trainers.errors import CheckpointError, RunError, UnavailableError
from cura_torchrl.trainers.evaluation.measures import Measures
from cura_torchrl.trainers.evaluation.outcomes import PolicyRecord
from cura_torchrl.trainers.evaluation.paper_table import PAPER_CELLS, PAPER_SUCCESS, paper_success
from cura_torchrl.trainers.evaluation.parts import BATCHES, Part, Player
from cura_torchrl.trainers.evaluation.table_config import TableConfig
from cura_torchrl.trainers.evaluation.table_figure import table_figure
from cura_torchrl.trainers.evaluation.table_numbers import compare
from cura_torchrl.trainers.evaluation.table_parquet import write_parquet
from cura_torchrl.trainers.evaluation.table_report import as_csv, as_latex, as_markdown, latex
from cura_torchrl.trainers.methods import METHODS as METHOD_LABELS
from cura_torchrl.trainers.table import STORE_NAME, table
from tests.episodes import run_of
from tests.runs import short_evaluation, small_run

if TYPE_CHECKING:
    from collections.abc import Iterator

    from cura_torchrl.trainers.evaluation.episodes import Episode

METHODS = ("push-no-occlusion", "push", "cura-ppo")
METHODS_2 = ("push-conf", "cura-no-risk")
CELLS = ("uniform-0.5", "adversarial-1.0")


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Scenes are over after five steps, and a part has five for each world."""
    with short_evaluation(), pytest.MonkeyPatch.context() as patch:
        patch.setitem(BATCHES, "planar", 5)
        yield


@pytest.fixture(autouse=True)
def one_commit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The checkout's commit, which someone may change meanwhile."""
    monkeypatch.setattr("cura_torchrl.trainers.table.git_commit", lambda: "c0ffee")


def played(**letters: str) -> dict[str, dict[str, list[list[Episode]]]]:
    """One run a method in one cell, from outcomes by method; ``free`` is the one without occlusion."""
    names = {"free": "push-no-occlusion", "push": "push", "cura": "cura-ppo"}
    return {names[name]: {"uniform-0.5": [run_of(outcomes)]} for name, outcomes in letters.items()}


def untrained(folder: Path, method: str, seed: int, frames: int = 8) -> None:
    """Write the run METHOD-SEED of untrained networks."""
    torch.manual_seed(seed)
    config = small_run(folder / f"{method}-{seed}", updates=1, method=method, simulator="planar")
    save_checkpoint({"networks": Networks(config)}, config, config.run_dir / CHECKPOINT_FOLDER, frames=frames)


def tiny(folder: Path, out: str, **changes: object) -> TableConfig:
    """Two methods in a cell of seven scenes, in parts of five and two."""
    options = {
        "methods": ("push,cura-ppo",),
        "cells": CELLS[:1],
        "episodes": 7,
        "chunk": 1,
        "seeds": (0,),
        "num_workers": 1,
    }
    return TableConfig(**options | {"simulator": "planar", "runs": folder, "out": folder / out} | changes)


def rows_of(path: Path) -> list[tuple[object, ...]]:
    """All outcomes of a file."""
    with closing(sqlite3.connect(path)) as database:
        return database.execute("SELECT * FROM outcomes").fetchall()


def played_rows(path: Path) -> bool:
    """Whether a file that may still be made holds outcomes."""
    try:
        return bool(rows_of(path))
    except sqlite3.OperationalError:
        return False


def test_a_run_that_was_broken_off_ends_with_the_same_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches scenes that are lost, counted twice or played differently after the command was killed."""
    untrained(tmp_path, "push", 0)
    untrained(tmp_path, "cura-ppo", 0)
    whole = table(tiny(tmp_path, "whole"))
    play, parts = Player.play, []

    def dies_in_the_third_part(self: Player, part: Part, report: object) -> list[Episode]:
        parts.append(part.index)
        played = play(self, part, report)
        if len(parts) == 3:
            raise KeyboardInterrupt
        return played

    monkeypatch.setattr(Player, "play", dies_in_the_third_part)
    with pytest.raises(KeyboardInterrupt):
        table(tiny(tmp_path, "broken"))
    assert len(rows_of(tmp_path / "broken" / STORE_NAME)) == 7
    assert table(tiny(tmp_path, "broken")) == whole
    assert parts == [0, 1, 0, 0, 1]  # the part that was being played is played again, no other one
    assert table(tiny(tmp_path, "broken")) == whole
    assert len(parts) == 5
    assert rows_of(tmp_path / "broken" / STORE_NAME) == rows_of(tmp_path / "whole" / STORE_NAME)
    for name in ("table.md", "table.csv", "table.tex"):
        assert (tmp_path / "broken" / name).read_text() == (tmp_path / "whole" / name).read_text()


def shorten_episodes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the processes that are started, and theirs, play episodes of one second, in parts of five for each world."""
    patch = """import functools
from cura_torchrl.envs.config import TaskConfig
from cura_torchrl.trainers.evaluation import parts
from cura_torchrl.trainers.evaluation import task as evaluation_task
evaluation_task.TaskConfig = functools.partial(TaskConfig, episode_time=1.0)
parts.BATCHES["planar"] = 5
"""
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(patch, encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), *sys.path]))


def test_a_run_that_was_killed_goes_on_and_ends_with_the_same_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a file that SIGKILL leaves half written, and processes that play on without a parent."""
    untrained(tmp_path, "push", 0)
    shorten_episodes(tmp_path / "start", monkeypatch)
    flags = ["--methods", "push", "--cells", ",".join(CELLS), "--seeds", "0", "--runs", str(tmp_path)]
    options = [*flags, "--episodes", "24", "--chunk", "2", "--simulator", "planar", "--num-workers", "2"]
    command = [sys.executable, "-m", "cura_torchrl.trainers.cli", "table", *options, "--out"]
    killed, whole = tmp_path / "killed" / STORE_NAME, tmp_path / "whole" / STORE_NAME
    with subprocess.Popen(
        [*command, str(killed.parent)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 200
        while time.monotonic() < deadline and not (killed.exists() and played_rows(killed)):
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        # The pipe closes when the last of those that hold it has ended: the workers too.
        process.communicate(timeout=60)
    assert 0 < len(rows_of(killed)) < 48
    assert len(rows_of(killed)) % 2 == 0
    pages = [
        subprocess.run([*command, str(path.parent)], capture_output=True, text=True, check=True).stdout
        for path in (killed, whole)
    ]
    assert pages[0] == pages[1]
    assert rows_of(killed) == rows_of(whole)
    for name in ("table.md", "table.csv", "table.tex", "table.png", "table.svg"):
        assert (killed.parent / name).read_bytes() == (whole.parent / name).read_bytes()


def test_another_file_of_outcomes_is_compared_scene_by_scene(tmp_path: Path) -> None:
    """Catches a comparison with other scenes, or one that plays before it finds that the file is none."""
    untrained(tmp_path, "push", 0)
    options = {"methods": ("push",), "episodes": 3}
    table(tiny(tmp_path, "first", **options))
    other = tmp_path / "first" / STORE_NAME
    page = table(tiny(tmp_path, "second", compare_with=other, **options))
    assert f"## Agreement with {other.as_posix()}" in page
    assert "| all | planar | 3 | 100.0 % |" in page
    assert "No scene is in both" in table(tiny(tmp_path, "third", compare_with=other, seed=1, **options))
    (tmp_path / "text").write_text("no database " * 400)
    with pytest.raises(RunError, match="text is damaged"):
        table(tiny(tmp_path, "fourth", compare_with=tmp_path / "text", **options))
    assert not (tmp_path / "fourth").exists()


def test_a_part_that_was_played_for_fewer_scenes_is_completed(tmp_path: Path) -> None:
    """Catches scenes that stay unplayed because others of their part are there, and a table of all that is found."""
    untrained(tmp_path, "push", 0)
    few = table(tiny(tmp_path, "grown", methods=("push",), episodes=2))
    more = table(tiny(tmp_path, "grown", methods=("push",), episodes=4))
    assert more == table(tiny(tmp_path, "whole", methods=("push",), episodes=4))
    assert rows_of(tmp_path / "grown" / STORE_NAME) == rows_of(tmp_path / "whole" / STORE_NAME)
    assert table(tiny(tmp_path, "grown", methods=("push",), episodes=2)) == few


def test_weights_that_changed_and_runs_of_another_method_are_refused(tmp_path: Path) -> None:
    """Catches a table of outcomes that the weights beside it never had."""
    untrained(tmp_path, "push", 0)
    options = {"methods": ("push",), "episodes": 1}
    table(tiny(tmp_path, "out", **options))
    (tmp_path / "push-0").rename(tmp_path / "cura-ppo-0")
    with pytest.raises(CheckpointError, match="is of method push; accepted: a run of cura-ppo"):
        table(tiny(tmp_path, "out", methods=("cura-ppo",)))
    (tmp_path / "cura-ppo-0").rename(tmp_path / "push-0")
    table(tiny(tmp_path, "out", **options))
    untrained(tmp_path, "push", 0, frames=16)
    with pytest.raises(RunError, match="holds outcomes of push of seed 0 with weights"):
        table(tiny(tmp_path, "out", **options))


def test_pairs_and_share_are_those_worked_out_by_hand() -> None:
    """Catches pairs that are counted the wrong way round, and a share of something else.

    push succeeds in 4 of 20, without occlusion 16 do; cura-ppo wins 8 of what push lost and loses 2 of what it won:
    10 of 20. Share: (10 - 4) / (16 - 4) = 0.5; p of 8 against 2: 2 (1 + 10 + 45) / 1024 = 0.109375.
    """
    results = compare(played(free="s" * 16 + "t" * 4, push="ssss" + "c" * 16, cura="sstt" + "s" * 8 + "c" * 5 + "ttt"))
    cura = results[-1]
    assert (cura.success, cura.collisions, cura.hit_arm, cura.hit_base, cura.timeouts) == (0.5, 0.25, 0.25, 0.0, 0.25)
    assert (cura.difference, cura.mcnemar_p) == pytest.approx((0.3, 0.109375))
    assert cura.share == pytest.approx(0.5)
    # Without occlusion there is no collision, with it there are 16, and cura-ppo has 5: 11 of 16 are avoided.
    assert cura.collision_share == pytest.approx(11 / 16)
    assert cura.share_low < 0.5 < cura.share_high
    # Wilson for 10 of 20, z^2 = 3.841459: half width 1.959964 sqrt(0.0125 + 0.0024009) / 1.192073 = 0.200703
    assert (cura.low, cura.high) == pytest.approx((0.299298, 0.700702), abs=1e-5)
    assert cura.paper == pytest.approx(0.8873)
    assert math.isnan(cura.iqm)
    assert math.isnan(results[1].difference)  # nobody is compared with himself


def test_without_the_baseline_the_first_method_is_compared_with() -> None:
    """Catches a table of variants of a method that does not tell how they differ."""
    results = compare(played(cura="sssssscccc", free="sssssssssc"))
    assert [result.difference for result in results] == [pytest.approx(math.nan, nan_ok=True), pytest.approx(0.3)]
    page = as_markdown(results, [], "", [])
    assert "## Against CURA-PPO" in page
    assert "Share" not in page


def test_where_nothing_is_lost_there_is_no_share() -> None:
    """Catches a division by zero, and an interval whose end is at infinity."""
    result = compare(played(free="ssst", push="ssst", cura="ssss"))[-1]
    assert math.isnan(result.share)
    result = compare(played(free="ssst", push="sstt", cura="ssst"))[-1]
    assert result.share == 1.0
    assert math.isnan(result.share_low)


def test_several_seeds_are_summed_up_by_mean_and_interquartile_mean() -> None:
    """Catches an interval that takes the scenes of all seeds for independent.

    Of 20 scenes the seeds solve 0, 10, 12 and 20: mean 42 / 80, middle half (10 + 12) / 40.
    """
    runs = [run_of("s" * count + "t" * (20 - count)) for count in (0, 10, 12, 20)]
    result = compare({"push": {"uniform-0.5": runs}, "cura-ppo": {"uniform-0.5": runs}})[-1]
    assert (result.seeds, result.scenes, result.success, result.iqm) == pytest.approx((4, 20, 0.525, 0.55))
    assert result.high - result.low > 0.6  # Wilson's interval of 42 in 80 is 0.21 wide
    assert math.isnan(result.mcnemar_p)
    assert result.difference == 0.0
    assert result.difference_low < -0.4 < 0.4 < result.difference_high  # seeds of two methods are no pairs


def test_all_forms_show_the_same_numbers_and_say_what_the_interval_is() -> None:
    """Catches a form that is forgotten, and an interval that passes for one over training seeds."""
    results = compare({method: {cell: [run_of("sssc")] for cell in CELLS} for method in METHODS})
    policy = PolicyRecord(method="push", training_seed=3, weights_sha256="ab" * 32, frames=1000, commit="c0ffee")
    page = as_markdown(results, [policy], "4 scenes a cell")
    # Of 4 scenes drawn from 4, 3 of which succeed, 1 or fewer do in 5.1 %, and all 4 in 31.6 % of the draws.
    assert (
        "| CURA-PPO | 75.0 (30.1 to 95.4); paper 88.7 | 75.0 (30.1 to 95.4); paper 72.4 | 75.0 (25.0 to 100.0) |"
        in page
    )
    assert "The interval is over scenes only" in page
    assert "| push | 3 | 1,000 | c0ffee | abababababab |" in page
    lines = list(csv.DictReader(io.StringIO(as_csv(results))))
    assert [(line["method"], line["cell"]) for line in lines] == [(m, c) for m in METHODS for c in (*CELLS, "all")]
    assert (lines[0]["success"], lines[0]["paper"], lines[2]["paper"], lines[0]["share"]) == ("0.75", "0.9204", "", "")
    assert r"CURA-PPO & 75.0 (30.1--95.4), paper 88.7 &" in as_latex(results)
    assert as_latex(results).count(r"\\") == 1 + len(METHODS)


def test_measures_are_means_and_medians_over_what_there_was() -> None:
    """Catches means over episodes without an obstacle, and delays that are not weighed by how many were seen.

    Seen are 2 obstacles after 1.0 s on average and 1 after 4.0 s: 2.0 s; 2 of 5 are never seen.
    """
    values = {"goal_distance": 0.5, "yaw_error": 0.1, "object_path": 12.0, "first_sighting": 3.0, "longest_delay": 4.0}
    measured = [
        Measures(min_clearance=0.2, base_path=10.0, obstacles=2, obstacles_unseen=0, mean_delay=1.0, **values),
        Measures(min_clearance=0.6, base_path=14.0, obstacles=3, obstacles_unseen=2, mean_delay=4.0, **values),
        Measures(min_clearance=None, base_path=15.0, obstacles=0, obstacles_unseen=0, mean_delay=None, **values),
    ]
    run = [dataclasses.replace(one, measures=own) for one, own in zip(run_of("sss"), measured, strict=True)]
    (result,) = compare({"push": {"uniform-0.5": [run]}})
    assert (result.clearance, result.base_path, result.unseen, result.delay) == pytest.approx((0.4, 13.0, 0.4, 2.0))
    assert "| Push w/ Occlusion | uniform 0.5 m | 9 | 0.40 | 0.50 | 5.7 | 13.0 | 12.0 | 40.0 | 2.00 |" in as_markdown(
        [result], [], "3 scenes"
    )


@pytest.mark.parametrize("count", [1, 5])
def test_the_picture_names_all_methods_and_cells_and_is_the_same_each_time(count: int) -> None:
    """Catches a method that is left out of the legend, and a date or a random name in the file."""
    results = compare({method: {cell: [run_of("sssc")] for cell in CELLS} for method in [*METHODS, *METHODS_2][:count]})
    text = table_figure(results, "4 scenes a cell", "svg").decode()
    for label in {METHOD_LABELS[result.method].label for result in results} | {"the paper"}:
        assert f"<!-- {label} -->" in text
    assert text.count("<!-- adversarial 1.0 m -->") == 1
    assert table_figure(results, "4 scenes a cell", "svg").decode() == text
    assert table_figure(results, "4 scenes a cell", "png").startswith(b"\x89PNG")


def test_parquet_holds_numbers_and_nulls(tmp_path: Path) -> None:
    """Catches a NaN or a text in place of a missing number, and a column that is lost."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is optional")
    write_parquet({"method": ["push", "push"], "share": [math.nan, 0.5], "scenes": [4, 8]}, tmp_path / "table.parquet")
    read = parquet.read_table(tmp_path / "table.parquet").to_pydict()
    assert read == {"method": ["push", "push"], "share": [None, 0.5], "scenes": [4, 8]}


def test_without_pyarrow_a_line_tells_where_it_comes_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback after hours of playing."""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UnavailableError, match=r"table.parquet is not written, .* pip install cura-torchrl\[table\]"):
        write_parquet({}, tmp_path / "table.parquet")


def test_latex_takes_no_name_for_a_command() -> None:
    """Catches a name that breaks the typesetting, or whose backslash is escaped twice."""
    assert latex("a_b & 5 % #1 ${x}") == r"a\_b \& 5 \% \#1 \$\{x\}"
    assert latex("\\^~") == r"\textbackslash{}\textasciicircum{}\textasciitilde{}"


def test_the_papers_numbers_are_in_the_order_of_its_cells() -> None:
    """Catches a row with a number too few, and sizes that are swapped."""
    assert {len(rates) for rates in PAPER_SUCCESS.values()} == {len(PAPER_CELLS)}
    assert paper_success("cura-ppo", "adversarial-0.75") == 0.7459
    # (74.20 + 66.39 + 42.34 + 65.25 + 48.86 + 22.90) / 6
    assert paper_success("push", "all") == pytest.approx(0.533233, abs=1e-6)
    assert paper_success("push", "mixed-0.5") is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"cells": ("uniform-2.0",)},
            "cell is 'uniform-2.0'; accepted: all, or SCENARIO-SIZE with uniform, adversarial",
        ),
        ({"cells": ("uniform",)}, "cell is 'uniform'"),
        ({"cells": ("everywhere-0.5",)}, "cell is 'everywhere-0.5'"),
        ({"cells": ("uniform-nan",)}, "cell is 'uniform-nan'"),
        ({"methods": ("push", "cura")}, r"method is 'cura' \(did you mean cura-ppo\?\); accepted: "),
        ({"methods": ("cura-cvar",)}, "method is 'cura-cvar'; accepted: cura-no-risk, "),
        ({"methods": (",",)}, "methods is "),
        ({"chunk": 0}, "chunk is 0; accepted: 1 or more"),
        ({"compare_with": Path("nowhere.sqlite")}, "compare_with is 'nowhere.sqlite'; accepted: a file of outcomes"),
        ({"episodes": 0}, "episodes is 0; accepted: 1 or more"),
        ({"seeds": (1, 1)}, "seeds is "),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused_in_one_line(changes: dict[str, object], message: str) -> None:
    """Catches an hour of playing that ends in an error, or in a table of the wrong cells."""
    with pytest.raises(ValueError, match=message) as told:
        TableConfig(**changes)
    assert "\n" not in str(told.value)


def test_names_may_be_joined_by_commas() -> None:
    """Catches a list that is read as one name, and a cell that is spelt in two ways and played twice."""
    assert TableConfig(methods=("cura-cvar,cura-perceptual",), seeds=(0,)).methods == ("cura-cvar", "cura-perceptual")
    config = TableConfig(methods=("push,cura-ppo",), cells=("all", "uniform-1,uniform-1.0"))
    assert (config.methods, config.cells) == (("push", "cura-ppo"), PAPER_CELLS)
