"""Checkpoints that are whole or not there: staged, hashed, flushed to disk, and published by one rename.

A checkpoint is a folder: TorchRL's manifest and components (no pickle), ``config.json`` with the resolved
configuration, seed, versions and commit, and ``SHA256SUMS`` over all files. The weights that are shipped have the same
form without optimisers.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import uuid
from typing import TYPE_CHECKING, Any

from torchrl.checkpoint import Checkpoint, CheckpointRotation, StateDictCheckpointAdapter

from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.info import git_commit, versions
from cura_torchrl.trainers.training.progress import PROGRESS_NAME
from cura_torchrl.trainers.training.run_folder import CHECKPOINT_FOLDER

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

logger = logging.getLogger(__name__)

CONFIG_NAME = "config.json"
"""File of a checkpoint with the resolved configuration and where it came from."""
SUMS_NAME = "SHA256SUMS"
"""File of a checkpoint with the hash of every other file, in the format of ``sha256sum``."""
_PREFIX = "checkpoint"
_STAGE_PREFIX = ".stage-"


def save_checkpoint(
    components: Mapping[str, Any], config: TrainConfig, folder: Path, *, frames: int, keep_last: int | None = None
) -> Path:
    """Write a checkpoint that is either whole or not there.

    Args:
        components: Objects with ``state_dict`` and ``load_state_dict``, by name.
        config: Resolved configuration, written beside them.
        folder: Folder of the checkpoints; made if need be.
        frames: Environment steps so far [1]; part of the checkpoint's name.
        keep_last: Newest checkpoints to keep [1]; None keeps all.

    Returns:
        The checkpoint's folder.
    """
    destination = write_checkpoint(components, config, folder / f"{_PREFIX}-{frames:012d}", frames=frames)
    if keep_last is not None:
        CheckpointRotation(folder, keep_last=keep_last, prefix=_PREFIX).prune()
    return destination


def write_checkpoint(
    components: Mapping[str, Any],
    config: TrainConfig,
    destination: Path,
    *,
    frames: int,
    origin: Mapping[str, Any] | None = None,
) -> Path:
    """Write components, configuration and hashes to a folder, replacing what is there.

    Args:
        components: Objects with ``state_dict`` and ``load_state_dict``, by name.
        config: Resolved configuration.
        destination: Folder to write.
        frames: Environment steps so far [1].
        origin: Versions and commit that the components were made with; None is those of this process.

    Returns:
        ``destination``.
    """
    stage = destination.parent / f"{_STAGE_PREFIX}{uuid.uuid4().hex}"
    try:
        _fill(stage, components, config, {"frames": frames, **(origin or _origin())})
        _publish(stage, destination)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
    return destination


def sweep(folder: Path) -> None:
    """Remove what a killed process left half written or half removed.

    Args:
        folder: Folder of the checkpoints; nothing happens where there is none.
    """
    if folder.is_dir():
        for entry in folder.iterdir():
            if entry.name.startswith((_STAGE_PREFIX, f".{_PREFIX}-")):
                shutil.rmtree(entry, ignore_errors=True)


def verify(path: Path) -> None:
    """Raise unless a checkpoint's files are exactly those that were written.

    Args:
        path: The checkpoint's folder.

    Raises:
        CheckpointError: If a file is missing, changed or extra.
    """
    expected = _read_sums(path)
    actual = {entry.relative_to(path).as_posix() for entry in path.rglob("*") if not entry.is_dir()} - {SUMS_NAME}
    for name in sorted(actual.symmetric_difference(expected)):
        state = "has no hash" if name in actual else "is missing"
        msg = f"checkpoint {path} is damaged: {name} {state}; accepted: a checkpoint as it was written"
        raise CheckpointError(msg)
    for name, digest in expected.items():
        if (path / name).is_symlink() or file_sha256(path / name) != digest:
            msg = f"checkpoint {path} is damaged: {name} has changed; accepted: a checkpoint as it was written"
            raise CheckpointError(msg)


def find_checkpoint(path: Path) -> Path:
    """Return the checkpoint that a path means.

    Args:
        path: A checkpoint, a folder of checkpoints, or a run's folder.

    Returns:
        The folder of the checkpoint; of several the newest that is not damaged.

    Raises:
        CheckpointError: If there is none.
    """
    if (path / SUMS_NAME).exists() or (path / "manifest.json").exists():
        verify(path)
        return path
    for folder in (path / CHECKPOINT_FOLDER, path):
        found = sorted(folder.glob(f"{_PREFIX}-*"), reverse=True) if folder.is_dir() else []
        for candidate in found:
            try:
                verify(candidate)
            except CheckpointError as error:
                if candidate == found[-1]:
                    raise
                logger.warning("%s; trying the one before it", error)
                continue
            return candidate
    msg = f"no checkpoint at {path}; accepted: a run's folder or a checkpoint's folder"
    raise CheckpointError(msg)


def read_config(path: Path) -> tuple[TrainConfig, dict[str, Any]]:
    """Return the configuration beside a checkpoint.

    Args:
        path: The checkpoint's folder.

    Returns:
        The configuration, and the whole content of the file (frames, versions, commit).

    Raises:
        CheckpointError: If the file is not what was written; one line names the key.
    """
    try:
        record = json.loads((path / CONFIG_NAME).read_text(encoding="utf-8"))
        return TrainConfig.from_json(record["config"]), record
    except (OSError, KeyError, TypeError, ValueError) as error:
        msg = f"checkpoint {path}: {CONFIG_NAME}: {error}"
        raise CheckpointError(msg) from None


def restore(path: Path, components: Mapping[str, Any]) -> None:
    """Load components from a checkpoint.

    Args:
        path: The checkpoint's folder; verify it first.
        components: Objects with ``load_state_dict``, by name; changed in place.

    Raises:
        CheckpointError: If a component is missing or does not fit.
    """
    try:
        _coordinator(components).load(path, map_location="cpu")  # from where components copy to their own device
    except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, OSError) as error:
        reason = " ".join(str(error).split())[:300]
        msg = f"checkpoint {path} does not fit this configuration: {reason}"
        raise CheckpointError(msg) from None


def weights_sha256(path: Path) -> str:
    """Return what tells a checkpoint's weights from others.

    Args:
        path: The checkpoint's folder.

    Returns:
        SHA-256 of the checkpoint's list of hashes.
    """
    return file_sha256(path / SUMS_NAME)


def progress_path(checkpoint: Path) -> Path:
    """Return where the progress of the run lies that a checkpoint is of.

    Args:
        checkpoint: Folder of a checkpoint of a run, or of shipped weights.

    Returns:
        File of the run's folder, or, for shipped weights, the file beside their folder; it need not exist.

    Examples:
        >>> from pathlib import Path
        >>> progress_path(Path("runs/a/checkpoints/checkpoint-1")).as_posix()
        'runs/a/progress.csv'
        >>> progress_path(Path("weights/push")).as_posix()
        'weights/push-progress.csv'
    """
    if checkpoint.parent.name == CHECKPOINT_FOLDER:
        return checkpoint.parents[1] / PROGRESS_NAME
    return checkpoint.with_name(f"{checkpoint.name}-{PROGRESS_NAME}")


def _coordinator(components: Mapping[str, Any]) -> Checkpoint:
    checkpoint = Checkpoint()
    for name, component in components.items():
        # One file a component; TensorDict's archive holds raw memory and JSON, no pickle.
        checkpoint.register(name, component, adapter=StateDictCheckpointAdapter(payload_format="archive"))
    return checkpoint


def _origin() -> dict[str, Any]:
    return {"versions": versions(), "commit": git_commit()}


def _fill(stage: Path, components: Mapping[str, Any], config: TrainConfig, facts: Mapping[str, Any]) -> None:
    _coordinator(components).save(stage, metadata={"frames": facts["frames"]})
    record = {"config": config.to_json(), "seed": config.seed, **facts}
    (stage / CONFIG_NAME).write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    files = sorted(entry for entry in stage.rglob("*") if entry.is_file())
    lines = [f"{file_sha256(file)}  {file.relative_to(stage).as_posix()}\n" for file in files]
    (stage / SUMS_NAME).write_text("".join(lines), encoding="utf-8")


def _publish(stage: Path, destination: Path) -> None:
    for entry in [*stage.rglob("*"), stage]:
        _flush(entry)
    if destination.exists():
        # A folder cannot be renamed over another: move the old one aside first, its name makes `sweep` remove it.
        old = destination.parent / f"{_STAGE_PREFIX}{uuid.uuid4().hex}"
        destination.replace(old)
        stage.replace(destination)
        shutil.rmtree(old, ignore_errors=True)
    else:
        stage.replace(destination)
    _flush(destination.parent)


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def file_sha256(path: Path) -> str:
    """Return a file's SHA-256.

    Args:
        path: The file.

    Returns:
        Hash in hexadecimal digits.
    """
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _read_sums(path: Path) -> dict[str, str]:
    try:
        lines = (path / SUMS_NAME).read_text(encoding="utf-8").splitlines()
        pairs = [line.split("  ", 1) for line in lines]
        return {name: digest for digest, name in pairs}
    except (OSError, ValueError) as error:
        msg = f"checkpoint {path} is damaged: {SUMS_NAME} cannot be read; accepted: a checkpoint as it was written"
        raise CheckpointError(msg) from error
