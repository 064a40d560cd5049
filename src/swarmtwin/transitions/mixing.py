"""Real and synthetic transitions in one training set (the paper's figure 8)."""

import dataclasses
from typing import Any

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.transitions.preparation import Preparation, counts_by_split, runs_by_split
from swarmtwin.transitions.splitting import first_runs
from swarmtwin.transitions.transitions import Split, Transitions

Prepared = tuple[Transitions, Preparation]


def mix(real: Prepared, synthetic: Prepared, real_share: float) -> Prepared:
    """Replace real transitions by synthetic ones until `real_share` of them is left; the total stays.

    The first whole real runs are kept, in training and validation alike. What synthetic transitions do not hold, such
    as the commands before, is left out of the real ones as well.

    Raises:
        UserError: the two do not fit, or there are too few synthetic ones.
    """
    _check_pair(real[1], synthetic[1])
    few = first_runs(real[0], max(1, round(real_share * _learned_from(real[0]))))
    filling = [_filling(split, real[0], few, synthetic[0]) for split in ("train", "validation")]
    mixed = _joined([few, *filling])
    preparation = synthetic[1].model_copy(
        update={
            "origin": "mixed",
            "runs": runs_by_split(mixed),
            "transitions": counts_by_split(mixed),
            "vehicles": tuple(dict.fromkeys((*real[1].vehicles, *synthetic[1].vehicles))),
            "recording": real[1].recording,
            "digest": real[1].digest,
            "source": real[1].source,
            "arena_mm": real[1].arena_mm,
            "learned": tuple(sorted({*real[1].learned, *synthetic[1].learned})),
        }
    )
    return mixed, preparation


def _check_pair(real: Preparation, synthetic: Preparation) -> None:
    if real.origin != "real":
        raise UserError(f"transitions=... to be mixed with synthetic ones are {real.origin}, and should be real")
    if synthetic.origin != "synthetic":
        raise UserError(f"synthetic=... names {synthetic.origin} transitions: name a folder that generate made")
    if real.robot != synthetic.robot:
        raise UserError(f"synthetic=... holds transitions of robot {synthetic.robot!r}, not of {real.robot!r}")


def _learned_from(transitions: Transitions) -> int:
    return len(transitions.part("train")) + len(transitions.part("validation"))


def _filling(split: Split, real: Transitions, few: Transitions, synthetic: Transitions) -> Transitions:
    """Return as many synthetic transitions as `few` has fewer than `real` in a split."""
    wanted, available = len(real.part(split)) - len(few.part(split)), synthetic.part(split)
    if wanted > len(available):
        raise UserError(
            f"the mixture needs {wanted} synthetic transitions for {split}, and there are {len(available)}: "
            "generate more with count=..., or choose a larger real_share"
        )
    return available.where(np.arange(wanted))


def _joined(parts: list[Transitions]) -> Transitions:
    """Put transitions one after the other; columns that one of them lacks altogether are NaN in all."""
    runs = tuple(dict.fromkeys(name for part in parts for name in part.runs))
    vehicles = tuple(dict.fromkeys(name for part in parts for name in part.vehicles))
    columns: dict[str, Any] = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(Transitions)
        if field.name != "neighbours" and isinstance(getattr(parts[0], field.name), np.ndarray)
    }
    most = max(part.neighbours.shape[1] for part in parts)
    columns["neighbours"] = np.concatenate([_widened(part.neighbours, most) for part in parts])
    for name in ("previous_command", "earlier_command", "pose", "velocity", "time_s", "neighbours"):
        if any(len(part) and np.isnan(getattr(part, name)).all() for part in parts):
            columns[name] = np.full_like(columns[name], np.nan)
    columns["run"] = _renumbered([(part.run, part.runs) for part in parts], runs)
    columns["vehicle"] = _renumbered([(part.vehicle, part.vehicles) for part in parts], vehicles)
    return dataclasses.replace(parts[0], **columns, runs=runs, vehicles=vehicles)


def _widened(neighbours: np.ndarray, most: int) -> np.ndarray:
    """Return neighbours (N, K, 3) as (N, most, 3), filled up with NaN."""
    return np.pad(neighbours, ((0, 0), (0, most - neighbours.shape[1]), (0, 0)), constant_values=np.nan)


def _renumbered(parts: list[tuple[np.ndarray, tuple[str, ...]]], names: tuple[str, ...]) -> np.ndarray:
    number = {name: index for index, name in enumerate(names)}
    return np.concatenate([np.array([number[name] for name in own], dtype=int)[index] for index, own in parts])
