"""Robots with something hidden in them, recorded and diagnosed: the simulation as it was, and the extended ones."""

import logging
from dataclasses import dataclass
from pathlib import Path

from swarmtwin.diagnosis.diagnose import diagnose
from swarmtwin.diagnosis.diagnosis_folder import EXTENDED, extension_provenance, save_diagnosis
from swarmtwin.diagnosis.reference import Reference
from swarmtwin.diagnosis.result import DiagnosisResult
from swarmtwin.diagnosis.saved_diagnosis import read_result
from swarmtwin.files import new_folder
from swarmtwin.learning.device import one_thread
from swarmtwin.learning.parallel import Report
from swarmtwin.learning.progress_bars import quieter
from swarmtwin.recordings.recognition import known_by
from swarmtwin.recordings.recording import Recording
from swarmtwin.simulation.simulation_folder import save_extended
from swarmtwin.standin.effects import parse_effects
from swarmtwin.standin.session import StandInSession
from swarmtwin.studies.policy_gain.options import Hidden, Options
from swarmtwin.studies.stand_in_families import Family, driver_of, session_options
from swarmtwin.studies.stand_in_recording import record
from swarmtwin.transitions import from_recording

AS_LEARNED = "as learned"


@dataclass(frozen=True)
class FamilyDiagnosis:
    """A family's robot: recorded once for its simulation, and once with each thing hidden, which is then diagnosed.

    Attributes:
        family: whose physics move the vehicles.
        options: of the study.
        folder: for the simulation as learned, and the diagnosis of everything hidden, by its name.
    """

    family: Family
    options: Options
    folder: Path

    def run(self, report: Report | None) -> None:
        """Leave all folders, those that are there already as they are."""
        with one_thread(), quieter("swarmtwin.transitions", logging.WARNING):
            missing = [name for name in self.options.hidden if not (self.folder / name).exists()]
            if not missing:
                return
            recording = self._record((), self.options.lengths.reference_runs, self.options.seed)
            reference = Reference.learn(from_recording(recording)[0], self.options.seed)
            for number, name in enumerate(self.options.hidden):
                if name in missing:
                    seed = self.options.seed + 1 + number
                    self._diagnose(name, reference, recording, seed)
                if report:
                    report(self.family, name)

    def _record(self, hidden: Hidden, runs: int, seed: int) -> Recording:
        options, one = self.options, 1
        session = StandInSession(
            options.robot,
            (options.recorded,),
            runs,
            options.lengths.steps,
            seed,
            parse_effects(hidden, options.robot, one),
            **session_options(self.family),
        )
        return record(session, drive=driver_of(self.family))[1]

    def _diagnose(self, name: str, reference: Reference, recording: Recording, seed: int) -> None:
        measured = self._record(self.options.hidden[name], self.options.lengths.runs, seed)
        diagnosed = diagnose(reference, measured, seed)
        learned = known_by(recording.tracks)
        provenance = extension_provenance(diagnosed, measured, name, learned, {}, seed)
        if not (self.folder / AS_LEARNED).exists():
            with new_folder(self.folder / AS_LEARNED, "experiment") as inside:
                save_extended(inside, diagnosed.simulation, provenance.model_dump(mode="json"))
        with new_folder(self.folder / name, "experiment") as inside:
            save_diagnosis(inside, diagnosed, provenance)


def extension_of(folder: Path, name: str) -> tuple[Path | None, DiagnosisResult]:
    """Return the extended simulation, None where nothing was found that held-out runs confirm, and the diagnosis."""
    extended = folder / name / EXTENDED
    return (extended if extended.exists() else None), read_result(folder / name)
