"""Give a trained collision estimator more atoms, each a copy of an old one, to train on from there.

python benchmarks/research/more_atoms.py --checkpoint cura-ppo --copies 4 --output runs/wide
cura-torchrl train --method cura-ppo --init-from runs/wide --cura.num-atoms 200 --run-dir runs/cura-ppo-200
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import torch

from cura_torchrl.trainers.build import Networks
from cura_torchrl.trainers.checkpoint import write_checkpoint
from cura_torchrl.trainers.loaded_policy import load_policy, read_networks

NOISE = 1e-3
"""Standard deviation of the noise on copied weights, without which copies would stay copies [1]."""


def widen(checkpoint: str, copies: int, output: Path) -> Path:
    """Write the networks of a policy with more atoms; all else is the same.

    Args:
        checkpoint: Method whose weights are shipped, or the path of a run.
        copies: Atoms in place of each old one [1].
        output: Folder to write.

    Returns:
        The folder.
    """
    loaded = load_policy(checkpoint)
    config, record = loaded.config, loaded.record
    wide = config.replace(cura=dataclasses.replace(config.cura, num_atoms=copies * config.cura.num_atoms))
    new = Networks(wide)
    weights, shapes = read_networks(loaded.path, config).state_dict(), new.state_dict()
    generator = torch.Generator().manual_seed(0)
    for name, value in weights.items():
        if shapes[name].shape != value.shape:
            copied = value.repeat_interleave(copies, dim=0)
            weights[name] = copied + NOISE * torch.randn(copied.shape, generator=generator)
    new.load_state_dict(weights)
    origin = {name: record[name] for name in ("versions", "commit")}
    return write_checkpoint({"networks": new}, wide, output, frames=record["frames"], origin=origin)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--checkpoint", default="cura-ppo", help="method whose weights are shipped, or a run's folder")
    parser.add_argument("--copies", type=int, default=4, help="atoms in place of each old one")
    parser.add_argument("--output", type=Path, default=Path("runs/wide"), help="folder to write")
    widen(**vars(parser.parse_args()))
