"""The table of success rates: numbers from outcomes, and Markdown, CSV and LaTeX from the numbers."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cura_torchrl.trainers.evaluate import summarise
from cura_torchrl.trainers.methods import PRESETS
from cura_torchrl.trainers.outcomes import SHIPPED
from cura_torchrl.trainers.paper_table import PAPER_CELLS, paper_success
from cura_torchrl.trainers.statistics import (
    bootstrap_rates,
    interquartile_mean,
    mcnemar,
    paired_difference,
    share_recovered,
    wilson_interval,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from cura_torchrl.trainers.evaluate import Episode
    from cura_torchrl.trainers.outcomes import PolicyRecord

    Played = Mapping[str, Mapping[str, Sequence[Sequence[Episode]]]]

BASELINE = "push"
"""Whom the others are compared with."""
UNOCCLUDED = "push-no-occlusion"
"""Who plays without the loss by occlusion."""

_NAN = (math.nan, math.nan, math.nan)
_LATEX = str.maketrans({
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
})  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Result:
    """One method in one cell, or in all of them. Rates are means over training seeds; what is not known is NaN."""

    method: str
    """Name of the method."""
    cell: str
    """Name of the cell, or "all"."""
    seeds: int
    """Training seeds [1]."""
    scenes: int
    """Scenes that each of them played [1]."""
    success: float
    """Goal reached within 0.5 m before any collision [1]."""
    low: float
    """Lower bound of the 95 % interval [1]: Wilson's of the success; with several seeds, the IQM's by bootstrap."""
    high: float
    """Upper bound of it [1]."""
    iqm: float
    """Interquartile mean of the success over training seeds, and cells [1]; NaN with one seed."""
    paper: float
    """Success that the paper prints [1]."""
    success_025: float
    """Success within 0.25 m [1]."""
    success_010_10deg: float
    """Success within 0.10 m and 10 degrees [1]."""
    collisions: float
    """Episodes that ended in a collision [1]."""
    hit_base: float
    """Those in which the base touched an obstacle [1]."""
    hit_arm: float
    """Those in which the arm did [1]."""
    hit_object: float
    """Those in which the object did [1]."""
    timeouts: float
    """Episodes that ended by time-out [1]."""
    tipped: float
    """Episodes in which the object tipped over [1]."""
    difference: float
    """Success less that of the baseline, on the same scenes [1]."""
    difference_low: float
    """Lower bound of its 95 % interval [1]: Newcombe's; with several seeds, by bootstrap."""
    difference_high: float
    """Upper bound of it [1]."""
    mcnemar_p: float
    """McNemar's exact p of the difference [1]; with several seeds NaN, for their pairs are not independent."""
    share: float
    """Share of the loss by occlusion that is recovered [1]."""
    share_low: float
    """Lower bound of its 95 % bootstrap interval [1]."""
    share_high: float
    """Upper bound of it [1]."""


def compare(played: Played) -> list[Result]:
    """Return the numbers of the table.

    Args:
        played: For each method and cell, for each training seed, how the scenes were played, in the same order.

    Returns:
        A result for each method and cell, and, with several cells, for each method over all.
    """
    cells = list(next(iter(played.values())))
    groups = {cell: [cell] for cell in cells} | ({"all": cells} if len(cells) > 1 else {})
    return [_result(played, method, name, group) for method in played for name, group in groups.items()]


def _result(played: Played, method: str, name: str, group: list[str]) -> Result:
    runs = [run for cell in group for run in played[method][cell]]
    episodes = [episode for run in runs for episode in run]
    counts = summarise(episodes)
    is_printed = name != "all" or set(group) == set(PAPER_CELLS)
    printed = paper_success(method, name) if is_printed else None
    count, seeds = counts["episodes"], len(played[method][group[0]])
    hits = {f"hit_{name}": number / count for name, number in counts["collisions_by"].items()}
    iqm, low, high = _interval([_trials(played[method][cell]) for cell in group])
    difference, p = _difference(played, method, group)
    share = _share(played, method, group)
    return Result(
        method=method,
        cell=name,
        seeds=seeds,
        scenes=count // seeds,
        success=counts["success_rate"],
        low=low,
        high=high,
        iqm=iqm,
        paper=math.nan if printed is None else printed,
        success_025=counts["success_rate_025"],
        success_010_10deg=counts["success_rate_010_10deg"],
        collisions=counts["collisions"] / count,
        **hits,
        timeouts=counts["timeouts"] / count,
        tipped=counts["tipped"] / count,
        **dict(zip(("difference", "difference_low", "difference_high"), difference, strict=True)),
        mcnemar_p=p,
        **dict(zip(("share", "share_low", "share_high"), share, strict=True)),
    )


