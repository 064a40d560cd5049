"""Recordings become transitions: situation, command and the displacement that followed over one control period."""

from swarmtwin.transitions.extraction import Counts, from_recording
from swarmtwin.transitions.mixing import mix
from swarmtwin.transitions.preparation import (
    GeneratorOrigin,
    Origin,
    Preparation,
    RecordingOrigin,
    load_preparation,
    load_transitions,
    save_transitions,
)
from swarmtwin.transitions.splitting import Fractions, SplitOptions, first_runs, held_out, split_by_run
from swarmtwin.transitions.storage import read_transitions, write_transitions
from swarmtwin.transitions.transitions import SPLITS, Transitions

__all__ = [
    "SPLITS",
    "Counts",
    "Fractions",
    "GeneratorOrigin",
    "Origin",
    "Preparation",
    "RecordingOrigin",
    "SplitOptions",
    "Transitions",
    "first_runs",
    "from_recording",
    "held_out",
    "load_preparation",
    "load_transitions",
    "mix",
    "read_transitions",
    "save_transitions",
    "split_by_run",
    "write_transitions",
]
