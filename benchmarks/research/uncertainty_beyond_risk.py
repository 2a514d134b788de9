"""Is uncertainty more than risk? What the estimator's risk R leaves of its uncertainty U, on-policy and off-policy.

The same estimator watches different policies play. Of U given R it keeps what a regression on other
episodes does not explain; the rest is compared with the area ahead of the object that has not been seen:
python benchmarks/research/uncertainty_beyond_risk.py --output runs/research/uncertainty_beyond_risk.json
"""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from matplotlib.figure import Figure
from recording import Policy, estimator_watch, normalised_costs, parser, record, save, task
from scipy.stats import rankdata, spearmanr

from cura_torchrl import keys
from cura_torchrl.envs.robots.scripted import ScriptedPusher
from cura_torchrl.envs.transforms import ConfidenceMap, EncodeMap
from cura_torchrl.trainers.build import load_encoder
from cura_torchrl.trainers.evaluation.statistics import bootstrap_interval, correlation
from cura_torchrl.trainers.loaded_policy import load_policy
from cura_torchrl.trainers.threads import one_thread

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from tensordict import TensorDictBase
    from torchrl.envs import EnvBase

    from cura_torchrl.trainers.loaded_policy import LoadedPolicy

NEIGHBOURS = 24
"""Samples with the nearest risks that the regression is the mean of [1]."""
BINS = 50
"""Bins of equally many risks, within which the uncertainties are ranked [1]."""
EVERY = 2
"""Steps between two samples, which are alike otherwise [1]."""
BEHAVIOURS: dict[str, tuple[str, dict[str, Any]]] = {
    "on-policy": ("own", {}),
    "adversarial": ("own", {"kind": "adversarial"}),
    "1.2 m object": ("own", {"object_edges": (1.2,)}),
    "push policy": ("push", {}),
    "scripted": ("scripted", {}),
    "random": ("random", {}),
}
"""Who plays, and what differs from the scenario of training; objects of 1.2 m were never seen there."""


def other_policy(env: EnvBase, name: str) -> Policy:
    """Return a trained policy that reads the code of its own map, which it adds to the environment."""
    other = load_policy(name)
    lidar = other.config.env.lidar
    window, code = f"{name}_map", f"{name}_latent"
    env.append_transform(
        ConfidenceMap(other.config.map, num_rays=lidar.num_rays, max_range=lidar.max_range, out_key=window)
    )
    env.append_transform(EncodeMap(load_encoder(other.config.encoder), in_key=window, out_key=code))

    def play(state: TensorDictBase) -> TensorDictBase:
        seen = state.select(keys.OBSERVATION).set(keys.LATENT, state[code])
        return state.set(keys.ACTION, other.policy(seen)[keys.ACTION])

    return play


def observe(loaded: LoadedPolicy, who: str, scenario: dict[str, Any], options: Any) -> dict[str, NDArray[Any]]:
    """Return what :func:`recording.record` notes while someone plays, with the costs of the loaded estimator."""
    torch.manual_seed(options.seed)
    played = task(loaded, max_obstacles=options.max_obstacles, **scenario)
    made = loaded.make_env(options.envs, task=played, simulator="planar", keep_map=True, seed=options.seed)
    with one_thread(), closing(made) as env:
        makers = {
            "own": lambda: loaded.policy,
            "push": lambda: other_policy(env, "push"),
            "scripted": lambda: ScriptedPusher(loaded.config.env.robot),
            "random": lambda: env.rand_action,
        }
        steps = options.rollouts * loaded.config.ppo.rollout_steps
        notes = record(env, makers[who](), steps, estimator_watch(loaded, env))
    costs = normalised_costs(loaded, notes)
    return {**notes, "risk_cost": costs["raw_risk"], "uncertainty_cost": costs["raw_uncertainty"]}


