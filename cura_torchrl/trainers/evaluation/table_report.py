"""The table of success rates as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import math
from typing import TYPE_CHECKING

from cura_torchrl.trainers.evaluation.outcomes import SHIPPED
from cura_torchrl.trainers.evaluation.table_numbers import BASELINE, UNOCCLUDED, Result, reference
from cura_torchrl.trainers.methods import PRESETS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from cura_torchrl.trainers.evaluation.agreement import Agreement
    from cura_torchrl.trainers.evaluation.outcomes import CodeRecord, PolicyRecord

_LATEX = str.maketrans({
    **{character: f"\\{character}" for character in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "\\": r"\textbackslash{}",
})  # fmt: skip


def as_markdown(
    results: list[Result], policies: Iterable[PolicyRecord], settings: str, code: Iterable[CodeRecord] = ()
) -> str:
    """Return the table with its notes in Markdown.

    Args:
        results: The numbers.
        policies: Who played.
        settings: Which scenes were played, in words.
        code: What they were played by.

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
        *_ways(results),
        "## Policies",
        _rows(
            ("Method", "Training seed", "Frames", "Commit", "SHA-256 of the weights"),
            [
                (p.method, _seed_name(p.training_seed), f"{p.frames:,}", p.commit, p.weights_sha256[:12])
                for p in policies
            ],
        ),
        *(f"Played at commit {entry.commit}, with {_versions(entry)}." for entry in code),
    ]
    return "\n\n".join(blocks) + "\n"


def _note(results: list[Result]) -> str:
    start = "In each cell: success in per cent within 0.5 m of the goal before any collision,"
    if results[0].seeds == 1:
        return (
            f"{start} and Wilson's 95 % interval, over all cells a bootstrap one, for scenes are alike in all cells."
            " The interval is over scenes only: there is one policy of each method, and how much training seeds differ"
            " is not in it."
        )
    return (
        f"{start} as the mean over {results[0].seeds} training seeds; then the interquartile mean (IQM) with its 95 %"
        " bootstrap interval over seeds and scenes."
    )


def _success_grid(results: list[Result]) -> str:
    return _rows(("Method", *map(cell_label, _cells(results))), _grid(results, " to ", "; paper "))


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
    """Return the section on the differences from the reference, nothing where there are none."""
    rows = [
        (*_names(r), _with_interval(r.difference, r.difference_low, r.difference_high, "+.1f", 100.0), _p(r.mcnemar_p))
        for r in results
        if not math.isnan(r.difference)
    ]
    how = (
        "Newcombe's 95 % interval for pairs, and McNemar's exact p; over all cells a bootstrap interval over scenes,"
        " and no p, for cells share scenes"
    )
    if results[0].seeds > 1:
        how = "its 95 % bootstrap interval over seeds and scenes; seeds share scenes, so that there is no p"
    section = [
        f"## Against {PRESETS[reference(r.method for r in results)].label}",
        f"Difference of the success on the same scenes in points, {how}.",
        _rows(("Method", "Cell", "Difference", "p"), rows),
    ]
    return section if rows else []


def _shares(results: list[Result]) -> list[str]:
    """Return the section on the loss by occlusion, nothing where its methods are not in the table."""
    needed = {BASELINE, UNOCCLUDED}
    others = [r for r in results if r.method not in needed and needed <= {other.method for other in results}]
    rows = [
        (
            *_names(r),
            _with_interval(r.share, r.share_low, r.share_high, ".2f"),
            _with_interval(r.collision_share, r.collision_share_low, r.collision_share_high, ".2f"),
        )
        for r in others
    ]
    over = "scenes" if results[0].seeds == 1 else "seeds and scenes"
    section = [
        "## Share of the loss by occlusion that is recovered",
        f"(method - {BASELINE}) / ({UNOCCLUDED} - {BASELINE}), with its 95 % bootstrap interval over {over}, of the"
        " success and of the collisions alone. There is no share where nothing is lost, and no interval where the loss"
        " itself may be nothing.",
        _rows(("Method", "Cell", "Success", "Collisions"), rows),
    ]
    return section if rows else []


