"""The commands: one function a job, its flags made from the frozen configurations.

Torch, TorchRL and the simulator are imported inside the functions, so that help and errors come at once.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cura_torchrl.trainers.benches.config import BenchConfig
from cura_torchrl.trainers.calibration.config import CalibrateConfig
from cura_torchrl.trainers.command_line import as_text, clean_stdout, load_module, one_line_errors, parse, require_path
from cura_torchrl.trainers.config import EvaluateConfig, TrainConfig
from cura_torchrl.trainers.deployment.config import ExportConfig
from cura_torchrl.trainers.errors import RunsFailedError
from cura_torchrl.trainers.evaluation.table_config import TableConfig
from cura_torchrl.trainers.info import capabilities, git_commit, hardware, shipped_methods, versions
from cura_torchrl.trainers.methods import method
from cura_torchrl.trainers.pages.demo_config import DemoConfig
from cura_torchrl.trainers.pages.report_config import ReportConfig
from cura_torchrl.trainers.pictures.render_config import RenderConfig
from cura_torchrl.trainers.pictures.view_config import ViewConfig
from cura_torchrl.trainers.training.imitate_config import ImitateConfig
from cura_torchrl.trainers.training.pretrain_map_config import PretrainMapConfig
from cura_torchrl.trainers.training.train_all_config import PlannedRun, TrainAllConfig

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    """Train a method. The method decides the other flags' defaults; with --resume the run's own configuration does."""

    config: Annotated[TrainConfig, tyro.conf.arg(name="")]
    """The run."""
    resume: bool = False
    """Go on from the newest good checkpoint in the run's folder."""
    init_from: Path | None = None
    """Run or checkpoint whose networks to start from; optimisers, counters and curriculum start afresh."""


@dataclass(frozen=True, kw_only=True)
class TrainAllOptions:
    """Train every method with every seed, each as a run METHOD-SEED of train; what is trained already is kept.

    The same command goes on after an interruption. Flags after -- are those of train, the same for all runs.
    """

    config: Annotated[TrainAllConfig, tyro.conf.arg(name="")]
    """The runs."""
    status: bool = False
    """Print how far each run is, and start nothing."""
    json: bool = False
    """Print that as JSON."""


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """Play frozen scenarios with a trained or scripted policy and count how they end."""

    config: Annotated[EvaluateConfig, tyro.conf.arg(name="")]
    """Policy and scenarios."""
    json: bool = False
    """Print nothing but the result, as JSON."""


@dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """Measure how fast the parts are, each beside a reference that is measured in turn with it."""

    config: Annotated[BenchConfig, tyro.conf.arg(name="")]
    """What is measured, and how."""
    json: bool = False
    """Print nothing but the result, as JSON."""


@dataclass(frozen=True, kw_only=True)
class ReleaseOptions:
    """Write a run's newest networks, without optimisers, as the weights that a method ships with."""

    checkpoint: Path
    """Run or checkpoint."""
    destination: Path | None = None
    """Folder to write; none is the package's own folder for the method."""


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """Show versions, hardware, and what works here."""

    json: bool = False
    """Print JSON."""


def _train(arguments: list[str]) -> None:
    """Train a method."""
    options = parse(TrainOptions, "train", arguments, TrainOptions(config=_defaults(arguments)))
    require_path(options.init_from)
    module = load_module("cura_torchrl.trainers.train")
    with clean_stdout():
        checkpoint = module.train(options.config, resume=options.resume, init_from=options.init_from)
    sys.stdout.write(f"{checkpoint}\n")


def _train_all(arguments: list[str]) -> None:
    """Train methods with several seeds, unattended."""  # noqa: DOC501 - the first line is the overview's
    end = arguments.index("--") if "--" in arguments else len(arguments)
    options = parse(TrainAllOptions, "train-all", arguments[:end])
    config = options.config
    runs = [_plan(config, name, seed, arguments[end + 1 :]) for name in config.methods for seed in config.seeds]
    if options.status:
        read = load_module("cura_torchrl.trainers.training.run_status").read_status
        statuses = [read(run) for run in runs]
    else:
        module = load_module("cura_torchrl.trainers.train_all")
        with clean_stdout():
            statuses = module.train_all(config, runs)
    found = [dataclasses.asdict(status) for status in statuses]
    lines = "".join(f"{status.as_line()}\n" for status in statuses)
    sys.stdout.write(json.dumps(found, indent=2) + "\n" if options.json else lines)
    failed = [f"{status.method}-{status.seed}" for status in statuses if status.state == "failed"]
    if failed and not options.status:
        msg = f"{len(failed)} of {len(runs)} runs failed: {', '.join(failed)}; the same command tries them again"
        raise RunsFailedError(msg)


def _plan(config: TrainAllConfig, name: str, seed: int, flags: list[str]) -> PlannedRun:
    with one_line_errors():
        words = config.train_arguments(name, seed, flags)
    start = config.start_of(name)
    require_path(start)
    asked = parse(TrainOptions, "train", list(words), TrainOptions(config=_defaults(list(words))))
    return PlannedRun(config=asked.config, arguments=words, init_from=start)


