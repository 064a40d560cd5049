"""Recordings become transitions: situation, command and the displacement that followed over one control period."""

from swarmtwin.transitions.extraction import Counts, from_recording
from swarmtwin.transitions.preparation import Preparation, load_preparation, load_transitions, save_transitions
from swarmtwin.transitions.scaling import ColumnScaling, Scaling
from swarmtwin.transitions.splitting import Fractions, SplitOptions, split_by_run
from swarmtwin.transitions.transitions import SPLITS, Transitions

__all__ = [
    "SPLITS",
    "ColumnScaling",
    "Counts",
    "Fractions",
    "Preparation",
    "Scaling",
    "SplitOptions",
    "Transitions",
    "from_recording",
    "load_preparation",
    "load_transitions",
    "save_transitions",
    "split_by_run",
]
