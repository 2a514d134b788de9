"""What a configuration means: environment, networks, objective and collector."""

from __future__ import annotations

import dataclasses
import functools
import signal
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import Compose, TransformedEnv

from cura_torchrl import keys
from cura_torchrl.envs.mdp.observations import observation_size
from cura_torchrl.envs.push import PushEnv
from cura_torchrl.envs.robots.robot import ROBOT_MODELS
from cura_torchrl.envs.transforms import ConfidenceMap, EncodeMap
from cura_torchrl.envs.transforms.obstacle_code import CODE_SIZE, ObstacleCode
from cura_torchrl.modules import (
    DistributionalCollisionEstimator,
    MapVAE,
    ObservationNorm,
    make_actor,
    make_critic,
    make_risk_measure,
)
from cura_torchrl.objectives import CURAAdvantage, CURALoss, PerceptualObjective
from cura_torchrl.trainers.errors import RunError, UnavailableError
from cura_torchrl.trainers.training.local_collector import local_collector
from cura_torchrl.trainers.training.ray_backend import RayRollouts, ray_rollouts

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from tensordict.nn import ProbabilisticTensorDictSequential
    from torchrl.collectors import BaseCollector
    from torchrl.envs import EnvBase

    from cura_torchrl.trainers.config import TrainConfig

LATENT_SIZE = 32
"""Length of the map's code z [1]."""


class Networks(nn.Module):
    """Actor, critic and collision estimator with the normalisation of observations that they share.

    With ``CURAConfig.uncertainty = "perceptual"`` there are a privileged and a perceptual estimator beside them, see
    :class:`~cura_torchrl.objectives.PerceptualObjective`; else these are None.

    Args:
        config: Sizes.
    """

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        sizes, action_size = config.network, ROBOT_MODELS[config.env.robot.model].action_size
        inputs = observation_size(action_size) + LATENT_SIZE
        self.observation_norm = ObservationNorm(observation_size(action_size))
        self.actor = make_actor(
            inputs,
            action_size,
            hidden_sizes=sizes.actor_hidden_sizes,
            init_std=sizes.init_std,
            min_std=sizes.min_std,
            observation_norm=self.observation_norm,
        )
        self.critic = make_critic(
            inputs,
            hidden_sizes=sizes.critic_hidden_sizes,
            observation_norm=self.observation_norm,
            scale=config.ppo.value_scale,
        )
        self.collision_estimator = DistributionalCollisionEstimator(
            inputs,
            num_atoms=config.cura.num_atoms,
            hidden_sizes=sizes.collision_hidden_sizes,
            observation_norm=self.observation_norm,
            risk_measure=make_risk_measure(config.cura.risk_measure, config.cura.risk_level),
        )
        for network in (self.actor, self.critic, self.collision_estimator):
            _ignore_latent_(network)
        self.privileged_estimator: DistributionalCollisionEstimator | None = None
        self.perceptual_estimator: DistributionalCollisionEstimator | None = None
        if config.cura.uncertainty == "perceptual":
            # After the others, which so start from the same random numbers with and without them.
            self._add_perceptual(config)

    def _add_perceptual(self, config: TrainConfig) -> None:
        seen = (keys.OBSERVATION, keys.LATENT)
        inputs = observation_size(ROBOT_MODELS[config.env.robot.model].action_size) + LATENT_SIZE
        make = functools.partial(
            DistributionalCollisionEstimator,
            num_atoms=config.cura.num_atoms,
            hidden_sizes=config.network.collision_hidden_sizes,
            observation_norm=self.observation_norm,
        )
        self.privileged_estimator = make(
            inputs + CODE_SIZE,
            # What the policy sees is part of the state: how it will act depends on it.
            in_keys=(*seen, keys.OBSTACLE_CODE),
            out_keys=(keys.PRIVILEGED_ATOMS, keys.PRIVILEGED_RISK, "privileged_uncertainty"),
        )
        self.perceptual_estimator = make(
            inputs, in_keys=seen, out_keys=(keys.PERCEPTUAL_ATOMS, "perceptual_risk", keys.UNCERTAINTY)
        )

    @property
    def collision_network(self) -> TensorDictModule:
        """What writes atoms, risk and the uncertainty that the costs and logs read."""
        if self.perceptual_estimator is None:
            return self.collision_estimator
        # The second overwrites the first one's uncertainty.
        return TensorDictSequential(self.collision_estimator, self.perceptual_estimator)


