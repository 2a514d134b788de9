"""The command line: one subcommand a job, its flags made from the frozen configurations.

Torch, TorchRL and the simulator are imported inside the subcommands, so that help and errors come at once.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import io
import json
import logging
import os
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cura_torchrl.trainers.bench_config import BenchConfig
from cura_torchrl.trainers.calibration_config import CalibrateConfig
from cura_torchrl.trainers.config import EvaluateConfig, TrainConfig
from cura_torchrl.trainers.demo_config import DemoConfig
from cura_torchrl.trainers.errors import RunError, RunsFailedError
from cura_torchrl.trainers.export_config import ExportConfig
from cura_torchrl.trainers.info import capabilities, git_commit, hardware, shipped_methods, versions
from cura_torchrl.trainers.methods import PRESETS, method
from cura_torchrl.trainers.render_config import RenderConfig
from cura_torchrl.trainers.report_config import ReportConfig
from cura_torchrl.trainers.table_config import TableConfig
from cura_torchrl.trainers.train_all_config import PlannedRun, TrainAllConfig
from cura_torchrl.trainers.view_config import ViewConfig

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

PROGRAM = "cura-torchrl"


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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Arguments; those of the process if None.

    Returns:
        Exit code: 0, 2 after a one-line error, 1 if some of several runs failed, 130 and 143 after SIGINT and SIGTERM.
    """
    # PyTorch then takes huge pages for large tensors. It reads this once, when it makes the first one.
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in {"-h", "--help"}:
        sys.stdout.write(_overview())
        return 0
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    if given[0] not in _COMMANDS:
        return _complain(RunError(f"{given[0]!r} is no command; accepted: {', '.join(_COMMANDS)}"), RunError.exit_code)
    try:
        _COMMANDS[given[0]](given[1:])
    except RunError as error:
        return _complain(error, error.exit_code)
    except OSError as error:
        return _complain(error, RunError.exit_code)
    except KeyboardInterrupt:
        return 130
    return 0


def _complain(error: Exception, code: int) -> int:
    sys.stderr.write(f"{PROGRAM}: {' '.join(str(error).split())}\n")
    return code


def _overview() -> str:
    lines = [f"  {name:<14}{(command.__doc__ or '').splitlines()[0]}" for name, command in _COMMANDS.items()]
    usage = f"usage: {PROGRAM} COMMAND [flags]; {PROGRAM} COMMAND --help lists the flags"
    return "\n".join([usage, "", "commands:", *lines, "", f"methods: {', '.join(PRESETS)}", ""])


def _train(arguments: list[str]) -> None:
    """Train a method."""
    options = _parse(TrainOptions, "train", arguments, TrainOptions(config=_defaults(arguments)))
    _require_path(options.init_from)
    module = _import("cura_torchrl.trainers.train")
    with _clean_stdout():
        checkpoint = module.train(options.config, resume=options.resume, init_from=options.init_from)
    sys.stdout.write(f"{checkpoint}\n")


def _train_all(arguments: list[str]) -> None:
    """Train methods with several seeds, unattended."""  # noqa: DOC501 - the first line is the overview's
    end = arguments.index("--") if "--" in arguments else len(arguments)
    options = _parse(TrainAllOptions, "train-all", arguments[:end])
    config = options.config
    runs = [_plan(config, name, seed, arguments[end + 1 :]) for name in config.methods for seed in config.seeds]
    if options.status:
        read = _import("cura_torchrl.trainers.run_status").read_status
        statuses = [read(run) for run in runs]
    else:
        module = _import("cura_torchrl.trainers.train_all")
        with _clean_stdout():
            statuses = module.train_all(config, runs)
    found = [dataclasses.asdict(status) for status in statuses]
    lines = "".join(f"{status.as_line()}\n" for status in statuses)
    sys.stdout.write(json.dumps(found, indent=2) + "\n" if options.json else lines)
    failed = [f"{status.method}-{status.seed}" for status in statuses if status.state == "failed"]
    if failed and not options.status:
        msg = f"{len(failed)} of {len(runs)} runs failed: {', '.join(failed)}; the same command tries them again"
        raise RunsFailedError(msg)


