"""What a result was made with: versions, commit, hardware; and what works on this machine."""

from __future__ import annotations

import functools
import importlib.util
import os
import platform
import shlex
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = (
    "cura-torchrl",
    "torch",
    "torchrl",
    "tensordict",
    "pybullet",
    "pytorch-kinematics",
    "numpy",
    "scipy",
    "tyro",
)
"""Distributions whose versions are recorded beside every checkpoint and result."""


def versions() -> dict[str, str]:
    """Return the versions that a result depends on.

    Returns:
        Version by distribution, with Python's own; "not installed" where there is none.

    Examples:
        >>> versions()["python"] == platform.python_version()
        True
    """
    return {"python": platform.python_version(), **{package: _version(package) for package in PACKAGES}}


@functools.cache
def git_commit() -> str:
    """Return the commit of the checkout that this package is run from, as it was when it was asked first.

    What runs stays in memory, whatever is checked out meanwhile; commands ask before they begin.

    Returns:
        The commit's hash, followed by ``-dirty`` where files were changed; "unknown" outside a checkout.

    Examples:
        >>> bool(git_commit())
        True
    """
    here = Path(__file__).resolve()
    git = shutil.which("git")
    # An installed copy may lie inside someone else's checkout: only a file that git tracks tells the commit.
    if git is None or _git(git, here.parent, "ls-files", "--error-unmatch", here.name) is None:
        return "unknown"
    return _git(git, here.parent, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*") or "unknown"


def _git(git: str, folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            [git, "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def hardware() -> dict[str, Any]:
    """Return what the machine has.

    Returns:
        Platform, the processor's name, number of cores that this process may use, memory [GiB].

    Examples:
        >>> hardware()["cores"] >= 1
        True
    """
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "platform": platform.platform(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(memory, 1),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def provenance() -> dict[str, Any]:
    """Return what a results file records: the command as it was typed, commit, hardware and versions.

    Returns:
        JSON-compatible, by those names.

    Examples:
        >>> sorted(provenance())
        ['command', 'commit', 'hardware', 'versions']
    """
    program, *arguments = sys.argv
    # As it can be typed anywhere: the command line's own file lies somewhere else on each machine.
    typed = ["cura-torchrl"] if Path(program).name in {"cura-torchrl", "cli.py"} else ["python", program]
    return {
        "command": shlex.join([*typed, *arguments]),
        "commit": git_commit(),
        "hardware": hardware(),
        "versions": versions(),
    }


def capabilities() -> dict[str, bool]:
    """Return which optional parts work here, without importing them.

    Returns:
        Whether a part works, by name.

    Examples:
        >>> set(capabilities()) == {"bullet", "tensorboard", "wandb", "ray", "encoder weights"}
        True
    """
    return {
        "bullet": _is_installed("pybullet"),
        "tensorboard": _is_installed("tensorboard"),
        "wandb": _is_installed("wandb"),
        "ray": _is_installed("ray"),
        "encoder weights": (Path(__file__).parents[1] / "modules" / "weights" / "map_vae.pt").exists(),
    }


def shipped_methods() -> list[str]:
    """Return the methods whose trained weights are installed.

    Returns:
        Names, sorted.

    Examples:
        >>> isinstance(shipped_methods(), list)
        True
    """
    return sorted(entry.parent.name for entry in (Path(__file__).parent / "weights").glob("*/config.json"))


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _is_installed(package: str) -> bool:
    return importlib.util.find_spec(package) is not None
