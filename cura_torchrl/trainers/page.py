"""The demo's page: one HTML file that holds its pictures and refers to nothing outside."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from html import escape
from string import Template
from typing import TYPE_CHECKING

from cura_torchrl.trainers.evaluate import summarise
from cura_torchrl.trainers.recording import Recording

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
:root { color-scheme: light dark; --ink: #1f2328; --soft: #59636e; --paper: #ffffff; --card: #f6f8fa; --line: #d1d9e0;
  --robot: #1a9850; --object: #c51b8a; --good: #11763c; --bad: #b42318; --slow: #8a6100; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6edf3; --soft: #9da7b1; --paper: #0d1117; --card: #161b22; --line: #30363d;
    --robot: #3fbf76; --object: #f06abf; --good: #4cc38a; --bad: #ff8f85; --slow: #e0b04b; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.25rem 4rem; max-width: 1080px; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .75rem; }
h2 { font-size: 1.25rem; margin: 2.75rem 0 .5rem; }
h3 { font-size: 1rem; margin: 0 0 .6rem; }
p { max-width: 74ch; margin: .5rem 0; }
.robot { color: var(--robot); font-weight: 600; } .object { color: var(--object); font-weight: 600; }
.soft, figcaption, caption { color: var(--soft); font-size: .875rem; }
article { background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 1rem; margin: 1rem 0; }
img { display: block; width: 100%; height: auto; background: #fff; border-radius: 6px; }
details { margin-top: .75rem; } summary { cursor: pointer; font-weight: 600; margin-bottom: .5rem; }
.table { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; margin: .75rem 0 0; font-size: .9rem;
  font-variant-numeric: tabular-nums; }
caption { text-align: left; caption-side: bottom; padding-top: .4rem; }
th, td { padding: .35rem .5rem; border-bottom: 1px solid var(--line); text-align: right; }
td { white-space: nowrap; } th { font-weight: 600; vertical-align: bottom; }
th:first-child, td:first-child, .word { text-align: left; }
.success { color: var(--good); } .collision { color: var(--bad); } .time-out { color: var(--slow); }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1rem; font-size: .9rem; margin: .5rem 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; }
</style>
</head>
<body>
<header>
<h1>$title</h1>
<p>$introduction</p>
</header>
<main>
<h2>How the scenes ended</h2>
<div class="table">$summary</div>
<h2>How to read the pictures</h2>
<p>$how_to_read</p>
$telling
$others
$learning
</main>
<footer>
<h2>How this was made</h2>
<dl>$facts</dl>
</footer>
</body>
</html>
""")

_INTRODUCTION = (
    'A robot (<span class="robot">green</span>) pushes a box (<span class="object">magenta</span>) to a goal and sees '
    "only through one planar LiDAR, so the box hides what lies ahead of it, while obstacles (grey) appear on the way. "
    "Both policies play the same scenes: {first} and, beside it, {second}. "
    "The animations also show what the robot has seen and how recently (confidence), where it saw obstacles "
    "(occupancy), and the distribution of the collision possibility C that its estimator predicts, whose mean is the "
    "risk R and whose variance is the uncertainty U."
)


@dataclass(frozen=True, kw_only=True)
class Card:
    """One scene on the page."""

    recordings: tuple[Recording, Recording]
    """The scene as both policies played it."""
    paths: bytes
    """Picture of the paths, PNG."""
    animation: bytes
    """Animation, WebP."""


def make_page(
    telling: Sequence[Card],
    others: Sequence[Card],
    *,
    curve: bytes | None,
    facts: Mapping[str, str],
) -> str:
    """Return the page.

    Args:
        telling: Scenes that come first, with their animation in sight.
        others: All other scenes; their animations open at a click.
        curve: Picture of the learning curves, PNG; None leaves the section out.
        facts: What the page was made with, by name.

    Returns:
        HTML that refers to no other file.

    Raises:
        ValueError: If there is no scene at all.
    """
    cards = [*telling, *others]
    if not cards:
        msg = "number of scenes is 0; accepted: 1 or more"
        raise ValueError(msg)
    labels = [escape(recording.label) for recording in cards[0].recordings]
    return _PAGE.substitute(
        title=f"{labels[0]} beside {labels[1]}, on the same scenes",
        introduction=_INTRODUCTION.format(first=labels[0], second=labels[1]),
        summary=summary_table(cards),
        how_to_read=_HOW_TO_READ,
        telling=_section("The most telling scenes", _RULE, telling, is_open=True),
        others=_section("The other scenes" if telling else "The scenes", _OTHERS, others, is_open=False),
        learning="" if curve is None else _learning(curve, labels[0]),
        facts="".join(f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in facts.items()),
    )


