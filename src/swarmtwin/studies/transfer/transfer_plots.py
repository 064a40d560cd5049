"""The pictures and films of policies side by side, from the folder that the study leaves."""

from pathlib import Path

import pandas as pd

from swarmtwin.files import read_provenance
from swarmtwin.policies.reward_plots import rewards_figure, success_figure
from swarmtwin.policies.rollout_plots import draw_film, draw_paths
from swarmtwin.world.rollout import figures_of
from swarmtwin.world.rollout_storage import load_rollouts


def draw_transfer(made: Path, output: Path) -> None:
    """Draw into `output` the rewards and successes of all policies in `made`, the paths of each, and its film.

    Raises:
        UserError: `made` is not a folder of swarmtwin's, or its roll-outs cannot be read.
    """
    _, options = read_provenance(made)
    policies = {
        str(name): load_rollouts(made / "rollouts" / f"{name}.npz") for name in pd.read_csv(made / "table.csv").policy
    }
    pairs = {name: (rollouts["simulation"], rollouts["stand_in"]) for name, rollouts in policies.items()}
    rewards_figure(pairs).savefig(output / "rewards.png")
    rates = {name: {motion: figures_of(r).success for motion, r in own.items()} for name, own in policies.items()}
    success_figure(rates).savefig(output / "success.png")
    for name, rollouts in policies.items():
        draw_paths(output / f"paths_{name}.png", rollouts, "typical")
        if options["video"]:
            draw_film(output / f"{name}.mp4", rollouts, "typical", options["speed"])
