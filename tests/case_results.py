"""Results of the study of hidden effects, made up: what is hidden and what is named are known."""

from swarmtwin.diagnosis.result import Cause
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.held_out_gain import HeldOutGain
from swarmtwin.studies.hidden_effects.results import Result


def result(kind, hidden, named=(), rise=20.0, verdict=None, rivals=(), posterior=1.0, **about):
    """A planted result; what is hidden and what is named in one word each."""
    names = hidden.split("+") if kind != "clean" else []
    case = Case(
        family=about.pop("family", "formulas"),
        kind=kind,
        robot=about.pop("robot", "mgr"),
        names=names,
        rises_percent=[max(rise, 0.1)] * len(names),
        variety=hidden if kind == "clean" else "",
        seed=about.pop("seed", 1),
    )
    said = {"parameters": {}, "posterior": posterior, "confidence": posterior, "share_of_gap": 1.0, "evidence": ""}
    causes = tuple(Cause(name=name, rivals=rivals, **said) for name in named)
    usual = {
        "effects": tuple({"name": name} for name in names),
        "true_causes": {name: {} for name in case.true_names},
        "transitions": 4000,
        "gained": HeldOutGain(before_mm=4.0, after_mm=3.0, least_mm=2.5, share=0.9, share_to_floor=0.7),
        "seconds": 5.0,
        "learning_seconds": 2.0,
        "memory_mb": 700.0,
    }
    verdict = verdict or ("explained" if causes else "no_gap")
    return Result(case=case, rise_percent=rise, verdict=verdict, causes=causes, **(usual | about))
