"""Models trained on real and on synthetic transitions side by side: their table.csv as a person reads it."""

from typing import Any

import pandas as pd

from swarmtwin.studies.study_table import StudyTable

ERRORS = {"position_mm": "position error, mm", "orientation_deg": "orientation error, °"}
PLACES = {"train_vehicle": "vehicle learned from", "other_vehicle": "another vehicle"}


def case_table(title: str, table: pd.DataFrame) -> StudyTable:
    """Return the floor and then each case of table.csv, in its order.

    Errors stand first in mm, then in degrees, each × that of CR-Net-R on all real data.
    """
    cases = {place: {row["case"]: row for row in part.to_dict("records")} for place, part in table.groupby("recording")}
    real = {place: cases[place]["real"] for place in PLACES}
    floor = ("\n".join(f"{real[place][f'floor_{name}']:.2f}       " for name in ERRORS) for place in PLACES)
    rows = [["floor", "", "", *floor, ""]]
    for case, row in cases["train_vehicle"].items():
        compared = (_compared(cases[place][case], real[place]) for place in PLACES)
        given = f"\n{row['inputs']}" if row["inputs"] else ""
        amounts = (f"{row['real']:,}", f"{row['steps']:,}")
        rows.append([f"{row['title']}{given}", *amounts, *compared, f"{row['dead_seeds']} of {row['seeds']}"])
    return StudyTable(
        f"{title}: trained on real and on synthetic transitions",
        ("case\ngiven", "real\nseen", "\nsteps", "train vehicle\nmm, °", "other vehicle\nmm, °", "dead\nseeds"),
        rows,
        "on runs nobody has seen; ×: compared with CR-Net-R on all real transitions; given: what the model looks at; "
        "the ensemble is what the generator of CR-Net-S predicts the mean with, here used directly",
        floors=1,
    )


def _compared(row: dict[Any, Any], reference: dict[Any, Any]) -> str:
    if any(pd.isna(row[name]) for name in ERRORS):
        return "dead"
    return "\n".join(f"{row[name]:.2f} ×{row[name] / reference[name]:.3f}" for name in ERRORS)
