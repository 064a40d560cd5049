"""Searches hyper-parameters of a generator."""

from collections.abc import Mapping
from typing import Any, ClassVar, cast

from swarmtwin.errors import UserError
from swarmtwin.generators.generator import GeneratorConfig, generator_config
from swarmtwin.generators.synthesis import synthesise
from swarmtwin.generators.training import Record
from swarmtwin.robot import StrictModel
from swarmtwin.studies.hyperparameter_search import HyperparameterSearch, LossReport, Outcome
from swarmtwin.tracking.runs import Experiment
from swarmtwin.transitions import Preparation, Transitions


class GeneratorSearch(HyperparameterSearch):
    """The loss is how well boosted trees tell what was drawn from the validation runs: 0.5 where they cannot, up to 1.

    Trials are broken off by the sum of the generator's own validation figures while it is trained.

    Attributes:
        generator: options of the generator, as in conf/generator.
    """

    experiment: ClassVar[Experiment] = "generator"
    headings: ClassVar[Mapping[str, str]] = {
        "precision": "precision",
        "recall": "recall",
        "nearer_to_learned": "nearer to\nlearned",
    }

    generator: dict[str, Any]

    @property
    def options(self) -> dict[str, dict[str, Any]]:
        """The group `generator`."""
        return {"generator": self.generator}

    def parsed(self, options: Mapping[str, dict[str, Any]]) -> dict[str, StrictModel]:
        """Return a `GeneratorConfig`."""
        return {"generator": generator_config(options["generator"], "generator")}

    def trained(
        self,
        configs: Mapping[str, StrictModel],
        transitions: Transitions,
        preparation: Preparation,
        report: LossReport,
    ) -> Outcome:
        """Train a generator, draw as many transitions as it learned from, and compare them with the validation runs."""
        if preparation.origin != "real":
            raise UserError(f"these are {preparation.origin} transitions: a generator learns from real ones only")
        config = cast(GeneratorConfig, configs["generator"])

        def tell(record: Record, steps: int) -> None:
            figures = [figure for name, figure in record.items() if name.startswith("validation")]
            report(int(record["step"]), steps, sum(figures))

        made = synthesise(
            transitions, preparation, config, self.seed, real=None, count=None, report=tell, device=self.device
        )
        figures = made.quality.tracked()
        return Outcome(figures["told_apart"], {name: figures[name] for name in self.headings})
