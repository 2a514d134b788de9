"""Success rates that the paper prints, to stand beside one's own: pure data.

Source: CURA-PPO, table of success rates [%] for cubes of 0.5, 0.75 and 1.0 m. The paper does not say which tolerance,
layout of the obstacles and friction they hold for.
"""

from __future__ import annotations

PAPER_CELLS = ("uniform-0.5", "uniform-0.75", "uniform-1.0", "adversarial-0.5", "adversarial-0.75", "adversarial-1.0")
"""Cells of the paper's table: scenario and edge of the pushed cube [m]."""

PAPER_SUCCESS: dict[str, tuple[float, ...]] = {
    "push-no-occlusion": (92.04, 88.10, 89.49, 86.57, 79.41, 74.19),
    "push": (74.20, 66.39, 42.34, 65.25, 48.86, 22.90),
    "cura-ppo": (88.73, 81.61, 80.13, 77.12, 74.59, 72.42),
    "push-conf": (80.63, 68.77, 63.74, 69.65, 63.68, 54.13),
    "cura-no-uncertainty": (84.57, 69.35, 64.27, 70.55, 64.08, 57.80),
    "cura-no-risk": (86.09, 79.93, 78.45, 78.20, 70.06, 67.82),
    "push-base": (66.33, 47.45, 40.18, 56.97, 30.94, 17.64),
    "cura-ppo-base": (86.75, 72.20, 50.08, 76.41, 57.31, 31.03),
}
"""Success [%] by method, in the order of :data:`PAPER_CELLS`."""


def paper_success(method: str, cell: str) -> float | None:
    """Return what the paper prints for a method.

    Args:
        method: Name of the method.
        cell: Name of a cell, or "all" for the mean of the paper's six.

    Returns:
        Success [1]; None where the paper has no such number.

    Examples:
        >>> paper_success("push", "uniform-0.5")
        0.742
        >>> paper_success("push", "uniform-0.6") is None
        True
    """
    rates = PAPER_SUCCESS.get(method)
    if rates is None or cell not in {*PAPER_CELLS, "all"}:
        return None
    percent = sum(rates) / len(rates) if cell == "all" else rates[PAPER_CELLS.index(cell)]
    return round(percent / 100.0, 6)
