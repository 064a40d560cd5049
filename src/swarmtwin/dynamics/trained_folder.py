"""What a dynamics model is trained on, and the folder that a training leaves: model, evidence, figures, history."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from swarmtwin.dynamics.model_folder import save_dynamics, save_evidence
from swarmtwin.dynamics.provenance import Provenance, SeedOutcome
from swarmtwin.dynamics.training import Trained
from swarmtwin.files import write_text
from swarmtwin.recordings.recognition import digests
from swarmtwin.robot import Robot
from swarmtwin.transitions import Preparation, SplitOptions, Transitions, held_out, mix
from swarmtwin.transitions.inputs import Vehicles, preparation_of, prepared_transitions
from swarmtwin.transitions.preparation import stored_transitions
from swarmtwin.transitions.preparing import prepare
from swarmtwin.transitions.source import TransitionSource
from swarmtwin.transitions.transitions import Split


@dataclass(frozen=True)
class TrainingData:
    """What to train on.

    Attributes:
        transitions: with their splits, real, synthetic or mixed: a mixture is in memory, others stay in their file.
        preparation: how they came about.
        evidence: real transitions that the model is not fitted to, against which later sessions can be diagnosed. A
            mixture's is the test split alone, since its generator may have seen the rest.
        sources: the folders that all of it comes from, and what each of them holds.
    """

    transitions: TransitionSource
    preparation: Preparation
    evidence: Transitions
    sources: Mapping[Path, TransitionSource]

    @classmethod
    def read(
        cls,
        robot: Robot,
        source: Path,
        *,
        is_recording: bool,
        vehicles: Vehicles,
        split: SplitOptions,
        synthetic: Path | None,
        real_share: float,
        workspace: Path,
        most_evidence: int = 20_000,
    ) -> "TrainingData":
        """Look into transitions, or prepare a recording; mix synthetic ones in, so that `real_share` of all are real.

        Args:
            robot: whose they are.
            source: folder of the transitions, or of the recording.
            is_recording: whether it is one.
            vehicles: ids of those that are taken from a recording; None: all.
            split: of a recording.
            synthetic: folder of synthetic transitions to mix in; None: none.
            real_share: of a mixture.
            workspace: an existing folder, into which a recording is prepared; it must last as long as the training.
            most_evidence: transitions, at most, but at least one run.

        Raises:
            UserError: they are at fault, see `prepare`, `prepared_transitions` and `mix`.
        """
        if is_recording:
            preparation, real = prepare(source, robot, split, workspace, vehicles), stored_transitions(workspace)
        else:
            preparation, real = preparation_of(source, robot), stored_transitions(source)
        unfitted: tuple[Split, ...] = ()
        if synthetic is None:
            if preparation.origin == "real":
                unfitted = ("validation", "test")
            return cls(real, preparation, held_out(real, unfitted, most_evidence), {source: real})
        added = prepared_transitions(synthetic, robot)
        if digests(added[1].learned) <= digests(preparation.learned):  # else its generator may have seen any run
            unfitted = ("test",)
        mixed = mix((real.whole(), preparation), added, real_share)
        sources: dict[Path, TransitionSource] = {source: real, synthetic: added[0]}
        return cls(*mixed, held_out(real, unfitted, most_evidence), sources)


def provenance_of(trained: Trained, preparation: Preparation) -> Provenance:
    """Describe where a trained model comes from, and how well each of its seeds did."""
    outcomes = []
    for result in trained.results:
        best = result.history[result.best - 1] if result.best else None
        outcomes.append(
            SeedOutcome(
                seed=result.seed,
                best_epoch=result.best,
                position_mm=best.validation_position_mm if best else None,
                orientation_deg=best.validation_orientation_deg if best else None,
                dead=result.dead,
            )
        )
    return Provenance.of(preparation, trained.recipe.model_dump(mode="json"), trained.seed, tuple(outcomes))


def save_trained(folder: Path, trained: Trained, provenance: Provenance, evidence: Transitions) -> None:
    """Save the best seed's model with its evidence, the errors of all seeds, and how they learned."""
    save_dynamics(folder, trained.dynamics, provenance.model_dump(mode="json"))
    validation = {**provenance.chosen.errors, "seeds": {str(o.seed): o.errors for o in provenance.seeds}}
    parameters = sum(weights.numel() for weights in trained.dynamics.parameters() if weights.requires_grad)
    write_text(
        folder / "metrics.json", json.dumps({"validation": validation, "parameters": parameters}, indent=1) + "\n"
    )
    history = [
        {"seed": result.seed, "epoch": number, **epoch._asdict()}
        for result in trained.results
        for number, epoch in enumerate(result.history, start=1)
    ]
    pd.DataFrame(history).to_csv(folder / "history.csv", index=False, float_format="%.5f")
    if len(evidence):
        save_evidence(folder, evidence)
