"""Frozen configuration of training and evaluation: pure data, importable without torch.

The environment's own configuration is nested, not copied. A field's docstring gives its unit; ``cura-torchrl train
--help`` prints it. The methods are presets of :class:`TrainConfig`, see :mod:`cura_torchrl.trainers.methods`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from cura_torchrl.envs.config import (
    MapConfig,
    PushEnvConfig,
    RobotConfig,
    RobotName,
    ScenarioKind,
    Simulator,
)
from cura_torchrl.trainers.decoding import decode, encode
from cura_torchrl.validation import require, require_fields

LoggerKind = Literal["csv", "tensorboard", "wandb"]
ScriptedKind = Literal["scripted", "avoider", "random"]
Perception = Literal["map", "none", "privileged"]
Backend = Literal["process", "ray"]
RiskMeasureKind = Literal["mean", "cvar", "wang"]
UncertaintyKind = Literal["total", "perceptual"]


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Proximal policy optimisation with a learning rate that adapts to the KL divergence."""

    gamma: float = 0.99
    """Discount of the reward per policy step [1]. Range: 0 to 1."""
    lmbda: float = 0.95
    """Lambda of the generalised advantage estimate [1]. Range: 0 to 1."""
    clip_epsilon: float = 0.2
    """Clip of the probability ratio [1]."""
    epochs: int = 5
    """Passes over each rollout [1]."""
    minibatch_size: int = 1024
    """Frames per gradient step [1]; a rollout that is smaller is one minibatch."""
    rollout_steps: int = 64
    """Policy steps of each environment between two updates [1]."""
    entropy_coeff: float = 0.005
    """Weight of the entropy bonus [1]."""
    critic_coeff: float = 1.0
    """Weight of the critic's loss [1]."""
    critic_warmup_frames: int = 0
    """Frames for which only critic and estimator learn [1], so that no untrained critic leads a trained actor."""
    value_scale: float = 100.0
    """Magnitude of the returns [1]: the critic's network and its squared error are in units of it."""
    max_grad_norm: float = 1.0
    """Norm that the gradient of the actor, and that of the critic, is clipped to [1]."""
    critic_lr: float = 5e-4
    """Learning rate of the critic [1]; it does not adapt."""
    lr: float = 1e-3
    """Learning rate of the actor at the start [1]."""
    min_lr: float = 1e-5
    """Smallest learning rate of the actor [1]."""
    max_lr: float = 1e-2
    """Largest learning rate of the actor [1]."""
    target_kl: float = 0.01
    """KL divergence from the old to the new policy that the learning rate aims at [nat]; 0 keeps the rate fixed."""
    lr_factor: float = 1.5
    """Factor by which the learning rate rises or falls when the KL divergence is off by more than two [1]."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("gamma", "lmbda"):
            require(0.0 <= getattr(self, name) <= 1.0, name, getattr(self, name), "0 to 1")
        for name in (
            "clip_epsilon",
            "epochs",
            "minibatch_size",
            "rollout_steps",
            "max_grad_norm",
            "critic_lr",
            "min_lr",
            "value_scale",
        ):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        for name in ("entropy_coeff", "critic_coeff", "target_kl", "critic_warmup_frames"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a number that is not negative")
        require(self.min_lr <= self.lr <= self.max_lr, "lr", self.lr, f"min_lr {self.min_lr} to max_lr {self.max_lr}")
        require(self.lr_factor > 1.0, "lr_factor", self.lr_factor, "a number larger than 1")


@dataclass(frozen=True, kw_only=True)
class CURAConfig:
    """The collision estimator, and how its costs enter the policy's objective."""

    risk_coeff: float = 0.0625
    """lambda_r, weight of the risk cost in the advantage [1]; 0 leaves it out. The paper has 0.25 beside a raw one."""
    uncertainty_coeff: float = 0.25
    """lambda_u, weight of the uncertainty cost in the advantage [1]; 0 leaves it out. The paper has 1."""
    gamma: float = 0.9
    """gamma_c, discount of the collision per policy step [1]. Range: 0 to 1."""
    lmbda: float = 0.95
    """Lambda of the SR(lambda) targets [1]: 0 is one step, 1 is Monte-Carlo. Range: 0 to 1."""
    num_atoms: int = 50
    """N, atoms of the predicted distribution [1]."""
    risk_measure: RiskMeasureKind = "mean"
    """What of the predicted distribution the risk is: its mean (the paper), the mean of its upper tail (cvar), or its
    mean after Wang's shift of probability to that tail (wang)."""
    risk_level: float = 0.25
    """Level of the risk measure [1]: for cvar alpha, the tail's share, above 0 to 1, of which 1 is the mean; for wang
    beta, 0 or more, of which 0 is the mean. The mean has none."""
    uncertainty: UncertaintyKind = "total"
    """Which variance the uncertainty is: that of the predicted distribution (total, the paper), or the part of it that
    seeing all obstacles would remove (perceptual), for which two more estimators are trained."""
    risk_floor: float = 0.005
    """Smallest standard deviation that the risk cost is divided by [1]."""
    uncertainty_floor: float = 0.005
    """Smallest standard deviation that the uncertainty cost is divided by [1]."""
    cost_clip: float = 5.0
    """Bound on the magnitude of a normalised cost [1]."""
    cost_lmbda: float = 0.0
    """Lambda of an advantage estimate of the costs, which pays back later what was a cost at first [1]; 0 takes each
    step's own cost, as the paper does. Range: 0 to 1."""
    cost_baseline: Literal["mean", "state"] = "state"
    """What costs are compared with: their mean (the paper), or what a linear regression on the observation predicts."""
    advantage_scale: Literal["raw", "zscore"] = "zscore"
    """Scale of the advantage beside the costs: as it is (the paper), or brought to mean 0 and deviation 1 first."""
    normalise_sum: bool = True
    """Whether the advantage with its costs is brought to mean 0 and deviation 1 for the optimiser."""
    shuffle_uncertainty: bool = False
    """Whether the uncertainty cost is dealt out among a rollout's steps at random: a placebo for experiments."""
    costs_start_frames: int = 100_000
    """Frames for which the estimator is trained before its costs enter the advantage [1]."""
    lr: float = 5e-4
    """Learning rate of the estimator [1]."""
    max_grad_norm: float = 1.0
    """Norm that the estimator's gradient is clipped to [1]."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("gamma", "lmbda", "cost_lmbda"):
            require(0.0 <= getattr(self, name) <= 1.0, name, getattr(self, name), "0 to 1")
        for name in ("num_atoms", "risk_floor", "uncertainty_floor", "cost_clip", "lr", "max_grad_norm"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a positive number")
        for name in ("risk_coeff", "uncertainty_coeff", "costs_start_frames"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a number that is not negative")
        if self.risk_measure == "cvar":
            require(0.0 < self.risk_level <= 1.0, "risk_level", self.risk_level, "above 0 to 1 for cvar")
        if self.risk_measure == "wang":
            require(self.risk_level >= 0.0, "risk_level", self.risk_level, "a number that is not negative for wang")


@dataclass(frozen=True, kw_only=True)
class NetworkConfig:
    """Sizes of actor, critic and collision estimator."""

    actor_hidden_sizes: tuple[int, ...] = (256, 128, 64)
    """Sizes of the actor's hidden layers [1]."""
    critic_hidden_sizes: tuple[int, ...] = (256, 128, 64)
    """Sizes of the critic's hidden layers [1]."""
    collision_hidden_sizes: tuple[int, ...] = (256, 256, 256)
    """Sizes of the collision estimator's hidden layers [1]."""
    init_std: float = 0.6
    """Standard deviation of the normalised action at the start [1]."""
    min_std: float = 0.05
    """What the standard deviation of the normalised action stays above [1]."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in ("actor_hidden_sizes", "critic_hidden_sizes", "collision_hidden_sizes"):
            sizes = getattr(self, name)
            require(bool(sizes) and min(sizes, default=0) > 0, name, sizes, "one or more positive sizes")
        require(self.min_std > 0, "min_std", self.min_std, "a positive number")
        require(self.init_std > self.min_std, "init_std", self.init_std, f"a number larger than min_std {self.min_std}")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything that a training run is made of."""

    method: str = "cura-ppo"
    """Which preset the other values start from."""
    simulator: Simulator = "bullet"
    """Which simulator runs the worlds; ``env.simulator`` follows it."""
    num_envs: int = 64
    """Environments over all workers together [1]."""
    num_workers: int = 1
    """Processes that collect [1]; 1 collects in the learner's own process, unless the backend is ray."""
    backend: Backend = "process"
    """Where the workers run: on this machine, or on the nodes of a Ray cluster (of RAY_ADDRESS, or that this machine is
    part of), each on a processor of its own. A node that dies is left out, and the others share its environments."""
    total_frames: int = 2_000_000
    """Environment steps to train for [1], rounded up to whole rollouts."""
    seed: int = 0
    """Seed of scenarios, networks and noise [1]."""
    run_dir: Path = Path("runs/train")
    """Folder for checkpoints and logs."""
    perception: Perception = "map"
    """What the policy sees beside its vector: the map's code, nothing, or, for diagnosis, the true obstacles."""
    encoder: Path | None = None
    """Weights of the map's encoder, as ``pretrain-map`` writes them; none takes those that are shipped."""
    device: str = "cpu"
    """Device that learns, such as cpu or cuda. Where one process collects, the planar simulator's worlds are on it too,
    with LiDAR, map, encoder and policy; PyBullet's worlds, and those of several workers, are on the CPU."""
    learner_threads: int = 2
    """Threads of the learner on the CPU [1]; each worker has one."""
    logger: LoggerKind = "csv"
    """Where TorchRL's logger writes; progress.csv is written in any case."""
    checkpoint_minutes: float = 5.0
    """Time between two checkpoints [min]; 0 writes one after every update."""
    keep_checkpoints: int = 3
    """Newest checkpoints to keep [1]."""
    recent_episodes: int = 200
    """Episodes over which rates are reported while training [1]."""
    env: PushEnvConfig = field(default_factory=PushEnvConfig)
    """Task, robot, LiDAR, physics."""
    map: MapConfig = field(default_factory=MapConfig)
    """Confidence map."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Policy optimisation."""
    cura: CURAConfig = field(default_factory=CURAConfig)
    """Collision estimator and costs."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """Network sizes."""

    def __post_init__(self) -> None:
        require_fields(self)
        for name in (
            "num_envs",
            "num_workers",
            "total_frames",
            "learner_threads",
            "keep_checkpoints",
            "recent_episodes",
        ):
            require(getattr(self, name) > 0, name, getattr(self, name), "1 or more")
        require(
            self.num_envs % self.num_workers == 0,
            "num_envs",
            self.num_envs,
            f"a multiple of num_workers {self.num_workers}",
        )
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")
        require(
            self.checkpoint_minutes >= 0,
            "checkpoint_minutes",
            self.checkpoint_minutes,
            "a time that is not negative [min]",
        )
        if self.env.simulator == PushEnvConfig().simulator:
            object.__setattr__(self, "env", dataclasses.replace(self.env, simulator=self.simulator))
        require(
            self.env.simulator == self.simulator, "env.simulator", self.env.simulator, f"simulator {self.simulator!r}"
        )

    @property
    def env_device(self) -> str:
        """Device of environments and of the policy that acts in them."""
        is_here = self.num_workers == 1 and self.backend == "process"
        return self.device if is_here and self.simulator == "planar" else "cpu"

    @property
    def frames_per_batch(self) -> int:
        """Environment steps of one rollout over all workers [1]."""
        return self.num_envs * self.ppo.rollout_steps

    def to_json(self) -> dict[str, Any]:
        """Return the configuration as JSON-compatible values.

        Returns:
            Nested dictionaries and lists; :meth:`from_json` is the inverse.

        Examples:
            >>> TrainConfig.from_json(TrainConfig(seed=3).to_json()) == TrainConfig(seed=3)
            True
        """
        return encode(self)

    @classmethod
    def from_json(cls, data: object) -> TrainConfig:
        """Build a configuration from JSON values, strictly.

        Args:
            data: What :meth:`to_json` returned; keys that are missing take their default.

        Returns:
            The configuration.

        Raises:
            ValueError: If a key is unknown, or a value has the wrong type or is not acceptable; one line.

        Examples:
            >>> TrainConfig.from_json({"ppo": {"lr": "fast"}})
            Traceback (most recent call last):
            ValueError: ppo.lr is 'fast'; accepted: a finite number
        """  # noqa: DOC502 - raised by what this calls
        return decode(cls, data)

    def replace(self, **changes: Any) -> TrainConfig:
        """Return a copy with some fields changed.

        Args:
            **changes: New values by field.

        Returns:
            The changed configuration.

        Examples:
            >>> TrainConfig().replace(seed=5).seed
            5
        """
        if "simulator" in changes and "env" not in changes:
            changes["env"] = dataclasses.replace(self.env, simulator=changes["simulator"])
        return dataclasses.replace(self, **changes)


@dataclass(frozen=True, kw_only=True)
class EvaluateConfig:
    """Who plays which of the frozen evaluation scenarios. Episode i of a seed is the same scene for everyone."""

    checkpoint: Path | None = None
    """Trained policy: a run's or a checkpoint's folder."""
    method: str | None = None
    """Trained policy: a method whose weights are shipped."""
    policy: ScriptedKind | None = None
    """Policy without learning: a pusher that sees no obstacles, one that sees them all, or random actions."""
    robot: RobotName = RobotConfig.model
    """Which robot a policy without learning moves; a trained one has its own."""
    scenario: ScenarioKind = "uniform"
    """Where obstacles appear."""
    object_size: float = 0.5
    """Edge of the pushed cube [m]; the paper's are 0.5, 0.75 and 1.0."""
    max_obstacles: int = 6
    """Most obstacles K in an episode; the count is uniform in 0..K. Range: 0 to 6."""
    episodes: int = 200
    """Episodes to play [1]."""
    seed: int = 0
    """Seed of the scenarios [1]."""
    simulator: Simulator = "bullet"
    """Which simulator runs the worlds."""
    num_workers: int = 1
    """Processes that play [1]; results do not depend on it."""
    chunk: int = 20
    """Episodes that a process plays side by side [1]; results do not depend on it."""

    def __post_init__(self) -> None:
        require_fields(self)
        given = [value for value in (self.checkpoint, self.method, self.policy) if value is not None]
        require(
            len(given) == 1, "policy to evaluate", [str(value) for value in given], "one of checkpoint, method, policy"
        )
        is_own = self.policy is not None or self.robot == RobotConfig.model
        require(is_own, "robot", self.robot, "nothing beside checkpoint or method, whose robot is their own")
        require(0.3 <= self.object_size <= 1.2, "object_size", self.object_size, "0.3 to 1.2 m")
        require(0 <= self.max_obstacles <= 6, "max_obstacles", self.max_obstacles, "0 to 6")
        for name in ("episodes", "num_workers", "chunk"):
            require(getattr(self, name) > 0, name, getattr(self, name), "1 or more")
        require(0 <= self.seed < 2**31, "seed", self.seed, "0 to 2147483647")

    @property
    def source(self) -> str | Path:
        """Trained policy by name or path; there is none for a policy without learning."""
        return self.checkpoint or self.method or ""