def _trials(runs: Sequence[Sequence[Episode]]) -> NDArray[np.bool_]:
    """Return the successes, shape ``[S, M]``: S training seeds, M scenes."""
    return np.array([[episode.success[0] for episode in run] for run in runs], dtype=bool)


def _interval(trials: list[NDArray[np.bool_]]) -> tuple[float, float, float]:
    """Return the interquartile mean, NaN with one seed, and the interval of the success."""
    if len(trials[0]) == 1:
        joined = np.concatenate(trials, axis=1)
        return math.nan, *wilson_interval(int(joined.sum()), joined.size)
    (drawn,) = bootstrap_rates([[cell] for cell in trials])
    low, high = np.quantile(interquartile_mean(drawn.reshape(len(drawn), -1)), (0.025, 0.975))
    middle = interquartile_mean(np.concatenate([cell.mean(axis=1) for cell in trials]))
    return float(middle), float(low), float(high)


def _difference(played: Played, method: str, group: list[str]) -> tuple[tuple[float, float, float], float]:
    """Return the difference from the baseline with its interval, and McNemar's p."""
    if method == BASELINE or BASELINE not in played:
        return _NAN, math.nan
    pairs = [[_trials(played[who][cell]) for who in (BASELINE, method)] for cell in group]
    if len(pairs[0][0]) == 1:
        one, other = (np.concatenate([pair[k] for pair in pairs], axis=1) for k in range(2))
        return paired_difference(one, other), mcnemar(one, other)
    one, other = (rates.mean((1, 2)) for rates in bootstrap_rates(pairs))
    low, high = np.quantile(other - one, (0.025, 0.975))
    middle = np.mean([pair[1].mean() - pair[0].mean() for pair in pairs])
    return (float(middle), float(low), float(high)), math.nan


def _share(played: Played, method: str, group: list[str]) -> tuple[float, float, float]:
    needed = (UNOCCLUDED, BASELINE)
    if method in needed or not set(needed) <= set(played):
        return _NAN
    return share_recovered([[_trials(played[who][cell]) for who in (*needed, method)] for cell in group])


def as_markdown(results: list[Result], policies: Iterable[PolicyRecord], settings: str) -> str:
    """Return the table with its notes in Markdown.

    Args:
        results: The numbers.
        policies: Who played.
        settings: Which scenes were played, in words.

    Returns:
        The page.
    """
    blocks = [
        "# Success rates",
        f"{settings[:1].upper()}{settings[1:]}. {_note(results)}",
        _success_grid(results),
        "## Tolerances, and how the other episodes ended",
        "In per cent of the episodes. A collision can be one of several of base, arm and object.",
        _endings(results),
        *_differences(results),
        *_shares(results),
        "## Policies",
        _rows(
            ("Method", "Training seed", "Frames", "Commit", "SHA-256 of the weights"),
            [
                (p.method, _seed_name(p.training_seed), f"{p.frames:,}", p.commit, p.weights_sha256[:12])
                for p in policies
            ],
        ),
    ]
    return "\n\n".join(blocks) + "\n"


def _note(results: list[Result]) -> str:
    start = "In each cell: success in per cent within 0.5 m of the goal before any collision,"
    if results[0].seeds == 1:
        return (
            f"{start} and Wilson's 95 % interval. The interval is over scenes only: there is one policy of each method,"
            " and how much training seeds differ is not in it."
        )
    return (
        f"{start} as the mean over {results[0].seeds} training seeds; then the interquartile mean (IQM) with its 95 %"
        " bootstrap interval over seeds and scenes, stratified by cell."
    )


def _success_grid(results: list[Result]) -> str:
    return _rows(("Method", *map(_cell_label, _cells(results))), _grid(results, " to ", "; paper "))


def _grid(results: list[Result], dash: str, paper: str) -> list[tuple[str, ...]]:
    """Return a row for each method: its label, and its success in each cell."""
    rows: dict[str, list[str]] = {}
    for result in results:
        beside = "" if math.isnan(result.paper) else f"{paper}{100 * result.paper:.1f}"
        middle = "" if math.isnan(result.iqm) else f", IQM {100 * result.iqm:.1f}"
        interval = f"({100 * result.low:.1f}{dash}{100 * result.high:.1f})"
        row = rows.setdefault(result.method, [])
        row.append(f"{100 * result.success:.1f}{middle} {interval}{beside}")
    return [(PRESETS[method].label, *row) for method, row in rows.items()]