def _plan(config: TrainAllConfig, name: str, seed: int, flags: list[str]) -> PlannedRun:
    with _one_line_errors():
        words = config.train_arguments(name, seed, flags)
    start = config.start_of(name)
    _require_path(start)
    asked = _parse(TrainOptions, "train", list(words), TrainOptions(config=_defaults(list(words))))
    return PlannedRun(config=asked.config, arguments=words, init_from=start)


def _evaluate(arguments: list[str]) -> None:
    """Count how a policy's episodes end."""
    options = _parse(EvaluateOptions, "evaluate", arguments)
    with _one_line_errors():
        if options.config.method is not None:
            method(options.config.method)
    _require_path(options.config.checkpoint)
    module = _import("cura_torchrl.trainers.evaluate")
    with _clean_stdout():
        result = module.evaluate(options.config)
    sys.stdout.write(json.dumps(result, indent=2) + "\n" if options.json else _as_text(result))


def _release(arguments: list[str]) -> None:
    """Write a run's networks as the weights that a method ships with."""
    options = _parse(ReleaseOptions, "release", arguments)
    folder = _import("cura_torchrl.trainers.checkpoint").export_policy(options.checkpoint, options.destination)
    sys.stdout.write(f"{folder}\n")


def _export(arguments: list[str]) -> None:
    """Write a policy as ONNX and torch.export graphs, with a runner for a robot."""
    config = _parse(ExportConfig, "export", arguments)
    _require_path(config.checkpoint)
    module = _import("cura_torchrl.trainers.export")
    with _clean_stdout():
        folder = module.export(config)
    sys.stdout.write(f"{folder}\n")


def _bench(arguments: list[str]) -> None:
    """Measure how fast the parts are, as ratios."""
    options = _parse(BenchOptions, "bench", arguments)
    module = _import("cura_torchrl.trainers.bench")
    with _clean_stdout():
        result = module.bench(options.config)
    sys.stdout.write(json.dumps(result, indent=2) + "\n" if options.json else module.as_table(result))


def _info(arguments: list[str]) -> None:
    """Show versions, hardware, and what works here."""
    options = _parse(InfoOptions, "info", arguments)
    found = {
        "versions": versions(),
        "commit": git_commit(),
        "hardware": hardware(),
        "works": capabilities(),
        "shipped methods": shipped_methods(),
    }
    sys.stdout.write(json.dumps(found, indent=2) + "\n" if options.json else _as_text(found))


def _pretrain_map(arguments: list[str]) -> None:
    """Train the encoder of confidence maps."""
    module = _import("cura_torchrl.trainers.pretrain_map")
    config = _parse(module.PretrainMapConfig, "pretrain-map", arguments)
    with _clean_stdout():
        module.pretrain_map(config)


def _imitate(arguments: list[str]) -> None:
    """Warm-start the networks of a method by imitating a scripted pusher."""
    module = _import("cura_torchrl.trainers.imitate")
    config = _parse(module.ImitateConfig, "imitate", arguments)
    with _clean_stdout():
        checkpoint = module.imitate(config)
    sys.stdout.write(f"{checkpoint}\n")


def _demo(arguments: list[str]) -> None:
    """Play the shipped policies on the same scenes, and write a page to look at."""
    config = _parse(DemoConfig, "demo", arguments)
    module = _import("cura_torchrl.trainers.demo")
    with _clean_stdout():
        page = module.demo(config)
    sys.stdout.write(f"{page}\n")


def _render(arguments: list[str]) -> None:
    """Play one scene and write the paper's figures of it and animations."""
    config = _parse(RenderConfig, "render", arguments)
    module = _import("cura_torchrl.trainers.render")
    with _clean_stdout():
        files = module.render(config)
    sys.stdout.write("".join(f"{file}\n" for file in files))


def _table(arguments: list[str]) -> None:
    """Play methods in all cells and write the table of success rates."""
    config = _parse(TableConfig, "table", arguments)
    module = _import("cura_torchrl.trainers.table")
    with _clean_stdout():
        page = module.table(config)
    sys.stdout.write(page)


