"""What the page about many machines says is what was measured."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_tables_are_those_of_the_result() -> None:
    """Catches a page whose numbers were not measured, or are of an older measurement than the one beside them."""
    command = [sys.executable, "benchmarks/scaling_table.py", "benchmarks/results/scaling.json"]
    printed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    page = (ROOT / "docs" / "scaling.md").read_text(encoding="utf-8")
    tables = printed.strip().split("\n\n")
    assert len(tables) == 4
    assert [table for table in tables if table not in page] == []
