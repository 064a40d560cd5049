"""Results of the study of hidden effects, made up: what is hidden and what is named are known."""

from swarmtwin.diagnosis.result import Cause
from swarmtwin.studies.hidden_effects.cases import Case
from swarmtwin.studies.hidden_effects.results import HeldOutGain, Result


def result(kind, hidden, named=(), rise=20.0, verdict=None, rivals=(), **about):
    """A planted result; what is hidden and what is named in one word each."""
    names = hidden.split("+") if kind != "clean" else []
    case = Case(
        kind=kind,
        variety=hidden,
        robot=about.pop("robot", "mgr"),
        effects=tuple({"name": name} for name in names),
        runs=10,
        steps=10,
        seed=about.pop("seed", 1),
    )
    said = {"parameters": {}, "confidence": 1.0, "share_of_gap": 1.0, "evidence": ""}
    causes = tuple(Cause(name=name, rivals=rivals, **said) for name in named)
    usual = {
        "depends_on": (),
        "failure": None,
        "baselines": None,
        "gained": HeldOutGain(before_mm=4.0, after_mm=3.0, least_mm=2.5, share=0.9, share_to_floor=0.7),
        "seconds": 5.0,
    }
    verdict = verdict or ("explained" if causes else "no_gap")
    return Result(case=case, rise_percent=rise, verdict=verdict, causes=causes, **(usual | about))