def _ignore_latent_(network: nn.Module) -> None:
    """Let a network start without regard to the map's code: what was learned without a map stays with one."""
    first = next(layer for layer in network.modules() if isinstance(layer, nn.Linear))
    with torch.no_grad():
        first.weight[:, -LATENT_SIZE:] = 0.0


def build_advantage(config: TrainConfig, networks: Networks) -> CURAAdvantage:
    """Return the estimator of advantages and targets.

    Args:
        config: Coefficients.
        networks: Critic and collision estimator.

    Returns:
        Module that is applied to a whole rollout.
    """
    ppo, cura = config.ppo, config.cura
    return CURAAdvantage(
        networks.critic,
        networks.collision_network,
        gamma=ppo.gamma,
        lmbda=ppo.lmbda,
        collision_gamma=cura.gamma,
        collision_lmbda=cura.lmbda,
        risk_coeff=cura.risk_coeff,
        uncertainty_coeff=cura.uncertainty_coeff,
        risk_floor=cura.risk_floor,
        uncertainty_floor=cura.uncertainty_floor,
        cost_clip=cura.cost_clip,
        cost_lmbda=cura.cost_lmbda,
        cost_baseline=cura.cost_baseline,
        advantage_scale=cura.advantage_scale,
        normalise_sum=cura.normalise_sum,
        shuffle_uncertainty=cura.shuffle_uncertainty,
        seed=config.seed,
    )


def build_loss(config: TrainConfig, networks: Networks) -> CURALoss:
    """Return the loss of actor, critic and collision estimator.

    Args:
        config: Coefficients.
        networks: Networks, on their device.

    Returns:
        Module that is applied to minibatches.
    """
    return CURALoss(
        networks.actor,
        networks.critic,
        networks.collision_estimator,
        clip_epsilon=config.ppo.clip_epsilon,
        entropy_coeff=config.ppo.entropy_coeff,
        critic_coeff=config.ppo.critic_coeff / config.ppo.value_scale**2,
        loss_critic_type="l2",
        normalize_advantage=False,
    )


def build_perceptual(config: TrainConfig, networks: Networks) -> PerceptualObjective | None:
    """Return what trains the estimators of the perceptual uncertainty.

    Args:
        config: Coefficients.
        networks: Networks, on their device.

    Returns:
        Targets and losses; None where the networks have no such estimators.
    """
    if networks.privileged_estimator is None or networks.perceptual_estimator is None:
        return None
    return PerceptualObjective(
        networks.privileged_estimator,
        networks.perceptual_estimator,
        gamma=config.cura.gamma,
        lmbda=config.cura.lmbda,
        seed=config.seed,
    )


def load_encoder(path: Path | None) -> MapVAE:
    """Return the frozen encoder of maps.

    Args:
        path: Weights; None takes those that are shipped.

    Returns:
        The encoder.

    Raises:
        UnavailableError: If there are no weights, or they are damaged.
    """
    weights = SHIPPED_ENCODER if path is None else path
    accepted = "accepted: a file that `cura-torchrl pretrain-map` has written"
    if not weights.exists():
        msg = f"encoder weights are missing at {weights}; {accepted}"
        raise UnavailableError(msg)
    try:
        return MapVAE.load(weights)
    except Exception as error:  # noqa: BLE001 - what torch.load raises on a damaged file has no narrower base
        msg = f"encoder weights at {weights} are damaged ({type(error).__name__}); {accepted}"
        raise UnavailableError(msg) from None


def fitting_encoder(config: TrainConfig) -> MapVAE:
    """Return the frozen encoder of a configuration, which takes its maps and writes the code its networks read.

    Args:
        config: Map and path of the weights.

    Returns:
        The encoder.

    Raises:
        RunError: If it takes other maps, or its code has another length.
        UnavailableError: If there are no weights, or they are damaged.
    """  # noqa: DOC502 - raised by what this calls
    encoder = load_encoder(config.encoder)
    channels, window = (encoder.shape[name] for name in ("channels", "window"))
    expected = config.map.num_channels
    if (channels, window) != (expected, config.map.window):
        given = f"map.channels is {config.map.channels!r} and map.window {config.map.window}"
        takes = f"{channels} x {window} x {window} that the encoder {config.encoder or SHIPPED_ENCODER} takes"
        flags = "`cura-torchrl pretrain-map --map.channels ... --map.window ...`"
        msg = f"{given}, maps of {expected} x {config.map.window} x {config.map.window}; accepted: {takes}, or {flags}"
        raise RunError(f"{msg} and --encoder with what it writes")
    if encoder.latent_size != LATENT_SIZE:
        msg = f"code of the encoder {config.encoder} has {encoder.latent_size} numbers; accepted: {LATENT_SIZE}"
        raise RunError(f"{msg}, as of `cura-torchrl pretrain-map --latent-size {LATENT_SIZE}`")
    return encoder


