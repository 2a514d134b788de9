"""Speed of map encoders beside what comes through their codes, as JSON.

Trains nothing: it reads the folders of `cura-torchrl pretrain-map --widths ... --patch ... --run-dir ...` and times the
encoders in turn, by processor time: python benchmarks/encoder_shapes.py runs/shapes/*
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
from pathlib import Path

import torch

from cura_torchrl.modules import MapVAE
from cura_torchrl.trainers.benches.report import measure, timed
from cura_torchrl.trainers.info import provenance
from cura_torchrl.trainers.pretrain_map import FIGURES_NAME, WEIGHTS_NAME


def seconds_of_a_batch(encoders: dict[str, MapVAE], batch: int, rounds: int) -> dict[str, float]:
    """Return the median processor time that each encoder takes for a batch of maps [s].

    Args:
        encoders: Encoders by name.
        batch: Maps [1].
        rounds: How often each is timed, all in turn [1].
    """
    maps = torch.rand(batch, 2, 100, 100)
    plays = {name: timed(functools.partial(encoder.requires_grad_(False), maps)) for name, encoder in encoders.items()}
    return {name: statistics.median(taken) for name, taken in measure(plays, rounds, "encoders").items()}


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="folders with weights and figures")
    parser.add_argument("--batch", type=int, default=512, help="maps of a batch [1]")
    parser.add_argument("--rounds", type=int, default=15, help="batches of each encoder [1]")
    parser.add_argument("--output", type=Path, help="file for the figures")
    options = parser.parse_args()
    torch.set_num_threads(1)
    encoders = {str(run): MapVAE.load(run / WEIGHTS_NAME) for run in options.runs}
    seconds = seconds_of_a_batch(encoders, options.batch, options.rounds)
    shapes = {}
    for run in options.runs:
        record = json.loads((run / FIGURES_NAME).read_text(encoding="utf-8"))
        shapes[run.name] = {
            "shape": encoders[str(run)].shape,
            "epochs": record["config"]["epochs"],
            "maps_per_core_second": round(options.batch / seconds[str(run)]),
            "figures": {name: round(value, 4) for name, value in record["figures"].items()},
        }
    text = json.dumps({**provenance(), "shapes": shapes}, indent=2)
    print(text)
    if options.output is not None:
        options.output.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