def left_over(x: NDArray[Any], y: NDArray[Any], half: NDArray[np.bool_]) -> float:
    """Return 1 - R^2 of y given x: means over the nearest x among one half of the episodes, for the other half."""
    residual = np.zeros_like(y, dtype=np.float64)
    for fit, test in ((half, ~half), (~half, half)):
        order = np.argsort(x[fit])
        total = np.concatenate([[0.0], np.cumsum(y[fit][order], dtype=np.float64)])
        place = np.searchsorted(x[fit][order], x[test])
        first, last = (place - NEIGHBOURS // 2).clip(0), (place + NEIGHBOURS // 2 + 1).clip(None, len(order))
        residual[test] = y[test] - (total[last] - total[first]) / (last - first)
    return float(np.square(residual).mean() / y.var())


def rank_given(x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.float64]:
    """Return the rank of y among the samples in the same bin of x, from 0 to 1."""
    number = np.searchsorted(np.quantile(x, np.linspace(0, 1, BINS + 1)[1:-1]), x)
    rank = np.zeros(len(x))
    for index in np.unique(number):
        inside = number == index
        rank[inside] = rankdata(y[inside]) / inside.sum()
    return rank


def measure(notes: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Return correlations and shares, each with its interval over episodes."""
    names = ("risk", "uncertainty", "unseen", "risk_cost", "uncertainty_cost", "episode", "terminated")
    data = {name: notes[name][:, ::EVERY].ravel() for name in names}
    data = {name: values[~data["terminated"]] for name, values in data.items()}
    episodes, owner = np.unique(data["episode"], return_inverse=True)
    members = np.split(np.argsort(owner, kind="stable"), np.cumsum(np.bincount(owner))[:-1])
    half = np.random.default_rng(0).random(len(episodes)) < 0.5

    def statistics(pick: NDArray[np.int64]) -> NDArray[np.float64]:
        index = np.concatenate([members[episode] for episode in pick])
        risk, uncertainty, unseen, risk_cost, uncertainty_cost = (data[name][index] for name in names[:5])
        side = half[owner[index]]
        rank, possible = rankdata(uncertainty), (risk * (1.0 - risk)).clip(0.0)
        return np.array([
            correlation(risk, uncertainty),
            spearmanr(risk, uncertainty)[0],
            left_over(risk, uncertainty, side),
            left_over(risk, rank, side),
            left_over(risk, uncertainty.clip(None, possible), side),
            (uncertainty > possible).mean(),
            correlation(risk_cost, uncertainty_cost),
            left_over(risk_cost, uncertainty_cost, side),
            spearmanr(risk, unseen)[0],
            spearmanr(rank_given(risk, uncertainty), unseen)[0],
        ])  # fmt: skip

    found = statistics(np.arange(len(episodes)))
    low, high = bootstrap_interval(statistics, len(episodes), draws=200)
    rows = zip(STATISTICS, found, low, high, strict=True)
    return {
        "frames": int(notes["risk"].size),
        "samples": len(owner),
        "episodes": len(episodes),
        "collisions": int(notes["terminated"].sum()),
        "medians": {name: float(np.median(data[name])) for name in names[:3]},
        **{name: [float(value), below, above] for name, value, below, above in rows},
    }


STATISTICS = {
    "pearson": "correlation of R and U",
    "spearman": "rank correlation of R and U",
    "left": "share of var(U) that R leaves",
    "left_of_rank": "share of var(rank of U) that R leaves",
    "left_of_possible": "share of var(U) that R leaves, U cut to R (1 - R)",
    "impossible": "share of states with U above R (1 - R), the most that C in [0, 1] allows",
    "cost_pearson": "correlation of the costs",
    "cost_left": "share of var(C^U) that C^R leaves",
    "risk_unseen": "rank correlation of R and the unseen area",
    "rest_unseen": "rank correlation of U at equal R and the unseen area",
}


def draw(notes: dict[str, NDArray[Any]], results: dict[str, Any]) -> Figure:
    """Return the figure: risk against uncertainty on-policy, and the shares by who plays."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    scatter, *bars = figure.subplots(1, 3)
    cloud = scatter.hexbin(
        notes["risk"].ravel().clip(1e-3), notes["uncertainty"].ravel().clip(1e-6), gridsize=50,
        xscale="log", yscale="log", bins="log", mincnt=1,
    )  # fmt: skip
    figure.colorbar(cloud, ax=scatter, label="frames [1]")
    risk = np.linspace(1e-3, 1.0, 500)
    scatter.plot(risk, risk * (1 - risk) + 1e-9, color="C3", linewidth=1, label="R (1 - R)")
    scatter.set_ylim(bottom=1e-6)
    scatter.legend(fontsize=7)
    scatter.set_xlabel("risk R [1]")
    scatter.set_ylabel("uncertainty U [1]")
    scatter.set_title("on-policy", loc="left", fontsize=9)
    place = np.arange(len(results))
    for axis, shown in zip(
        bars, (("left", "left_of_possible", "left_of_rank", "cost_left"), ("risk_unseen", "rest_unseen")), strict=True
    ):
        for index, name in enumerate(shown):
            middle, low, high = np.array([result[name] for result in results.values()]).T
            error = np.abs(np.stack([middle - low, high - middle]))
            spot = place + 0.8 * (index + 0.5) / len(shown) - 0.4
            axis.bar(spot, middle, 0.8 / len(shown), yerr=error, label=STATISTICS[name], error_kw={"elinewidth": 1})
        axis.set_xticks(place, results, rotation=30, ha="right", fontsize=8)
        axis.set_ylabel("share [1]" if shown[0] == "left" else "rank correlation [1]")
        axis.legend(fontsize=6)
        axis.set_ylim(top=1.5 * axis.get_ylim()[1])
        axis.grid(axis="y", alpha=0.3)
    return figure


def main() -> None:
    """Parse the command line, play, measure, write."""
    command = parser(__doc__, "runs/research/uncertainty_beyond_risk.json")
    command.add_argument("--rollouts", type=int, default=3, help="rollouts of the trained length to record of each")
    options = command.parse_args()
    loaded = load_policy(options.checkpoint)
    played = {name: observe(loaded, who, scenario, options) for name, (who, scenario) in BEHAVIOURS.items()}
    results = {name: measure(notes) for name, notes in played.items()}
    facts = {
        "checkpoint": loaded.config.method, "trained_frames": loaded.record["frames"], "seed": options.seed,
        "max_obstacles": options.max_obstacles,
    }  # fmt: skip
    save({**facts, "behaviours": results}, draw(played["on-policy"], results), options.output)


if __name__ == "__main__":
    main()
