"""How episodes ended, in an SQLite file that survives being killed at any moment."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from dataclasses import astuple, dataclass
from typing import TYPE_CHECKING, Any

from cura_torchrl.trainers.errors import RunError
from cura_torchrl.trainers.evaluation.episodes import Episode, outcome_letter
from cura_torchrl.trainers.evaluation.measures import Measures
from cura_torchrl.trainers.folders import make_folder

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

SCHEMA_VERSION = 2
"""Version of the tables, kept in the file."""
SHIPPED = -1
"""Training seed of the weights that are shipped."""

_APPLICATION = 0x43555241  # "CURA": tells our file from another program's
_SCHEMA = f"""
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS policies (
    method TEXT NOT NULL, training_seed INTEGER NOT NULL,
    weights_sha256 TEXT NOT NULL, frames INTEGER NOT NULL, "commit" TEXT NOT NULL,
    PRIMARY KEY (method, training_seed)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS code (
    id INTEGER PRIMARY KEY, "commit" TEXT NOT NULL, versions TEXT NOT NULL, UNIQUE ("commit", versions)
);
CREATE TABLE IF NOT EXISTS outcomes (
    method TEXT NOT NULL, training_seed INTEGER NOT NULL, simulator TEXT NOT NULL, scenario TEXT NOT NULL,
    object_size REAL NOT NULL, max_obstacles INTEGER NOT NULL, scene_seed INTEGER NOT NULL,
    scene_index INTEGER NOT NULL,
    outcome TEXT NOT NULL CHECK (outcome IN ('s', 'c', 't')),
    success_050 INTEGER NOT NULL, success_025 INTEGER NOT NULL, success_010_10deg INTEGER NOT NULL,
    steps INTEGER NOT NULL, hit_base INTEGER NOT NULL, hit_arm INTEGER NOT NULL, hit_object INTEGER NOT NULL,
    tipped INTEGER NOT NULL,
    min_clearance REAL,             -- [m]; all that follows is until the outcome unless said; NULL: none
    goal_distance REAL NOT NULL,    -- [m], object to goal, at the end of the episode
    yaw_error REAL NOT NULL,        -- [rad], modulo a quarter turn, at the end of the episode
    base_path REAL NOT NULL,        -- [m]
    object_path REAL NOT NULL,      -- [m]
    obstacles INTEGER NOT NULL,     -- that appeared
    obstacles_unseen INTEGER NOT NULL,
    first_sighting REAL,            -- [s] since the start; NULL: no obstacle was seen, as in the next two
    mean_delay REAL,                -- [s] from appearance to first sighting
    longest_delay REAL,             -- [s]
    code INTEGER NOT NULL REFERENCES code (id),
    PRIMARY KEY (method, training_seed, simulator, scenario, object_size, max_obstacles, scene_seed, scene_index)
) WITHOUT ROWID;
PRAGMA application_id = {_APPLICATION};
PRAGMA user_version = {SCHEMA_VERSION};
COMMIT;
"""
_SCENES = (
    "method = ? AND training_seed = ? AND simulator = ? AND scenario = ? AND object_size = ? AND max_obstacles = ?"
    " AND scene_seed = ?"
)
_EPISODE = (
    "scene_index", "outcome", "success_050", "success_025", "success_010_10deg", "steps", "hit_base", "hit_arm",
    "hit_object", "tipped", *Measures.__dataclass_fields__,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PolicyRecord:
    """Who played: what tells these weights from others."""

    method: str
    """Name of the method."""
    training_seed: int
    """Seed that it was trained with [1]; :data:`SHIPPED` for shipped weights."""
    weights_sha256: str
    """SHA-256 of the checkpoint's list of hashes."""
    frames: int
    """Environment steps that it was trained for [1]."""
    commit: str
    """Commit that it was trained at."""


@dataclass(frozen=True, kw_only=True)
class CodeRecord:
    """What episodes were played by."""

    commit: str
    """Commit of this package."""
    versions: dict[str, str]
    """Versions of what it depends on."""


@dataclass(frozen=True, kw_only=True)
class Scenes:
    """The scenes of one cell, and who plays them. The order of the fields is that of the file's key."""

    method: str
    """Name of the method."""
    training_seed: int
    """Seed that it was trained with [1]; :data:`SHIPPED` for shipped weights."""
    simulator: str
    """Which simulator runs the worlds."""
    scenario: str
    """Where obstacles appear."""
    object_size: float
    """Edge of the pushed cube [m]."""
    max_obstacles: int
    """Most obstacles K in an episode [1]."""
    scene_seed: int
    """Seed of the scenes [1]."""


class OutcomeStore:
    """The file of outcomes: a row for each episode and each policy.

    Args:
        path: The file; it is made, with its folder, where there is none.
        read_only: Whether it has to be there, and stays as it is.

    Raises:
        RunError: If the file is damaged, is no file of outcomes, is of another version.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     with contextlib.closing(OutcomeStore(Path(folder) / "outcomes.sqlite")) as store:
        ...         store.policies()
        []
    """

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        self._path, self._read_only = path, read_only
        if not read_only:
            make_folder(path.parent, "folder of the outcomes")
        with self._one_line_errors():
            # Else SQLite would make a file where there is none.
            where = f"{path.absolute().as_uri()}?mode=ro" if read_only else path
            self._database = sqlite3.connect(where, uri=read_only, timeout=60.0)
        try:
            with self._one_line_errors():
                self._check()
        except BaseException:
            self._database.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def register(self, policy: PolicyRecord) -> None:
        """Note who plays, or check that it is who played before.

        Args:
            policy: The policy.

        Raises:
            RunError: If the file holds outcomes of other weights.
        """
        with self._one_line_errors(), self._database:
            self._database.execute("INSERT OR IGNORE INTO policies VALUES (?, ?, ?, ?, ?)", astuple(policy))
        key = (policy.method, policy.training_seed)
        known = {(entry.method, entry.training_seed): entry for entry in self.policies()}[key]
        if known.weights_sha256 != policy.weights_sha256:
            seed = "" if policy.training_seed == SHIPPED else f" of seed {policy.training_seed}"
            msg = (
                f"{self._path} holds outcomes of {policy.method}{seed} with weights {known.weights_sha256[:12]}, now"
                f" they are {policy.weights_sha256[:12]}; accepted: the same weights, or another folder with --out"
            )
            raise RunError(msg)

    def policies(self) -> list[PolicyRecord]:
        """Return who played.

        Returns:
            The policies by method and training seed.
        """
        rows = self._rows("SELECT * FROM policies ORDER BY method, training_seed")
        return [
            PolicyRecord(method=method, training_seed=seed, weights_sha256=sha256, frames=frames, commit=commit)
            for method, seed, sha256, frames, commit in rows
        ]

    def code(self) -> list[CodeRecord]:
        """Return what the episodes were played by.

        Returns:
            Commits and versions, in the order in which they came.
        """
        rows = self._rows('SELECT "commit", versions FROM code WHERE id IN (SELECT code FROM outcomes) ORDER BY id')
        return [CodeRecord(commit=commit, versions=json.loads(versions)) for commit, versions in rows]

    def add(self, scenes: Scenes, episodes: Iterable[Episode], code: CodeRecord) -> None:
        """Write episodes, all of them or, where something goes wrong, none.

        Args:
            scenes: Who played which scenes.
            episodes: How they were played, with what was measured; those that are there already are replaced.
            code: What they were played by.
        """
        key, record = astuple(scenes), (code.commit, json.dumps(code.versions, sort_keys=True))
        command = f"INSERT OR REPLACE INTO outcomes VALUES ({', '.join('?' * (len(key) + len(_EPISODE) + 1))})"
        with self._one_line_errors(), self._database:
            self._database.execute('INSERT OR IGNORE INTO code ("commit", versions) VALUES (?, ?)', record)
            find = 'SELECT id FROM code WHERE "commit" = ? AND versions = ?'
            (number,) = self._database.execute(find, record).fetchone()
            self._database.executemany(command, ((*key, *_row(episode), number) for episode in episodes))

    def read(self, scenes: Scenes, count: int) -> list[Episode]:
        """Return how the first scenes were played.

        Args:
            scenes: Who played which scenes.
            count: Number of scenes [1].

        Returns:
            Those of them that were played, by index.
        """
        rows = self._rows(
            f"SELECT {', '.join(_EPISODE)} FROM outcomes WHERE {_SCENES} AND scene_index < ? ORDER BY scene_index",
            *astuple(scenes),
            count,
        )
        return [_episode(row) for row in rows]

    def columns(self) -> dict[str, list[Any]]:
        """Return all that the file holds, for other formats.

        Returns:
            Values by column: those of ``outcomes``, with the commit in place of its number.
        """
        names = [*Scenes.__dataclass_fields__, *_EPISODE, "commit"]
        chosen = ", ".join(f'"{name}"' for name in names)
        rows = self._rows(f"SELECT {chosen} FROM outcomes JOIN code ON code.id = outcomes.code")
        return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True)) if rows else {n: [] for n in names}

    def _rows(self, query: str, *values: object) -> list[tuple[Any, ...]]:
        with self._one_line_errors():
            return self._database.execute(query, values).fetchall()

    def _check(self) -> None:
        # Makes the tables in a new file, and refuses one that does not fit.
        (answer,) = self._database.execute("PRAGMA integrity_check").fetchone()
        if answer != "ok":
            raise sqlite3.DatabaseError(answer)
        (tables,) = self._database.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if tables == 0 and not self._read_only:
            self._database.executescript(_SCHEMA)
        found = tuple(
            self._database.execute(f"PRAGMA {name}").fetchone()[0] for name in ("application_id", "user_version")
        )
        if found != (_APPLICATION, SCHEMA_VERSION):
            kind = f"is of version {found[1]}" if found[0] == _APPLICATION else "is no file of outcomes"
            otherwise = "" if self._read_only else ", or another folder with --out"
            msg = f"{self._path} {kind}; accepted: a file of outcomes of version {SCHEMA_VERSION}{otherwise}"
            raise RunError(msg)

    @contextlib.contextmanager
    def _one_line_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            use = "read" if self._read_only else "write"
            msg = f"{self._path} cannot be used: {error}; accepted: a file of outcomes that this user can {use}"
            raise RunError(msg) from None
        except sqlite3.DatabaseError as error:
            msg = f"{self._path} is damaged: {' '.join(str(error).split())}; accepted: a file as it was written"
            raise RunError(msg) from None


def _row(episode: Episode) -> tuple[object, ...]:
    measures = (None,) * len(Measures.__dataclass_fields__) if episode.measures is None else astuple(episode.measures)
    return (
        episode.index,
        outcome_letter(episode),
        *episode.success,
        episode.steps,
        *episode.contact,
        episode.tipped,
        *measures,
    )


def _episode(row: tuple[Any, ...]) -> Episode:
    index, outcome, wide, middle, narrow, steps, base, arm, object_, tipped, *measures = row
    return Episode(
        index=index,
        success=(bool(wide), bool(middle), bool(narrow)),
        collision=outcome == "c",
        contact=(bool(base), bool(arm), bool(object_)),
        tipped=bool(tipped),
        steps=steps,
        measures=Measures(**dict(zip(Measures.__dataclass_fields__, measures, strict=True))),
    )
