"""Columns as a Parquet file, through pyarrow, which is optional."""

from __future__ import annotations

import importlib
import importlib.util
import math
from typing import TYPE_CHECKING, Any

from cura_torchrl.trainers.errors import UnavailableError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path


def write_parquet(columns: Mapping[str, Sequence[Any]], path: Path) -> None:
    """Write columns of equal length.

    Args:
        columns: Values by name; None and NaN become null.
        path: The file.

    Raises:
        UnavailableError: If pyarrow is not installed.
    """
    if importlib.util.find_spec("pyarrow") is None:
        msg = f"{path.name} is not written, for pyarrow is not installed; it comes with pip install cura-torchrl[table]"
        raise UnavailableError(msg)
    arrow, parquet = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    cleaned = {name: [_known(value) for value in values] for name, values in columns.items()}
    parquet.write_table(arrow.table(cleaned), path)


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value
