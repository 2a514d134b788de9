"""The benchmarks: what is measured in turn in one run, as ratios with their spread, and the file that records them."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from cura_torchrl.trainers.benches import env, ik, learner, lidar, peers
from cura_torchrl.trainers.folders import make_place
from cura_torchrl.trainers.info import provenance
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from collections.abc import Callable

    from cura_torchrl.trainers.benches.config import BenchConfig
    from cura_torchrl.trainers.benches.report import Report

OUTPUT_FOLDER = Path("runs/bench")
"""Where results go unless a file is named."""

BUSY_SHARE = 0.5
"""Load average per core above which a result notes that the machine was busy [1]."""

TARGETS: dict[str, Callable[[BenchConfig], Report]] = {
    "env": env.run,
    "learner": learner.run,
    "lidar": lidar.run,
    "ik": ik.run,
    "peers": peers.run,
}
"""What measures each target."""


def bench(config: BenchConfig) -> dict[str, Any]:
    """Measure, and write the results file.

    Args:
        config: What to measure, and how.

    Returns:
        What the file holds, JSON-compatible.

    Raises:
        RunError: If the file cannot be written where it is to be; nothing is measured then.
    """  # noqa: DOC502 - raised by what this calls
    path = config.output or OUTPUT_FOLDER / f"{config.target}.json"
    make_place(path, "output")  # before minutes of measuring
    load = os.getloadavg()[0]
    with one_thread():
        torch.manual_seed(config.seed)
        report = TARGETS[config.target](config)
    cores = len(os.sched_getaffinity(0))
    if load > BUSY_SHARE * cores:
        report.notes.append(
            f"the machine was busy (load average {load:.1f} on {cores} cores): figures by the clock on the wall, which "
            "are those of several processes or threads, say nothing about an idle one"
        )
    settings = {name: _plain(value) for name, value in dataclasses.asdict(config).items()}
    result = {**provenance(), "load_average": round(load, 2), "settings": settings, **dataclasses.asdict(report)}
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
    return result


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(value)
    return str(value) if isinstance(value, Path) else value


def as_table(result: dict[str, Any]) -> str:
    """Return a result as text.

    Args:
        result: What :func:`bench` returned.

    Returns:
        Ratios, figures, checks and notes.
    """
    lines = [_row("ratio", "median", "least", "most", "aim")]
    lines += [_row(name, *_numbers(entry), entry["aim"] or "") for name, entry in result["ratios"].items()]
    lines += ["", _row("figure", "median", "least", "most", "unit")]
    lines += [_row(name, *_numbers(entry), entry["unit"]) for name, entry in result["figures"].items()]
    for name, entry in result["checks"].items():
        verdict = "holds" if entry["holds"] else "DOES NOT HOLD"
        lines.append(f"check: {name}: {entry['value']:.3g}, at most {entry['most']:.3g}: {verdict}")
    return "\n".join([*lines, *(f"note: {note}" for note in result["notes"]), ""])


def _row(name: str, median: str, least: str, most: str, last: str) -> str:
    return f"{name:<60}{median:>11}{least:>11}{most:>11}  {last}".rstrip()


def _numbers(entry: dict[str, Any]) -> tuple[str, str, str]:
    median, least, most = (f"{entry[name]:,.4g}" for name in ("median", "min", "max"))
    return median, least, most