def make_env(
    config: TrainConfig,
    num_envs: int,
    *,
    keep_map: bool = False,
    add_obstacle_code: bool = False,
    dtype: torch.dtype = torch.float32,
    **options: Any,
) -> TransformedEnv:
    """Return the environment with what the policy sees of it.

    Args:
        config: Environment, map and perception.
        num_envs: Number of worlds N.
        keep_map: Whether the window of the map stays in the tensordict under ``confidence_map``.
        add_obstacle_code: Whether the true obstacles are emitted as ``obstacle_code``, for a privileged estimator.
        dtype: Precision in which maps are encoded.
        **options: Keyword arguments of :class:`~cura_torchrl.envs.push.PushEnv`.

    Returns:
        Environment that emits ``observation`` and ``latent`` beside its own keys.
    """
    env_config, lidar = config.env, config.env.lidar
    if config.perception == "privileged" or add_obstacle_code:
        env_config = dataclasses.replace(env_config, task=dataclasses.replace(env_config.task, privileged=True))
    transforms: list[nn.Module] = []
    if config.perception == "map" or keep_map:
        transforms.append(ConfidenceMap(config.map, num_rays=lidar.num_rays, max_range=lidar.max_range))
    if config.perception == "map":
        transforms.append(EncodeMap(fitting_encoder(config).to(dtype), del_keys=not keep_map))
    else:
        transforms.append(ObstacleCode(LATENT_SIZE, is_blind=config.perception == "none"))
    if add_obstacle_code:
        transforms.append(ObstacleCode(CODE_SIZE, is_blind=False, out_key=keys.OBSTACLE_CODE))
    options.setdefault("seed", config.seed)
    env = PushEnv(num_envs, env_config, **options)
    return TransformedEnv(env, Compose(*transforms).to(env.device))


def make_worker_env(config: TrainConfig, num_envs: int, *, worker: int, frames_done: int) -> EnvBase:
    """Return the environment of one process that collects.

    Args:
        config: The run.
        num_envs: Number of worlds of this process.
        worker: Index of the process.
        frames_done: Environment steps so far, over all processes.

    Returns:
        The environment, which plays its own share of the scenarios.
    """
    if config.num_workers > 1 or config.backend == "ray":
        # Runs in the worker: Ctrl-C is for the learner, and each worker draws its own exploration noise.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        torch.set_num_threads(1)
        torch.manual_seed(config.seed + 7919 * (worker + 1) + frames_done)
    return make_env(
        config,
        num_envs,
        device=None if config.env_device == "cpu" else config.env_device,
        # An episode lasts a step at least: scenarios from this index on have not been played before a resume.
        first_episode=frames_done + worker * num_envs,
        episode_stride=config.num_envs,
        frames_done=frames_done,
        frames_per_step=config.num_envs,
        add_obstacle_code=config.cura.uncertainty == "perceptual",
    )


@contextmanager
def build_collector(
    config: TrainConfig,
    policy: ProbabilisticTensorDictSequential,
    *,
    frames_done: int,
    without: Collection[str] = (),
) -> Iterator[BaseCollector | RayRollouts]:
    """Collect rollouts in this process, in several, or on the nodes of a cluster, and stop them in the end.

    Args:
        config: Number of environments and processes.
        policy: Policy on the environments' device; processes share its memory.
        frames_done: Environment steps so far.
        without: Ray's identifiers of nodes that have died.

    Yields:
        Collector whose batches have the shape ``[num_envs, rollout_steps]``.
    """
    make_env = functools.partial(make_worker_env, config, frames_done=frames_done)
    share = config.num_envs // config.num_workers
    factories = [functools.partial(make_env, share, worker=worker) for worker in range(config.num_workers)]
    if config.perception == "map":
        fitting_encoder(config)  # what is wrong with it is told here, and not by each worker
    if config.backend == "ray":
        with ray_rollouts(config, make_env, policy, without=without) as rollouts:
            yield rollouts
        return
    with local_collector(factories, policy, config.frames_per_batch) as collector:
        # TorchRL takes a thread from the learner for every worker; they never run at the same time here.
        torch.set_num_threads(config.learner_threads)
        yield collector


SHIPPED_ENCODER = Path(__file__).parents[1] / "modules" / "weights" / "map_vae.pt"
"""Weights of the encoder that come with the package."""
