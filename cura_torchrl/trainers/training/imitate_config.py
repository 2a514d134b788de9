"""Configuration of the warm start: pure data, importable without torch."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from cura_torchrl.envs.config import Simulator
from cura_torchrl.trainers.config import Perception, TrainConfig
from cura_torchrl.trainers.methods import method
from cura_torchrl.validation import require, require_fields

Expert = Literal["scripted", "avoider"]


@dataclass(frozen=True, kw_only=True)
class ImitateConfig:
    """Imitate a scripted pusher."""

    run_dir: Path = Path("runs/imitate")
    """Folder for the checkpoint."""
    expert: Expert = "scripted"
    """Who is imitated: a pusher without obstacles, or one that steers around all of them."""
    method: str = "push"
    """Whose robot acts, and whose LiDAR and map the networks see, if there are obstacles."""
    perception: Perception = "map"
    """What they see beside their vector, if there are obstacles: the map's code, or for diagnosis the obstacles."""
    simulator: Simulator = "bullet"
    """Which simulator runs the worlds."""
    encoder: Path | None = None
    """Weights of the map's encoder, as ``pretrain-map`` writes them; none takes those that are shipped."""
    num_envs: int = 32
    """Worlds that are played side by side [1]."""
    rounds: int = 4
    """Rounds of collecting and fitting [1]; from the second on the learner drives half of the worlds."""
    steps: int = 500
    """Policy steps of each world in a round [1]."""
    epochs: int = 30
    """Passes over all data after each round [1]."""
    minibatch_size: int = 512
    """Frames per gradient step [1]."""
    lr: float = 1e-3
    """Learning rate [1]."""
    noise: float = 0.3
    """Standard deviation of the smooth noise added to what is executed, not to what is learned [1]."""
    std: float = 0.25
    """Standard deviation of the action that training starts with [1]."""
    seed: int = 0
    """Seed of scenarios, networks and noise [1]."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("num_envs", "rounds", "steps", "epochs", "minibatch_size", "lr", "std"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        require(self.noise >= 0, "noise", self.noise, "a number that is not negative")
        _ = self.train_config  # what the method, the networks and the seed refuse

    @property
    def train_config(self) -> TrainConfig:
        """Configuration of the policy: one that sees no map if there are no obstacles."""
        preset = method(self.method).replace(
            seed=self.seed,
            run_dir=self.run_dir,
            num_envs=self.num_envs,
            simulator=self.simulator,
            encoder=self.encoder,
        )
        network = dataclasses.replace(preset.network, init_std=self.std)
        task = dataclasses.replace(preset.env.task, curriculum=())
        lidar, perception = preset.env.lidar, self.perception
        if self.expert == "scripted":
            task = dataclasses.replace(task, scenario=dataclasses.replace(task.scenario, max_obstacles=0))
            lidar, perception = dataclasses.replace(lidar, num_rays=8), "none"
        env = dataclasses.replace(preset.env, task=task, lidar=lidar)
        return preset.replace(network=network, env=env, perception=perception)
