"""Checkpoints that are whole or not there: staged, hashed, flushed to disk, and published by one rename.

A checkpoint is a folder: TorchRL's manifest and components (no pickle), ``config.json`` with the resolved
configuration, seed, versions and commit, and ``SHA256SUMS`` over all files. The weights that are shipped have the same
form without optimisers.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import logging
import os
import shutil
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.checkpoint import Checkpoint, CheckpointRotation, StateDictCheckpointAdapter

from cura_torchrl.trainers.build import Networks, make_env
from cura_torchrl.trainers.config import TrainConfig
from cura_torchrl.trainers.errors import CheckpointError
from cura_torchrl.trainers.info import git_commit, shipped_methods, versions
from cura_torchrl.trainers.methods import PRESETS
from cura_torchrl.trainers.progress import PROGRESS_NAME
from cura_torchrl.trainers.run_folder import CHECKPOINT_FOLDER

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torchrl.envs import EnvBase

    from cura_torchrl.envs.config import Simulator, TaskConfig

logger = logging.getLogger(__name__)

CONFIG_NAME = "config.json"
"""File of a checkpoint with the resolved configuration and where it came from."""
SUMS_NAME = "SHA256SUMS"
"""File of a checkpoint with the hash of every other file, in the format of ``sha256sum``."""
SHIPPED_FOLDER = Path(__file__).parent / "weights"
"""Folder of the weights that come with the package, one folder a method."""
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
        if (path / name).is_symlink() or _sha256(path / name) != digest:
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


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """Trained networks with all that is needed to run them."""

    policy: ProbabilisticTensorDictSequential
    """Actor; under TorchRL's ``ExplorationType.DETERMINISTIC`` it returns its mean."""
    critic: TensorDictModule
    """State value."""
    collision_estimator: TensorDictModule
    """Distribution of the collision possibility, risk and uncertainty."""
    config: TrainConfig
    """What the networks were trained with."""
    record: dict[str, Any]
    """Content of ``config.json``: frames, seed, versions, commit."""
    path: Path
    """Where the networks came from."""

    @property
    def weights_sha256(self) -> str:
        """SHA-256 of the checkpoint's list of hashes: what tells these weights from others."""
        return _sha256(self.path / SUMS_NAME)

    def make_env(
        self,
        num_envs: int,
        *,
        task: TaskConfig | None = None,
        simulator: Simulator | None = None,
        keep_map: bool = False,
        **options: Any,
    ) -> EnvBase:
        """Return the environment that the policy was trained for, on the frozen evaluation scenarios.

        Args:
            num_envs: Number of worlds N.
            task: Task to play; None is the trained one with all its obstacles.
            simulator: Where to play; None is where the policy was trained.
            keep_map: Whether the window of the map stays in the tensordict under ``confidence_map``.
            **options: Keyword arguments of :class:`~cura_torchrl.envs.push.PushEnv`, such as ``seed``.

        Returns:
            The environment with its transforms.
        """
        played = self.config.env.task if task is None else task
        played = dataclasses.replace(played, stream="eval", random_first_age=False, curriculum=())
        where = simulator or self.config.simulator
        env = dataclasses.replace(self.config.env, task=played, simulator=where)
        config = self.config.replace(env=env, simulator=where)
        return make_env(config, num_envs, keep_map=keep_map, **options)


def load_policy(source: str | Path) -> LoadedPolicy:
    """Load trained networks.

    Args:
        source: Name of a method whose weights are shipped, or the path of a run or checkpoint.

    Returns:
        Networks in evaluation mode on the CPU, and their configuration.

    Raises:
        CheckpointError: If there is no such method or path, or the checkpoint is damaged.
    """  # noqa: DOC502 - raised by what this calls
    path = find_checkpoint(_resolve(source))
    config, record = read_config(path)
    networks = Networks(config)
    restore(path, {"networks": networks})
    networks.requires_grad_(False).eval()
    return LoadedPolicy(
        policy=networks.actor,
        critic=networks.critic,
        collision_estimator=networks.collision_network,
        config=config,
        record=record,
        path=path,
    )


def export_policy(source: Path, destination: Path | None = None) -> Path:
    """Write a run's newest networks, without optimisers, as weights are shipped, and its curve beside them.

    Args:
        source: A run or a checkpoint.
        destination: Folder to write; None is the package's own folder for the method.

    Returns:
        The folder that was written.

    Raises:
        CheckpointError: If there is no checkpoint or it is damaged.
    """  # noqa: DOC502 - raised by what this calls
    path = find_checkpoint(source)
    config, record = read_config(path)
    networks = Networks(config)
    restore(path, {"networks": networks})
    folder = SHIPPED_FOLDER / config.method if destination is None else destination
    # Paths of the machine that trained say nothing elsewhere.
    released = config.replace(run_dir=Path("runs") / config.method, encoder=None)
    folder.parent.mkdir(parents=True, exist_ok=True)
    curve = progress_path(path)
    if curve.exists():
        shutil.copyfile(curve, progress_path(folder))
    origin = {name: record[name] for name in ("versions", "commit")}
    return write_checkpoint({"networks": networks}, released, folder, frames=record["frames"], origin=origin)


def progress_path(checkpoint: Path) -> Path:
    """Return where the progress of the run lies that a checkpoint is of.

    Args:
        checkpoint: Folder of a checkpoint of a run, or of shipped weights.

    Returns:
        File of the run's folder, or, for shipped weights, the file beside their folder; it need not exist.

    Examples:
        >>> progress_path(Path("runs/a/checkpoints/checkpoint-1")).as_posix()
        'runs/a/progress.csv'
        >>> progress_path(Path("weights/push")).as_posix()
        'weights/push-progress.csv'
    """
    if checkpoint.parent.name == CHECKPOINT_FOLDER:
        return checkpoint.parents[1] / PROGRESS_NAME
    return checkpoint.with_name(f"{checkpoint.name}-{PROGRESS_NAME}")


def _resolve(source: str | Path) -> Path:
    if isinstance(source, str) and source in PRESETS:
        shipped = SHIPPED_FOLDER / source
        if not shipped.exists():
            available = ", ".join(shipped_methods()) or "none"
            msg = f"no weights of method {source!r} are shipped; accepted: {available}, or the path of a checkpoint"
            raise CheckpointError(msg)
        return shipped
    path = Path(source)
    if not path.exists():
        msg = f"no checkpoint at {source}; accepted: the path of a run or checkpoint, or one of {', '.join(PRESETS)}"
        raise CheckpointError(msg)
    return path


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
    lines = [f"{_sha256(file)}  {file.relative_to(stage).as_posix()}\n" for file in files]
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


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _read_sums(path: Path) -> dict[str, str]:
    try:
        lines = (path / SUMS_NAME).read_text(encoding="utf-8").splitlines()
        pairs = [line.split("  ", 1) for line in lines]
        return {name: digest for digest, name in pairs}
    except (OSError, ValueError) as error:
        msg = f"checkpoint {path} is damaged: {SUMS_NAME} cannot be read; accepted: a checkpoint as it was written"
        raise CheckpointError(msg) from error