def _endings(results: list[Result]) -> str:
    fields = (
        "success_025",
        "success_010_10deg",
        "collisions",
        "hit_base",
        "hit_arm",
        "hit_object",
        "timeouts",
        "tipped",
    )
    head = ("Method", "Cell", "0.25 m", "0.10 m, 10°", "collisions", "base", "arm", "object", "time-outs", "tipped")
    return _rows(head, [(*_names(r), *(f"{100 * getattr(r, field):.1f}" for field in fields)) for r in results])


def _differences(results: list[Result]) -> list[str]:
    """Return the section on the differences from the baseline, nothing where there are none."""
    rows = [
        (*_names(r), _with_interval(r.difference, r.difference_low, r.difference_high, "+.1f", 100.0), _p(r.mcnemar_p))
        for r in results
        if not math.isnan(r.difference)
    ]
    how = "Newcombe's 95 % interval for pairs, and McNemar's exact p"
    if results[0].seeds > 1:
        how = "its 95 % bootstrap interval over seeds and scenes; seeds share scenes, so that there is no p"
    section = [
        f"## Against {PRESETS[BASELINE].label}",
        f"Difference of the success on the same scenes in points, {how}.",
        _rows(("Method", "Cell", "Difference", "p"), rows),
    ]
    return section if rows else []


def _shares(results: list[Result]) -> list[str]:
    """Return the section on the loss by occlusion, nothing where its methods are not in the table."""
    needed = {BASELINE, UNOCCLUDED}
    others = [r for r in results if r.method not in needed and needed <= {other.method for other in results}]
    rows = [(*_names(r), _with_interval(r.share, r.share_low, r.share_high, ".2f")) for r in others]
    over = "scenes" if results[0].seeds == 1 else "seeds and scenes"
    section = [
        "## Share of the loss by occlusion that is recovered",
        f"(method - {BASELINE}) / ({UNOCCLUDED} - {BASELINE}), with its 95 % bootstrap interval over {over}. There is"
        " no share where nothing is lost, and no interval where the loss itself may be nothing.",
        _rows(("Method", "Cell", "Share"), rows),
    ]
    return section if rows else []


def as_csv(results: list[Result]) -> str:
    """Return all numbers as comma-separated values.

    Args:
        results: The numbers.

    Returns:
        A header and a line for each result; rates in units of 1, empty where there is no number.
    """
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    names = list(Result.__dataclass_fields__)
    writer.writerow(names)
    for result in results:
        values = (getattr(result, name) for name in names)
        writer.writerow([_number(value) if isinstance(value, float) else value for value in values])
    return file.getvalue()


def as_latex(results: list[Result]) -> str:
    """Return the success rates as a LaTeX tabular, without packages.

    Args:
        results: The numbers.

    Returns:
        The tabular; the paper's rates are in brackets.
    """
    cells = _cells(results)
    head = ("Method", *map(_cell_label, cells))
    lines = [" & ".join(latex(entry) for entry in row) + r" \\" for row in (head, *_grid(results, "--", ", paper "))]
    body = [r"\hline", lines[0], r"\hline", *lines[1:], r"\hline"]
    note = f"% {' '.join(_note(results).split())}"
    return "\n".join([note, rf"\begin{{tabular}}{{l{'r' * len(cells)}}}", *body, r"\end{tabular}"]) + "\n"


def latex(text: str) -> str:
    r"""Return text with what LaTeX takes for commands escaped.

    Args:
        text: Plain text.

    Returns:
        The same text, for LaTeX.

    Examples:
        >>> print(latex("50 % of a_b & c"))
        50 \% of a\_b \& c
    """
    return text.translate(_LATEX)


def _cells(results: list[Result]) -> list[str]:
    return list(dict.fromkeys(result.cell for result in results))


def _cell_label(cell: str) -> str:
    return f"{cell.replace('-', ' ')} m" if "-" in cell else cell


def _seed_name(seed: int) -> str:
    return "shipped" if seed == SHIPPED else str(seed)


def _names(result: Result) -> tuple[str, str]:
    return PRESETS[result.method].label, _cell_label(result.cell)


def _with_interval(middle: float, low: float, high: float, form: str, scale: float = 1.0) -> str:
    if math.isnan(middle):
        return "-"
    interval = "-" if math.isnan(low) else f"{scale * low:{form}} to {scale * high:{form}}"
    return f"{scale * middle:{form}} ({interval})"


def _p(p: float) -> str:
    return "-" if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.4f}"


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top, *rest = (f"| {' | '.join(row)} |" for row in (head, *rows))
    return "\n".join([top, f"|{'---|' * len(head)}", *rest])
