"""Outcomes are kept whole, and only beside those they can be compared with."""

from __future__ import annotations

import dataclasses
import sqlite3
from contextlib import closing
from typing import TYPE_CHECKING

import pytest

from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.evaluate import Episode
from cura_torchrl.trainers.outcomes import SHIPPED, OutcomeStore, PolicyRecord, Scenes

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


def episode(index: int, *, success: bool = False, collision: bool = False) -> Episode:
    """An episode whose fields all differ."""
    return Episode(
        index=index,
        success=(success, success, False),
        collision=collision,
        contact=(False, collision, True),
        tipped=True,
        steps=17 + index,
    )


def test_what_is_read_is_what_was_written(tmp_path: Path) -> None:
    """Catches columns that are read in another order than written, and a cell that answers for another."""
    played = [episode(2, collision=True), episode(0, success=True), episode(1)]
    with closing(OutcomeStore(tmp_path / "new" / "outcomes.sqlite", chunk=20)) as store:
        store.register(POLICY)
        store.add(SCENES, played)
        for field, other in (
            ("scenario", "adversarial"),
            ("training_seed", 3),
            ("object_size", 1.0),
            ("scene_seed", 1),
        ):
            assert store.read(dataclasses.replace(SCENES, **{field: other}), 9) == []
    with closing(OutcomeStore(tmp_path / "new" / "outcomes.sqlite", chunk=20)) as store:
        assert store.read(SCENES, 9) == sorted(played, key=lambda entry: entry.index)
        assert [entry.index for entry in store.read(SCENES, 2)] == [0, 1]
        assert store.policies() == [POLICY]


def test_a_part_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    """Catches episodes of a part that was broken off: they would hide that the others are missing."""

    def broken_off() -> Iterator[Episode]:
        yield episode(0)
        yield episode(1)
        raise KeyboardInterrupt

    with closing(OutcomeStore(tmp_path / "outcomes.sqlite", chunk=20)) as store:
        with pytest.raises(KeyboardInterrupt):
            store.add(SCENES, broken_off())
        assert store.read(SCENES, 9) == []


def test_other_weights_are_refused(tmp_path: Path) -> None:
    """Catches a table whose rows mix two policies."""
    with closing(OutcomeStore(tmp_path / "outcomes.sqlite", chunk=20)) as store:
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
    with closing(OutcomeStore(path, chunk=20)) as store:
        store.add(SCENES, [episode(index) for index in range(500)])
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RunError, match=message) as told:
        OutcomeStore(path, chunk=20)
    assert "\n" not in str(told.value)


def test_a_file_of_another_version_chunk_or_program_is_refused(tmp_path: Path) -> None:
    """Catches outcomes that are read with the wrong meaning, or that were played in batches of another size."""
    path, foreign = tmp_path / "outcomes.sqlite", tmp_path / "foreign.sqlite"
    OutcomeStore(path, chunk=20).close()
    with pytest.raises(RunError, match="chunk is 5; accepted: 20"):
        OutcomeStore(path, chunk=5)
    with closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA user_version = 99")
    with pytest.raises(RunError, match="is of version 99; accepted: version 1"):
        OutcomeStore(path, chunk=20)
    with closing(sqlite3.connect(foreign)) as database:
        database.execute("CREATE TABLE mail (sender TEXT)")
    with pytest.raises(RunError, match="is no file of outcomes"):
        OutcomeStore(foreign, chunk=20)