_RULE = (
    "Chosen by rule, not by hand: first the scenes that end well for one policy and not for the other, whichever it "
    "is, then those with the least clearance."
)
_HOW_TO_READ = (
    "Robot and its path are green, the box and its path magenta (broken), outlines stand 5 s apart; a ring marks the "
    "goal, a cross a collision, a number when an obstacle appeared. The same obstacle may appear elsewhere for the "
    "other policy, for its place keeps clear of robot and box wherever they are by then. Distances are those of the "
    "last state, some seconds after the goal was reached; clearance is that of robot and box from the nearest obstacle."
)
_OTHERS = "Their animations open at a click, and show every second frame."
_LEARNING = (
    "The wide plots show the run whose weights {label} plays with, the narrow ones what the same training made of them "
    "in this demo. Rates are taken over the episodes that ended: in the demo only a few, and those that end early come "
    "first, collisions above all."
)


def summary_table(cards: Sequence[Card]) -> str:
    """Return the table of how the scenes ended, by scenario and policy.

    Args:
        cards: All scenes.

    Returns:
        An HTML table.
    """
    kinds = list(dict.fromkeys(card.recordings[0].scene.kind for card in cards))
    rows = []
    for name, wanted in [*((kind, {kind}) for kind in kinds), ("all scenes", set(kinds))]:
        for index in (0, 1):
            chosen = [card.recordings[index] for card in cards if card.recordings[0].scene.kind in wanted]
            rows.append(_summary_row(name, chosen))
    head = (
        '<tr><th>Scenes</th><th class="word">Policy</th><th>Success</th><th>95 % interval</th><th>Collisions</th>'
        "<th>Time-outs</th><th>within 0.25 m</th><th>0.10 m &amp; 10°</th><th>Mean steps</th></tr>"
    )
    first = cards[0].recordings[0]
    caption = (
        f"Success: the box within {first.success_radius:g} m of the goal before any collision. Interval: Wilson's; so "
        "few scenes leave it wide, <code>cura-torchrl evaluate</code> plays more. "
        f"Steps of {first.period:g} s until goal, collision or time-out."
    )
    return f"<table><caption>{caption}</caption><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _summary_row(name: str, recordings: Sequence[Recording]) -> str:
    counts = summarise([recording.episode for recording in recordings])
    count = counts["episodes"]
    cells = (
        f"{counts['successes']} of {count} ({counts['success_rate']:.0%})",
        f"{counts['wilson_low']:.0%} to {counts['wilson_high']:.0%}",
        f"{counts['collisions']}",
        f"{counts['timeouts']}",
        f"{counts['success_rate_025']:.0%}",
        f"{counts['success_rate_010_10deg']:.0%}",
        f"{counts['mean_steps']:.0f}",
    )
    label = f'<td>{escape(name)}</td><td class="word">{escape(recordings[0].label)}</td>'
    return f"<tr>{label}{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _section(title: str, text: str, cards: Sequence[Card], *, is_open: bool) -> str:
    if not cards:
        return ""
    return f"<h2>{title}</h2><p>{text}</p>{''.join(_card(card, is_open=is_open) for card in cards)}"


def _card(card: Card, *, is_open: bool) -> str:
    scene = card.recordings[0].scene
    title = f"Scene {scene.index}: {scene.kind}, box of {scene.object_edge:g} m"
    outcomes = "; ".join(f"{recording.label}: {recording.describe()}" for recording in card.recordings)
    return (
        f'<article id="scene-{scene.index}"><h3>{escape(title)}</h3>'
        f"{_image(card.paths, 'png', f'Paths of both policies. {outcomes}')}"
        f'<div class="table">{_numbers(card.recordings)}</div>'
        f"<details{' open' if is_open else ''}><summary>Animation with map and collision estimate</summary>"
        f"{_image(card.animation, 'webp', f'Animation of the scene. {outcomes}')}</details></article>"
    )


def _numbers(recordings: Sequence[Recording]) -> str:
    rows = []
    for recording in recordings:
        clearance = recording.min_clearance
        cells = (
            f"{recording.episode.steps}",
            f"{recording.final_distance:.2f}",
            f"{clearance:.2f}" if math.isfinite(clearance) else "none",
            f"{recording.risk.max():.2f}",
            f"{recording.uncertainty.max():.3f}",
        )
        outcome = f'<td class="word {recording.outcome}">{escape(recording.describe())}</td>'
        numbers = "".join(f"<td>{cell}</td>" for cell in cells)
        rows.append(f"<tr><td>{escape(recording.label)}</td>{outcome}{numbers}</tr>")
    head = (
        '<tr><th>Policy</th><th class="word">Outcome</th><th>Steps</th><th>Final distance [m]</th>'
        "<th>Least clearance [m]</th><th>Highest R</th><th>Highest U</th></tr>"
    )
    return f"<table><thead>{head}</thead><tbody>{''.join(rows)}</tbody></table>"


def _learning(curve: bytes, label: str) -> str:
    picture = _image(curve, "png", "Success, collisions, speed of the object and reward over environment steps")
    return f"<h2>Learning goes on</h2><p>{_LEARNING.format(label=label)}</p><article>{picture}</article>"


def _image(content: bytes, kind: str, text: str) -> str:
    data = base64.b64encode(content).decode("ascii")
    return f'<img src="data:image/{kind};base64,{data}" alt="{escape(text, quote=True)}">'
