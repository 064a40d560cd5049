"""Folders that earlier versions saved as `diffusion`, read as what they hold: residual diffusion."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from swarmtwin.generators.columns import Columns


def renewed_config(config: Mapping[str, Any], columns: Columns) -> dict[str, Any]:
    """Return the configuration in an old `generator.yaml` as one of today's `residual_diffusion`."""
    renewed = {name.replace("trend_", "mean_model_"): value for name, value in config.items()}
    reach_mm = renewed.pop("wall_reach_lengths") * columns.robot.vehicle_size_mm[0]
    shorter_side_mm = (columns.arena_mm.high_mm - columns.arena_mm.low_mm).min()
    return renewed | {"name": "residual_diffusion", "wall_reaches": [float(reach_mm / shorter_side_mm)]}


def renewed_weights(weights: Mapping[str, Tensor], columns: Columns) -> dict[str, Tensor]:
    """Return the weights of an old generator under today's names, so that it goes on drawing the same rows.

    Its last two wall columns were Σ w cos 2a and Σ w sin 2a, with a wall's weight w and the angle a to it; today's are
    Σ w cos² a and Σ w cos a sin a.
    """
    renewed = {
        name.replace("trend.layers.", "mean_model.parts.0.").replace("trend.", "mean_model."): tensor
        for name, tensor in weights.items()
    }
    if columns.has_pose:
        walls = len(columns.robot.command) + 4
        for name, before in (("mean_model.parts.0.0.weight", 0), ("noise.network.0.weight", 3)):
            first_layer = renewed[name] = renewed[name].clone()
            start = before + walls
            first_layer[:, start] -= first_layer[:, start + 3]
            first_layer[:, start + 3 : start + 5] *= 2
    return renewed
