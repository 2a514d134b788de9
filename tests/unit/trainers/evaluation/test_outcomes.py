"""Outcomes are kept whole, and only beside those they can be compared with."""

from __future__ import annotations

import dataclasses
import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.evaluation.episodes import Episode
from cura_torchrl.trainers.evaluation.measures import Measures
from cura_torchrl.trainers.evaluation.outcomes import SHIPPED, CodeRecord, OutcomeStore, PolicyRecord, Scenes

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

SCENES = Scenes(
    method="push",
    training_seed=SHIPPED,
    simulator="planar",
    scenario="uniform",
    object_size=0.75,
    max_obstacles=6,
    scene_seed=0,
)
POLICY = PolicyRecord(method="push", training_seed=SHIPPED, weights_sha256="a" * 64, frames=8, commit="c0ffee")
CODE = CodeRecord(commit="beef", versions={"torch": "2.13.0"})


def episode(index: int, *, success: bool = False, collision: bool = False) -> Episode:
    """An episode whose fields all differ."""
    return Episode(
        index=index,
        success=(success, success, False),
        collision=collision,
        contact=(False, collision, True),
        tipped=True,
        steps=17 + index,
        measures=Measures(
            min_clearance=None if success else 0.5,
            goal_distance=0.25 + index,
            yaw_error=0.1,
            base_path=13.5,
            object_path=12.5,
            obstacles=4,
            obstacles_unseen=1,
            first_sighting=None if collision else 3.4,
            mean_delay=0.7,
            longest_delay=2.2,
        ),
    )


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    """Catches columns that are read in another order than written, and a cell that answers for another."""
    played = [episode(2, collision=True), episode(0, success=True), episode(1)]
    with closing(OutcomeStore(tmp_path / "new" / "outcomes.sqlite")) as store:
        store.register(POLICY)
        store.add(SCENES, played, CODE)
        for field, other in (
            ("scenario", "adversarial"),
            ("training_seed", 3),
            ("object_size", 1.0),
            ("scene_seed", 1),
        ):
            assert store.read(dataclasses.replace(SCENES, **{field: other}), 9) == []
    with closing(OutcomeStore(tmp_path / "new" / "outcomes.sqlite")) as store:
        assert store.read(SCENES, 9) == sorted(played, key=lambda entry: entry.index)
        assert [entry.index for entry in store.read(SCENES, 2)] == [0, 1]
        assert store.policies() == [POLICY]
        assert store.code() == [CODE]
        columns = store.columns()
        assert columns["commit"] == ["beef"] * 3
        assert columns["goal_distance"] == [0.25, 1.25, 2.25]
        assert columns["min_clearance"] == [None, 0.5, 0.5]


def test_a_part_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    """Catches episodes of a part that was broken off: they would hide that the others are missing."""

    def broken_off() -> Iterator[Episode]:
        yield episode(0)
        yield episode(1)
        raise KeyboardInterrupt

    with closing(OutcomeStore(tmp_path / "outcomes.sqlite")) as store:
        with pytest.raises(KeyboardInterrupt):
            store.add(SCENES, broken_off(), CODE)
        assert store.read(SCENES, 9) == []


def test_other_weights_are_refused(tmp_path: Path) -> None:
    """Catches a table whose rows mix two policies."""
    with closing(OutcomeStore(tmp_path / "outcomes.sqlite")) as store:
        store.register(POLICY)
        store.register(POLICY)
        store.register(dataclasses.replace(POLICY, training_seed=1, weights_sha256="b" * 64))
        with pytest.raises(RunError, match=r"holds outcomes of push with weights aaaaaaaaaaaa, now they are b") as told:
            store.register(dataclasses.replace(POLICY, weights_sha256="b" * 64))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda data: b"no database" * 400, "is damaged: file is not a database"),
        (lambda data: data[:4096] + bytes(len(data) - 4096), "is damaged: "),
        (lambda data: data[: len(data) // 2], "is damaged: "),
        (lambda data: data[:-4096] + bytes(4096), "is damaged: "),
        (lambda data: data.replace(b"planaruniform", b"zlanaruniform", 1), "is damaged: "),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(damage: object, message: str, tmp_path: Path) -> None:
    """Catches a traceback, and a table that is made from what is left of the outcomes."""
    path = tmp_path / "outcomes.sqlite"
    with closing(OutcomeStore(path)) as store:
        store.add(SCENES, [episode(index) for index in range(500)], CODE)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RunError, match=message) as told:
        OutcomeStore(path)
    assert "\n" not in str(told.value)


def test_a_file_of_another_version_or_program_is_refused(tmp_path: Path) -> None:
    """Catches outcomes that are read with the wrong meaning, and advice about a folder for a file that is only read."""
    path, foreign = tmp_path / "outcomes.sqlite", tmp_path / "foreign.sqlite"
    OutcomeStore(path).close()
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA user_version = 99")
    with pytest.raises(RunError, match=r"is of version 99; accepted: a file .* 2, or another folder"):
        OutcomeStore(path)
    with closing(sqlite3.connect(foreign)) as database:
        database.execute("CREATE TABLE mail (sender TEXT)")
    with pytest.raises(RunError, match="is no file of outcomes"):
        OutcomeStore(foreign)
    with pytest.raises(RunError, match=r"is no file of outcomes; accepted: a file of outcomes of version 2$"):
        OutcomeStore(foreign, read_only=True)


def test_rows_tell_by_which_code_they_were_played(tmp_path: Path) -> None:
    """Catches rows that pass for those of the last commit, and code that is listed though none of its rows is left."""
    later = CodeRecord(commit="cafe", versions={"torch": "2.14.0"})
    with closing(OutcomeStore(tmp_path / "outcomes.sqlite")) as store:
        store.add(SCENES, [episode(0), episode(1)], CODE)
        store.add(SCENES, [episode(1), episode(2)], later)
        assert store.code() == [CODE, later]
        assert store.columns()["commit"] == ["beef", "cafe", "cafe"]
        store.add(SCENES, [episode(0)], later)
        assert store.code() == [later]


def test_a_file_can_be_read_but_is_not_made(tmp_path: Path) -> None:
    """Catches a comparison that changes the other file, or that makes an empty one where a name is misspelt."""
    path = tmp_path / "outcomes.sqlite"
    with closing(OutcomeStore(path)) as store:
        store.add(SCENES, [episode(0)], CODE)
    with closing(OutcomeStore(path, read_only=True)) as store:
        assert store.read(SCENES, 9) == [episode(0)]
        with pytest.raises(RunError, match="cannot be used: attempt to write a readonly database"):
            store.add(SCENES, [episode(1)], CODE)
    with pytest.raises(RunError, match=r"unable to open .*; accepted: .* that this user can read"):
        OutcomeStore(tmp_path / "other.sqlite", read_only=True)
    assert not (tmp_path / "other.sqlite").exists()


def test_two_can_make_the_same_file(tmp_path: Path) -> None:
    """Catches the second of two processes that begin at once, which finds the tables made meanwhile."""
    with ThreadPoolExecutor(8) as pool:
        for store in pool.map(lambda _: OutcomeStore(tmp_path / "new" / "outcomes.sqlite").close(), range(16)):
            assert store is None


def test_a_folder_that_cannot_be_made_is_told_in_one_line(tmp_path: Path) -> None:
    """Catches an error number in place of what is accepted."""
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match=r"folder of the outcomes is '.*file' \(File exists\); accepted: a folder"):
        OutcomeStore(tmp_path / "file" / "outcomes.sqlite")
