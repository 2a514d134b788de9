"""Write a run's networks as weights are shipped."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from cura_torchrl.trainers.build import SHIPPED_ENCODER
from cura_torchrl.trainers.checkpoint import (
    file_sha256,
    find_checkpoint,
    progress_path,
    read_config,
    verify,
    write_checkpoint,
)
from cura_torchrl.trainers.errors import CheckpointError, UnavailableError
from cura_torchrl.trainers.folders import make_folder
from cura_torchrl.trainers.loaded_policy import SHIPPED_FOLDER, read_networks
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER

if TYPE_CHECKING:
    from cura_torchrl.trainers.config import TrainConfig


def release(source: Path, destination: Path | None = None) -> Path:
    """Write a run's newest networks, without optimisers, as weights are shipped, and its curve beside them.

    Args:
        source: A run or a checkpoint.
        destination: Folder to write; None is the package's own folder for the method.

    Returns:
        The folder that was written.

    Raises:
        CheckpointError: If there is no checkpoint or it is damaged, or ``destination`` holds anything but weights.
        RunError: If the folder of ``destination`` cannot be made.
        UnavailableError: If its encoder is not the one that is shipped: whoever loads it would play with another.
    """  # noqa: DOC502 - raised by what this calls
    path = find_checkpoint(source)
    config, record = read_config(path)
    folder = SHIPPED_FOLDER / config.method if destination is None else destination
    _require_replaceable(folder)
    _require_shipped_encoder(config)
    networks = read_networks(path, config)
    # Paths of the machine that trained say nothing elsewhere.
    released = config.replace(run_dir=Path("runs") / config.method, encoder=None)
    make_folder(folder.parent, "folder of destination")
    curve = progress_path(path)
    if curve.exists():
        shutil.copyfile(curve, progress_path(folder))
    else:
        progress_path(folder).unlink(missing_ok=True)  # that of weights that were there before
    origin = {name: record[name] for name in ("versions", "commit")}
    return write_checkpoint({"networks": networks}, released, folder, frames=record["frames"], origin=origin)


def _require_replaceable(folder: Path) -> None:
    """Raise unless nothing but weights is lost when a folder is replaced.

    Raises:
        CheckpointError: If it is not new, empty, or weights as they were written.
    """
    is_named = folder.name not in {"", ".."}  # the curve's name is made of it
    is_run = folder.parent.name == CHECKPOINT_FOLDER
    if is_named and not is_run:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        with contextlib.suppress(CheckpointError):
            verify(folder)
            # A run's own checkpoints hold optimisers and counters too.
            if [entry.name.split("-", 1)[-1] for entry in (folder / "components").glob("*")] == ["networks"]:
                return
    msg = f"destination is {folder}; accepted: a folder that is new, empty, or holds released weights and nothing else"
    raise CheckpointError(msg)


def _require_shipped_encoder(config: TrainConfig) -> None:
    """Raise unless a policy's encoder is the one that comes with the package, at this path or another.

    Raises:
        UnavailableError: If it is another or not there.
    """
    path = config.encoder
    if path is None or config.perception != "map":
        return
    accepted = f"accepted: what the package ships ({SHIPPED_ENCODER.name}), which released weights are loaded with"
    if not path.is_file():
        msg = f"encoder is {path}, which is not there to compare; {accepted}"
        raise UnavailableError(msg)
    ours, theirs = file_sha256(path), file_sha256(SHIPPED_ENCODER)
    if ours != theirs:
        msg = f"encoder is {path}, SHA-256 {ours[:12]}; {accepted}, SHA-256 {theirs[:12]}"
        raise UnavailableError(msg)
