"""The folder that rolling a policy out leaves: figures, every step as a table, and all there is to draw."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from swarmtwin.files import write_text
from swarmtwin.policies.rollout_comparison import rollout_table
from swarmtwin.world.rollout import Rollout
from swarmtwin.world.rollout_storage import save_rollouts

ROLLOUTS = "rollouts.npz"


def save_rollout(
    folder: Path, rollouts: Mapping[str, Rollout], metrics: Mapping[str, Any], about: Mapping[str, str]
) -> None:
    """Write `metrics.json`, which begins with `about`, `rollouts.parquet`, and the roll-outs to draw them from."""
    write_text(folder / "metrics.json", json.dumps({**about, **metrics}, indent=1) + "\n")
    tables = [rollout_table(motion, rollout) for motion, rollout in rollouts.items()]
    pd.concat(tables).to_parquet(folder / "rollouts.parquet", index=False)
    save_rollouts(folder / ROLLOUTS, rollouts)
