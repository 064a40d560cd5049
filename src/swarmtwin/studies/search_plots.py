"""Pictures of a search for hyper-parameters, by Optuna's own plots."""

import warnings
from collections.abc import Callable

import matplotlib.pyplot as plt
import optuna
from matplotlib.figure import Figure
from optuna.visualization import matplotlib as plots

from swarmtwin.learning.tuning import complete_trials
from swarmtwin.plotting import style


def search_figures(study: optuna.Study) -> dict[str, Figure]:
    """Draw how the best loss fell, which options mattered (fANOVA), and which values went with which loss, by name.

    The last two need trials with unlike losses: they are left out where there are none.
    """
    drawn: dict[str, Callable[[optuna.Study], object]] = {"history": plots.plot_optimization_history}
    if len({trial.value for trial in complete_trials(study)}) > 1:
        drawn |= {"importances": plots.plot_param_importances, "parallel_coordinates": plots.plot_parallel_coordinate}
    figures = {}
    with style(), plt.ioff(), warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        for name, draw in drawn.items():
            draw(study)
            figures[name] = plt.gcf()
            figures[name].set_size_inches(8, 4.5)
            plt.close(figures[name])
    return figures
