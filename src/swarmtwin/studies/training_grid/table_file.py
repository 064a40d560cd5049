"""What those need who only read or draw an experiment's table.csv: it, and what its errors are called."""

from pathlib import Path
from typing import Literal

import pandas as pd

Quantity = Literal["position_mm", "orientation_deg", "open_loop_mm"]

TITLES: dict[Quantity, str] = {
    "position_mm": "position error, mm",
    "orientation_deg": "orientation error, °",
    "open_loop_mm": "open-loop RMSE, mm",
}


def read_table(file: Path) -> pd.DataFrame:
    """Read table.csv; what learns from measured transitions has no generator, which is an empty text."""
    table = pd.read_csv(file, dtype={"generator": str, "dead_because": str})
    return table.assign(generator=table.generator.fillna(""), dead_because=table.dead_because.fillna(""))