def _ways(results: list[Result]) -> list[str]:
    """Return the section on what was measured, nothing where nothing was."""
    rows = [
        (
            *_names(r),
            f"{r.steps:.0f}",
            *(_plain(value, digits) for value, digits in ((r.clearance, 2), (r.goal_distance, 2))),
            _plain(math.degrees(r.yaw_error), 1),
            *(_plain(value, 1) for value in (r.base_path, r.object_path, 100 * r.unseen)),
            _plain(r.delay, 2),
        )
        for r in results
        if not math.isnan(r.goal_distance)
    ]
    section = [
        "## Ways, clearance and sight",
        "Until goal, collision or time-out: mean number of steps of the policy; least distance of robot and object from"
        " an obstacle (median of the episodes that have one); mean lengths of the paths; obstacles that no ray hit, and"
        " the mean time from an obstacle's appearance to the first ray that hits it. At the end of the episode, which"
        " goes on after a success: median distance and angle between object and goal.",
        _rows(
            (
                *("Method", "Cell", "steps", "clearance [m]", "to goal [m]", "angle [°]", "base's path [m]"),
                *("object's path [m]", "never seen [%]", "seen after [s]"),
            ),
            rows,
        ),
    ]
    return section if rows else []


def agreement_section(found: Mapping[tuple[str, str], Agreement], title: str, changed: Sequence[str] = ()) -> str:
    """Return how the outcomes compare with those of another file in Markdown.

    Args:
        found: The comparison by name of the method, or "all", and by name of the other simulator.
        title: What they are compared with, in words.
        changed: Names of the policies that have other weights there.

    Returns:
        A section of the page.
    """
    rows = [
        (
            PRESETS[method].label if method in PRESETS else method,
            simulator,
            f"{entry.scenes:,}",
            f"{100 * entry.alike:.1f} %",
            f"{100 * entry.before:.1f}",
            f"{100 * entry.success:.1f}",
            _with_interval(entry.success - entry.before, entry.low, entry.high, "+.1f", 100.0),
        )
        for (method, simulator), entry in found.items()
    ]
    head = (
        "Method",
        "Simulator there",
        "Scenes",
        "Ended alike",
        "Success there [%]",
        "here [%]",
        "Difference [points]",
    )
    told = (
        "Success, collision or time-out on the same scenes; the difference with a 95 % bootstrap interval over scenes."
    )
    if changed:
        told += f" The other file is of **other weights** of {', '.join(changed)}."
    return (
        "\n\n".join([f"## Agreement with {title}", told, _rows(head, rows) if rows else "No scene is in both."]) + "\n"
    )


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
    head = ("Method", *map(cell_label, cells))
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


def cell_label(cell: str) -> str:
    """Return a cell's name for tables and figures.

    Args:
        cell: Its name, or "all".

    Returns:
        Words.

    Examples:
        >>> cell_label("uniform-0.5")
        'uniform 0.5 m'
    """
    return f"{cell.replace('-', ' ')} m" if "-" in cell else cell


def _cells(results: list[Result]) -> list[str]:
    return list(dict.fromkeys(result.cell for result in results))


def _seed_name(seed: int) -> str:
    return "shipped" if seed == SHIPPED else str(seed)


def _names(result: Result) -> tuple[str, str]:
    return PRESETS[result.method].label, cell_label(result.cell)


def _with_interval(middle: float, low: float, high: float, form: str, scale: float = 1.0) -> str:
    if math.isnan(middle):
        return "-"
    interval = "-" if math.isnan(low) else f"{scale * low:{form}} to {scale * high:{form}}"
    return f"{scale * middle:{form}} ({interval})"


def _plain(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _versions(code: CodeRecord) -> str:
    return ", ".join(f"{name} {version}" for name, version in code.versions.items() if version != "not installed")


def _p(p: float) -> str:
    return "-" if math.isnan(p) else "< 0.0001" if p < 1e-4 else f"{p:.4f}"


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"


def _rows(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    top, *rest = (f"| {' | '.join(row)} |" for row in (head, *rows))
    return "\n".join([top, f"|{'---|' * len(head)}", *rest])
