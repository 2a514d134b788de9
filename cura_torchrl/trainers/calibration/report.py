"""The calibration of the collision estimator as Markdown tables."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from cura_torchrl.trainers.calibration.config import CONDITIONS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

_PREDICTION = (
    ("mean_possibility", "mean C"),
    ("mean_risk", "mean R"),
    ("crps", "CRPS"),
    ("crps_skill", "CRPS skill"),
    ("pooled_energy_distance", "pooled energy distance"),
    ("width_80", "width of the 80 % interval"),
)
_COLLISION = (
    ("collision_rate", "collide within 2 s"),
    ("brier", "Brier"),
    ("brier_skill", "Brier skill"),
    ("calibration_error", "calibration error"),
    ("auroc", "AUROC of R"),
    ("pearson_risk_uncertainty", "Pearson R, U"),
    ("spearman_risk_uncertainty", "Spearman R, U"),
)
_LOOKING = (
    ("seen_ahead_m2", "seen ahead [m²]"),
    ("unseen_ahead", "unseen share ahead"),
    ("first_seen_s", "until first seen [s]"),
    ("first_seen_m", "object's distance then [m]"),
    ("beside_m", "base beside the way [m]"),
    ("object_speed", "object's speed [m/s]"),
)
_TRUTH = (
    ("mean_pearson", "Pearson, mean"),
    ("mean_spearman", "Spearman, mean"),
    ("mean_bias", "bias of the mean"),
    ("mean_rmse", "RMSE of the mean"),
    ("variance_pearson", "Pearson, variance"),
    ("variance_spearman", "Spearman, variance"),
    ("variance_bias", "bias of the variance"),
    ("variance_rmse", "RMSE of the variance"),
    ("share_states", "var(C) between states"),
    ("share_hidden", "… between hidden layouts"),
    ("share_future", "… between futures of a layout"),
    ("mean_error", "error of the true mean"),
    ("hidden", "hidden obstacles, real"),
    ("hidden_drawn", "hidden obstacles, drawn"),
)


def as_markdown(result: dict[str, Any]) -> str:
    """Return the tables.

    Args:
        result: Content of ``calibration.json``.

    Returns:
        Markdown.
    """
    config, methods = result["config"], result["methods"]
    facts = (
        f"`{result['command']}`; commit `{result['commit']}`; seed {config['seed']}, {config['episodes']} episodes"
        f" each, simulator {config['simulator']}. In brackets: 95 % bootstrap interval over episodes."
    )
    parts = ["# Calibration of the collision estimator", facts]
    for title, columns, take in (
        ("Predicted distribution against what came of it", _PREDICTION, lambda found: found["numbers"]),
        ("Collision within 2 s", _COLLISION, lambda found: found["numbers"]),
        ("Looking", _LOOKING, lambda found: found["looking"]),
    ):
        parts += [f"## {title}", _by_condition(methods, columns, take)]
    parts += ["## Central intervals: promised and came out", _coverage(methods)]
    if any("truth" in found for found in methods.values()):
        parts += [f"## Against {config['futures']} simulated futures of a state", _truth(methods)]
    return "\n\n".join(parts) + "\n"


def _by_condition(
    methods: dict[str, Any], columns: Sequence[tuple[str, str]], take: Callable[[Any], dict[str, list[float]]]
) -> str:
    rows = [
        [method, condition, str(found["states"]), *(_interval(take(found)[name]) for name, _ in columns)]
        for method, parts in methods.items()
        for condition, found in parts.items()
        if condition in CONDITIONS
    ]
    return _table(["Method", "Condition", "States", *(label for _, label in columns)], rows)


def _coverage(methods: dict[str, Any]) -> str:
    rows, levels = [], []
    for method, parts in methods.items():
        for condition in (name for name in CONDITIONS if name in parts):
            shown = parts[condition]["coverage"][::2]
            levels = [f"{entry['level']:.0%}" for entry in shown]
            cells = [f"{entry['promised']:.2f}: {_interval(entry['came_out'], 2)}" for entry in shown]
            rows.append([method, condition, str(parts[condition]["states_at_stake"]), *cells])
    return _table(["Method", "Condition", "States at stake", *levels], rows)


def _truth(methods: dict[str, Any]) -> str:
    groups = [
        (method, name, found["truth"][name]) for method, found in methods.items() for name in found.get("truth", {})
    ]
    heads = [f"{method}, {name.replace('_', ' ')} ({found['states']})" for method, name, found in groups]
    rows = [[label, *(_interval(found[name]) for _, _, found in groups)] for name, label in _TRUTH]
    return _table(["", *heads], rows)


def _interval(values: Sequence[float], digits: int = 3) -> str:
    """Return value and bounds, two digits or more of what is small."""
    middle, low, high = values
    if not math.isfinite(middle):
        return "n/a"
    places = max(digits, 1 - math.floor(math.log10(abs(middle)))) if 0 < abs(middle) < 1 else digits
    places = min(places, 5)
    bounds = f" ({low:.{places}f} to {high:.{places}f})" if math.isfinite(low) else ""
    return f"{middle:.{places}f}{bounds}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