def _report(arguments: list[str]) -> None:
    """Write a page about a trained policy, to look at and to send around."""
    config = _parse(ReportConfig, "report", arguments)
    module = _import("cura_torchrl.trainers.report")
    with _clean_stdout():
        page = module.report(config)
    sys.stdout.write(f"{page}\n")


def _view(arguments: list[str]) -> None:
    """Play scenes in the browser, step by step."""
    config = _parse(ViewConfig, "view", arguments)
    module = _import("cura_torchrl.trainers.view")
    with _clean_stdout():
        module.view(config)


def _calibrate(arguments: list[str]) -> None:
    """Compare what the collision estimator predicts with what comes of it."""
    config = _parse(CalibrateConfig, "calibrate", arguments)
    module = _import("cura_torchrl.trainers.calibrate")
    with _clean_stdout():
        page = module.calibrate(config)
    sys.stdout.write(page)


def _defaults(arguments: list[str]) -> TrainConfig:
    """Return what the flags of ``train`` start from: the method's preset, or the run's own configuration."""
    scout = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    scout.add_argument("--method")
    scout.add_argument("--run-dir", "--run_dir", type=Path, default=TrainConfig().run_dir)
    scout.add_argument("--resume", action="store_true")
    with _one_line_errors():
        known, _ = scout.parse_known_args([entry for entry in arguments if entry not in {"-h", "--help"}])
        preset = method(known.method or TrainConfig().method)
    if not known.resume:
        return preset
    _require_path(known.run_dir)
    module = _import("cura_torchrl.trainers.checkpoint")
    config, _ = module.read_config(module.find_checkpoint(known.run_dir))
    return config.replace(run_dir=known.run_dir)


def _require_path(path: Path | None) -> None:
    # Before anything slow is imported; what the path holds is checked when it is read.
    if path is not None and not path.exists():
        msg = f"no checkpoint at {path}; accepted: a run's folder or a checkpoint's folder"
        raise RunError(msg)


def _parse(options: type[Any], command: str, arguments: list[str], default: Any = None) -> Any:
    # An error is one line in place of tyro's box.
    printed = io.StringIO()
    given = {} if default is None else {"default": default}
    try:
        with contextlib.redirect_stderr(printed), _one_line_errors():
            return tyro.cli(options, prog=f"{PROGRAM} {command}", args=arguments, **given)
    except SystemExit as exit_:
        if exit_.code in {0, None}:
            raise
        raise RunError(_unbox(printed.getvalue())) from None


def _unbox(text: str) -> str:
    """Return the message inside tyro's box."""
    inside = re.findall(r"^│ ?(.*?) *│$", text, flags=re.MULTILINE)
    rule = next((index for index, line in enumerate(inside) if line.startswith("───")), len(inside))
    return " ".join(" ".join(inside[:rule] or [text]).split())


@contextlib.contextmanager
def _one_line_errors() -> Iterator[None]:
    try:
        yield
    except (ValueError, argparse.ArgumentError) as error:
        raise RunError(str(error)) from None


@contextlib.contextmanager
def _clean_stdout() -> Iterator[None]:
    """Send what libraries print, C code and worker processes included, to stderr."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def _import(name: str) -> Any:
    """Return a module that needs torch, TorchRL or the simulator, which write to stdout while they are imported."""
    with _clean_stdout():
        module = importlib.import_module(name)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    return module


def _as_text(result: dict[str, Any], indent: str = "") -> str:
    lines = []
    for name, value in result.items():
        if isinstance(value, dict):
            lines.append(f"{indent}{name}:\n{_as_text(value, indent + '  ')}".rstrip("\n"))
        else:
            shown = f"{value:.4g}" if isinstance(value, float) else value
            lines.append(f"{indent}{name}: {', '.join(value) if isinstance(value, list) else shown}")
    return "\n".join(lines) + "\n"


_COMMANDS: dict[str, Callable[[list[str]], None]] = {
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

if __name__ == "__main__":
    sys.exit(main())