def _evaluate(arguments: list[str]) -> None:
    """Count how a policy's episodes end."""
    options = parse(EvaluateOptions, "evaluate", arguments)
    with one_line_errors():
        if options.config.method is not None:
            method(options.config.method)
    require_path(options.config.checkpoint)
    result = _run("evaluate", options.config)
    sys.stdout.write(json.dumps(result, indent=2) + "\n" if options.json else as_text(result))


def _release(arguments: list[str]) -> None:
    """Write a run's networks as the weights that a method ships with."""
    options = parse(ReleaseOptions, "release", arguments)
    folder = load_module("cura_torchrl.trainers.release").release(options.checkpoint, options.destination)
    sys.stdout.write(f"{folder}\n")


def _export(arguments: list[str]) -> None:
    """Write a policy as ONNX and torch.export graphs, with a runner for a robot."""
    config = parse(ExportConfig, "export", arguments)
    require_path(config.checkpoint)
    folder = _run("export", config)
    sys.stdout.write(f"{folder}\n")


def _bench(arguments: list[str]) -> None:
    """Measure how fast the parts are, as ratios."""
    options = parse(BenchOptions, "bench", arguments)
    module = load_module("cura_torchrl.trainers.bench")
    with clean_stdout():
        result = module.bench(options.config)
    sys.stdout.write(json.dumps(result, indent=2) + "\n" if options.json else module.as_table(result))


def _info(arguments: list[str]) -> None:
    """Show versions, hardware, and what works here."""
    options = parse(InfoOptions, "info", arguments)
    found = {
        "versions": versions(),
        "commit": git_commit(),
        "hardware": hardware(),
        "works": capabilities(),
        "shipped methods": shipped_methods(),
    }
    sys.stdout.write(json.dumps(found, indent=2) + "\n" if options.json else as_text(found))


def _pretrain_map(arguments: list[str]) -> None:
    """Train the encoder of confidence maps."""
    config = parse(PretrainMapConfig, "pretrain-map", arguments)
    _run("pretrain_map", config)


def _imitate(arguments: list[str]) -> None:
    """Warm-start the networks of a method by imitating a scripted pusher."""
    config = parse(ImitateConfig, "imitate", arguments)
    checkpoint = _run("imitate", config)
    sys.stdout.write(f"{checkpoint}\n")


def _demo(arguments: list[str]) -> None:
    """Play the shipped policies on the same scenes, and write a page to look at."""
    config = parse(DemoConfig, "demo", arguments)
    page = _run("demo", config)
    sys.stdout.write(f"{page}\n")


def _render(arguments: list[str]) -> None:
    """Play one scene and write the paper's figures of it and animations."""
    config = parse(RenderConfig, "render", arguments)
    files = _run("render", config)
    sys.stdout.write("".join(f"{file}\n" for file in files))


def _table(arguments: list[str]) -> None:
    """Play methods in all cells and write the table of success rates."""
    config = parse(TableConfig, "table", arguments)
    page = _run("table", config)
    sys.stdout.write(page)


def _report(arguments: list[str]) -> None:
    """Write a page about a trained policy, to look at and to send around."""
    config = parse(ReportConfig, "report", arguments)
    page = _run("report", config)
    sys.stdout.write(f"{page}\n")


def _view(arguments: list[str]) -> None:
    """Play scenes in the browser, step by step."""
    config = parse(ViewConfig, "view", arguments)
    _run("view", config)


def _calibrate(arguments: list[str]) -> None:
    """Compare what the collision estimator predicts with what comes of it."""
    config = parse(CalibrateConfig, "calibrate", arguments)
    page = _run("calibrate", config)
    sys.stdout.write(page)


def _run(name: str, config: Any) -> Any:
    """Return what the function of this name, in the module of this name, makes of a configuration."""
    module = load_module(f"cura_torchrl.trainers.{name}")
    with clean_stdout():
        return getattr(module, name)(config)


def _defaults(arguments: list[str]) -> TrainConfig:
    """Return what the flags of ``train`` start from: the method's preset, or the run's own configuration."""
    scout = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    scout.add_argument("--method")
    scout.add_argument("--run-dir", "--run_dir", type=Path, default=TrainConfig().run_dir)
    scout.add_argument("--resume", action="store_true")
    with one_line_errors():
        known, _ = scout.parse_known_args([entry for entry in arguments if entry not in {"-h", "--help"}])
        preset = method(known.method or TrainConfig().method)
    if not known.resume:
        return preset
    require_path(known.run_dir)
    module = load_module("cura_torchrl.trainers.checkpoint")
    config, _ = module.read_config(module.find_checkpoint(known.run_dir))
    return config.replace(run_dir=known.run_dir)


COMMANDS: dict[str, Callable[[list[str]], None]] = {
    "pretrain-map": _pretrain_map,
    "imitate": _imitate,
    "train": _train,
    "train-all": _train_all,
    "evaluate": _evaluate,
    "table": _table,
    "report": _report,
    "view": _view,
    "render": _render,
    "calibrate": _calibrate,
    "release": _release,
    "export": _export,
    "demo": _demo,
    "bench": _bench,
    "info": _info,
}
"""By the name on the command line."""
