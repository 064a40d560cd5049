"""The folder that a diagnosis leaves, and where the extended simulation in it comes from."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from swarmtwin.diagnosis.next_recording import DRIVE_FILE
from swarmtwin.diagnosis.result import DiagnosedSession
from swarmtwin.diagnosis.saved_diagnosis import save_findings
from swarmtwin.dynamics.provenance import Provenance, SeedOutcome
from swarmtwin.recordings.blocks import run_of
from swarmtwin.recordings.recognition import known_by
from swarmtwin.recordings.recording import Recording
from swarmtwin.simulation.simulation_folder import save_extended

EXTENDED = "simulation"


def extension_provenance(
    diagnosed: DiagnosedSession,
    measured: Recording,
    name: str,
    learned: tuple[str, ...],
    settings: dict[str, Any],
    seed: int,
) -> Provenance:
    """Describe where an extended simulation comes from: it has seen the reference and the fitted measured runs."""
    transitions, held_out = diagnosed.transitions, diagnosed.held_out
    names = [{transitions.runs[index] for index in np.unique(transitions.run[mask])} for mask in (~held_out, held_out)]
    seen = names[0] | {run_of(name) for name in names[0]}
    fitted = known_by(track for track in measured.tracks if track.run in seen)
    gain = diagnosed.result.gain
    outcome = SeedOutcome(
        seed=seed,
        best_epoch=1,
        position_mm=gain.position_mm.after,
        orientation_deg=gain.orientation_deg.after,
        dead=None,
    )
    return Provenance(
        recording=name,
        digest=measured.digest,
        source=measured.header.source,
        vehicles=diagnosed.result.vehicles,
        runs={"train": tuple(sorted(names[0])), "validation": (), "test": tuple(sorted(names[1]))},
        learned=tuple(sorted({*learned, *fitted})),
        recipe={"diagnosis": settings},
        seed=seed,
        seeds=(outcome,),
    )


def save_diagnosis(folder: Path, diagnosed: DiagnosedSession, provenance: Provenance) -> None:
    """Write what is found and the residuals, and, if there are any, the next drive and a confirmed extension."""
    save_findings(folder, diagnosed)
    if diagnosed.next_drive is not None:
        columns = list(diagnosed.simulation.robot.command_columns)
        pd.DataFrame(diagnosed.next_drive, columns=columns).to_csv(folder / DRIVE_FILE, index=False)
    if diagnosed.extended is not None and not diagnosed.result.not_confirmed:
        (folder / EXTENDED).mkdir()
        save_extended(folder / EXTENDED, diagnosed.extended, provenance.model_dump(mode="json"))
