"""Roll-outs of one policy from the same starts, in simulations and on stand-ins: kept, and how they differ."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from swarmtwin.policies.rollout_comparison import plain_figures, reward_difference, reward_gap
from swarmtwin.world.rollout import Rate, Rollout, RolloutFigures, figures_of
from swarmtwin.world.rollout_storage import load_rollouts, save_rollouts

LEARNED, SCRIPTED, RANDOM = "learned", "scripted", "random"


@dataclass(frozen=True)
class PolicyRollouts:
    """The roll-outs of one policy, all from the same starts.

    Attributes:
        policy: `learned`, `scripted` or `random`.
        simulated: by the simulation; of a learned policy that which it was learned in.
        real: by the group of stand-ins.
    """

    policy: str
    simulated: Mapping[str, Rollout]
    real: Mapping[str, Rollout]

    @property
    def file_name(self) -> str:
        """The name of the file that they are saved in."""
        return f"{self.policy} in {next(iter(self.simulated))}.npz" if self.policy == LEARNED else f"{self.policy}.npz"

    def save(self, folder: Path) -> None:
        """Write the roll-outs into a folder, by simulation and by group of stand-ins."""
        save_rollouts(folder / self.file_name, {**self.simulated, **self.real})

    @classmethod
    def load(cls, file: Path, simulations: Mapping[str, Any]) -> "PolicyRollouts":
        """Read the roll-outs of a policy; `simulations` are all that there were.

        Raises:
            UserError: the file is missing or damaged.
        """
        rollouts = load_rollouts(file)
        simulated = {name: rollout for name, rollout in rollouts.items() if name in simulations}
        real = {name: rollout for name, rollout in rollouts.items() if name not in simulations}
        return cls(file.stem.split(" in ")[0], simulated, real)


def gap_rows(rollouts: PolicyRollouts) -> Iterator[dict[str, Any]]:
    """Yield lines of table.csv, units in the columns' names: for each simulation itself, and each group against it.

    Rewards are a vehicle and step; a gap is how much more is earned on the stand-ins, with its 95 % interval.
    """
    for simulation, simulated in rollouts.simulated.items():
        about = {"simulation": simulation, "policy": rollouts.policy}
        yield {**about, "where": "simulation", **figure_columns(figures_of(simulated))}
        for where, real in rollouts.real.items():
            yield {**about, "where": where, **figure_columns(figures_of(real)), **_gap(simulated, real)}


def figure_columns(figures: RolloutFigures) -> dict[str, Any]:
    """Return figures of roll-outs by column, a rate with the ends of its interval."""
    row: dict[str, Any] = {}
    for name, figure in figures._asdict().items():
        if isinstance(figure, Rate):
            row |= {name: figure.value, f"{name}_low": figure.low, f"{name}_high": figure.high}
        else:
            row[name] = figure
    return row


def _gap(simulated: Rollout, real: Rollout) -> dict[str, float]:
    gap, difference = reward_gap(simulated, real), reward_difference(simulated, real)
    absolute = dict(zip(("gap", "gap_low", "gap_high"), gap, strict=True))
    return absolute | dict(zip(("gap_percent", "gap_percent_low", "gap_percent_high"), difference, strict=True))


def gap_metrics(rollouts: PolicyRollouts, simulation: str) -> dict[str, Any]:
    """Return the same of one simulation as plain data, as it stands in metrics.json."""
    simulated = rollouts.simulated[simulation]
    metrics: dict[str, Any] = {"simulation": plain_figures(figures_of(simulated))}
    for where, real in rollouts.real.items():
        gaps = {"reality_gap": reward_gap(simulated, real), "reality_gap_percent": reward_difference(simulated, real)}
        plain = {name: dict(zip(("value", "low", "high"), gap, strict=True)) for name, gap in gaps.items()}
        metrics[where] = plain_figures(figures_of(real)) | plain
    return metrics
