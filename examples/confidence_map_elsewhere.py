"""The map that forgets on somebody else's environment: robots that drive in circles among pillars.

The environment has its own names for scan and pose and knows of no object: ``ConfidenceMap`` is told so by ``in_keys``
and ``object_keys=None``. Draws the map of the first robot.

python examples/confidence_map_elsewhere.py --output map.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from tqdm import tqdm

from cura_torchrl import ConfidenceMap
from cura_torchrl.envs.config import MapConfig

RAYS, MAX_RANGE, PERIOD = 180, 4.0, 0.2  # [1], [m], [s]
ROBOT_RADIUS, PILLAR_RADIUS, PILLARS = 0.2, 0.3, 12  # [m], [m], in each world [1]
CIRCLE, CENTRE = torch.tensor([0.6, 0.4]), torch.tensor([0.0, 1.5])
"""Action that drives in a circle (speed [m/s], turn rate [rad/s]); where its centre and that of the ring is [m]."""
BEARINGS = torch.arange(RAYS) * (2 * torch.pi / RAYS) - torch.pi
"""Directions of the rays [rad]: ``ConfidenceMap`` wants them counter-clockwise from straight behind."""


def relative(pillars: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
    """Return centres, ``[N, P, 2]`` [m], as robots at (x [m], y [m], yaw [rad]), ``[N, 3]``, see them: ahead, left."""
    cos, sin = pose[:, 2].cos(), pose[:, 2].sin()
    return (pillars - pose[:, None, :2]) @ torch.stack([cos, -sin, sin, cos], -1).unflatten(-1, (2, 2))


def cast(centres: torch.Tensor) -> torch.Tensor:
    """Return the ranges [m], shape ``[N, RAYS]``, from the pillars' centres ahead and to the left, ``[N, P, 2]``."""
    along = centres @ torch.stack([BEARINGS.cos(), BEARINGS.sin()])
    inside = PILLAR_RADIUS**2 - centres.square().sum(-1, keepdim=True) + along.square()
    ranges = torch.where((inside >= 0) & (along > 0), along - inside.clamp_min(0).sqrt(), MAX_RANGE)
    return ranges.amin(-2).clamp(0.0, MAX_RANGE)


class PillarWorlds(EnvBase):
    """Robots in rings of pillars, whose episodes never end. Actions are (speed [m/s], turn rate [rad/s])."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(batch_size=torch.Size([num_envs]))
        robot = {"lidar": Unbounded(shape=(num_envs, RAYS)), "odometry": Unbounded(shape=(num_envs, 3))}
        self.observation_spec = Composite(robot=Composite(robot, shape=(num_envs,)), shape=(num_envs,))
        self.action_spec = Bounded(-1.0, 1.0, shape=(num_envs, 2))
        self.reward_spec = Unbounded(shape=(num_envs, 1))
        self.pose, self.pillars = torch.zeros(num_envs, 3), torch.zeros(num_envs, PILLARS, 2)

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(0 if seed is None else seed)  # the pillars are drawn with torch's own generator

    def _sense(self, **outcome: torch.Tensor) -> TensorDict:
        robot = {"lidar": cast(relative(self.pillars, self.pose)), "odometry": self.pose.clone()}
        return TensorDict({"robot": robot, **outcome}, self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDict:
        fresh = None if tensordict is None else tensordict.get("_reset", None)
        fresh = torch.ones(self.batch_size, dtype=torch.bool) if fresh is None else fresh.squeeze(-1)
        radius, bearing = 2.5 + 1.5 * torch.rand(*self.batch_size, PILLARS, 1), 6.2832 * torch.rand(PILLARS)
        self.pillars[fresh] = (CENTRE + radius * torch.stack([bearing.cos(), bearing.sin()], -1))[fresh]
        self.pose[fresh] = 0.0
        return self._sense()

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        speed, turn = tensordict["action"].clamp(-1.0, 1.0).split(1, -1)
        yaw = self.pose[:, 2:] + PERIOD * turn
        self.pose = torch.cat([self.pose[:, :2] + PERIOD * speed * torch.cat([yaw.cos(), yaw.sin()], -1), yaw], -1)
        return self._sense(reward=speed, done=torch.zeros_like(speed, dtype=torch.bool))


def draw(window: torch.Tensor, centres: torch.Tensor, config: MapConfig, output: Path) -> None:
    """Save both channels, shape ``[2, W, W]``, under the pillars, shape ``[P, 2]`` [m]; up is ahead, left is left."""
    figure, half = Figure(figsize=(8, 4), layout="constrained"), config.window * config.resolution / 2  # [m]
    for axis, channel, title in zip(figure.subplots(1, 2), window, ("confidence", "occupancy"), strict=True):
        # Row 0 lies behind the robot, column 0 to its right.
        axis.imshow(channel, origin="lower", cmap="gray", vmin=0.0, vmax=1.0, extent=(-half, half, -half, half))
        for ahead, left in centres.tolist():
            axis.add_patch(Circle((left, ahead), PILLAR_RADIUS, fill=False, color="tab:red"))
        axis.set(title=title, xlim=(half, -half), ylim=(-half, half), xlabel="left [m]", ylabel="ahead [m]")
    figure.savefig(output)


def main() -> None:
    """Parse the command line, drive and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int, default=4, help="worlds [1]")
    parser.add_argument("--steps", type=int, default=100, help="steps of each world [1]")
    parser.add_argument("--output", type=Path, default=Path("map.png"), help="where the picture goes")
    options = parser.parse_args()

    config = MapConfig(decay=0.9, window=80, extent_x=(-8.0, 8.0), extent_y=(-8.0, 8.0))
    sizes = {"num_rays": RAYS, "max_range": MAX_RANGE, "robot_size": (2 * ROBOT_RADIUS, 2 * ROBOT_RADIUS)}
    keys = {"in_keys": [("robot", "lidar"), ("robot", "odometry")], "object_keys": None, "out_key": ("robot", "map")}
    torch.manual_seed(0)
    worlds = PillarWorlds(options.num_envs)
    env = TransformedEnv(worlds, ConfidenceMap(config, **sizes, **keys))
    state = env.reset()
    for _ in tqdm(range(options.steps), unit="step"):
        state["action"] = CIRCLE.expand(options.num_envs, 2)
        _, state = env.step_and_maybe_reset(state)
    window, centres = state["robot", "map"][0], relative(worlds.pillars, worlds.pose)[0]
    draw(window, centres, config, options.output)
    occupied = ((window[1] > 0).nonzero() - (config.window - 1) / 2) * config.resolution  # ahead, left [m]
    off = (torch.cdist(occupied, centres).amin(-1) - PILLAR_RADIUS).abs().mean()
    seen = f"{(window[0] > 0.5).float().mean():.0%} seen of late"
    print(f"{options.output}: {seen}; {len(occupied)} occupied cells, {off:.3f} m from a pillar's edge")


if __name__ == "__main__":
    main()
