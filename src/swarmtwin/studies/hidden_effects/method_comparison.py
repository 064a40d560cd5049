"""What several methods make of the same sessions: the diagnosis, others beside it, and one with the true model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from swarmtwin.studies.hidden_effects.proportions import (
    CLEAR,
    RISE_BINS,
    Proportion,
    in_rise_bin,
    median,
    median_and_most,
)


@dataclass(frozen=True)
class Method:
    """Columns of the table of results that hold what a method made of each case; empty where it says nothing of that.

    Attributes:
        named: the causes that it named.
        first: whether the first of them is a true one.
        exact: whether they are the true ones and no others.
        failure: why it failed.
        seconds: that it took.
        error_mm: one-step error on held-out runs of the simulation that it corrected.
    """

    named: str = ""
    first: str = ""
    exact: str = ""
    failure: str = ""
    seconds: str = ""
    error_mm: str = ""


DIAGNOSIS = "diagnosis"
WITH_TRUE_MODEL = Method(*(f"true_model{end}" for end in ("", "_first", "_exact", "_failure", "_seconds")))
METHODS = {
    DIAGNOSIS: Method("named", "named_first", "exact", "failure", "seconds", "after_mm"),
    "parameter fitting": Method("fitting", "fitting_first", "fitting_exact"),
    "rules on correlations": Method("rule", "rule_first", "rule_exact"),
    "black-box residual": Method(error_mm="black_box_after_mm"),
    "oracle": WITH_TRUE_MODEL,
    "mujoco.sysid": WITH_TRUE_MODEL,
}

OTHERS = (DIAGNOSIS, "parameter fitting", "rules on correlations", "black-box residual")


def compared(
    table: pd.DataFrame, methods: Sequence[str], parameters: Mapping[str, pd.DataFrame]
) -> dict[str, dict[str, Any]]:
    """Count, for each method, what it makes of one family's cases, on which all of them worked.

    Args:
        table: the cases' rows of `results.results_table`.
        methods: names in `METHODS`.
        parameters: of the methods that tell parameters, one row for each that is told of a true cause.

    Returns:
        cases: how many; one, by how much the effect raises the error, two and three: the causes named are the true ones
        and no others; first: of single effects that raise the error by 10 % or more, the first cause named is true;
        outside: no name was given; accused: a clean session was given one; failed; median_parameter_error_percent;
        error_cut: the median share of the one-step error on held-out runs that the corrected simulation takes away
        where effects raise it by 10 % or more; seconds: median and most. None, or shares of no case, where a method
        says nothing of it.
    """
    return {name: _counted(table, METHODS[name], parameters.get(name)) for name in methods}


def _counted(table: pd.DataFrame, method: Method, parameters: pd.DataFrame | None) -> dict[str, Any]:
    def share(chosen: pd.Series, column: str, negated: bool = False) -> Proportion:
        """Count where a column is true, or holds something; of no case where the method does not say."""
        if not column:
            return Proportion.of([])
        values = table[column][chosen]
        happened = values.notna() & (values != "") if column in (method.named, method.failure) else values.astype(bool)
        failed = table[method.failure][chosen].notna() if method.failure else pd.Series(False, index=values.index)
        return Proportion.of(~happened & ~failed if negated else happened)

    kind, everywhere = table.kind, pd.Series(True, index=table.index)
    one, clear = kind == "one", in_rise_bin(table, CLEAR)
    hiding = kind.isin(["one", "two", "three"])
    error = None
    if method.error_mm:
        left = table[method.error_mm].astype(float) / table.before_mm.astype(float)
        error = median(1.0 - left[hiding & clear])
    told = None
    if parameters is not None:
        own = parameters.seed.isin(table.seed) & parameters.family.isin(table.family) & parameters.same_unit
        told = median(parameters.error_percent[own])
    return {
        "cases": len(table),
        "one": {name: share(one & in_rise_bin(table, name), method.exact) for name in RISE_BINS},
        "first": share(one & clear, method.first),
        **{name: share(kind == name, method.exact) for name in ("two", "three")},
        "outside": share(kind == "outside", method.named, negated=True),
        "accused": share(kind == "clean", method.named),
        "median_parameter_error_percent": told,
        "error_cut": error,
        "seconds": median_and_most(table[method.seconds]) if method.seconds else {"median": None, "most": None},
        "failed": share(everywhere, method.failure),
    }
