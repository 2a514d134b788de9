"""Print how the success rates of the same policies on the same scenes differ between the two simulators, as Markdown.

Reads two files of outcomes that ``cura-torchrl table`` wrote, or two folders of what ``evaluate --json`` printed:
python benchmarks/compare_simulators.py benchmarks/results/bullet benchmarks/results/planar
"""

from __future__ import annotations

import argparse
import json
import sqlite3
from collections import defaultdict
from contextlib import closing
from pathlib import Path

import numpy as np

from cura_torchrl.trainers.statistics import paired_difference

Scene = tuple[str, str, int, float, int, int]
"""Method, scenario, K, size [m], seed of the scenes and index."""


def read(path: Path) -> dict[Scene, bool]:
    """Return whether each scene was solved, from a file of outcomes or a folder of JSON files."""
    return read_folder(path) if path.is_dir() else read_store(path)


def read_folder(folder: Path) -> dict[Scene, bool]:
    """Return whether each scene was solved, from the results that say how each one ended."""
    results = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(folder.glob("*.json"))]
    return {
        (r["method"], r["scenario"], r["max_obstacles"], r["object_size"], r["seed"], index): letter == "s"
        for r in results
        for index, letter in enumerate(r.get("outcomes", ""))
    }


def read_store(path: Path) -> dict[Scene, bool]:
    """Return whether each scene was solved by a policy that is shipped."""
    # Training seed -1 stands for shipped weights.
    query = (
        "SELECT method, scenario, max_obstacles, object_size, scene_seed, scene_index, outcome FROM outcomes"
        " WHERE training_seed = -1"
    )
    with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
        return {tuple(scene): outcome == "s" for *scene, outcome in database.execute(query)}


def row(name: str, pairs: list[tuple[bool, bool]]) -> str:
    """Return a row of the table: rates of both simulators, scene by scene, and their difference in points."""
    one, other = np.array(pairs).T
    middle, low, high = (100 * value for value in paired_difference(one, other))
    rates = " | ".join(f"{100 * own.mean():.1f} ({len(own)})" for own in (one, other))
    return f"| {name} | {rates} | {middle:+.1f} ({low:+.1f} to {high:+.1f}) |"


def main() -> None:
    """Parse the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, nargs=2, help="those on PyBullet, those on the planar simulator")
    bullet, planar = (read(path) for path in parser.parse_args().results)
    print("| Policy, size | PyBullet [%] (episodes) | planar [%] (episodes) | difference [points] (95 % interval) |")
    print("|---|---|---|---|")
    groups: dict[tuple[str, float], list[Scene]] = defaultdict(list)
    for scene in bullet.keys() & planar.keys():
        groups[scene[0], scene[3]].append(scene)
    for (method, size), scenes in sorted(groups.items()):
        cells = len({scene[1:3] for scene in scenes})
        print(row(f"{method}, {size} m, {cells} cells", [(bullet[scene], planar[scene]) for scene in scenes]))


if __name__ == "__main__":
    main()
