"""A mixture of normal distributions of whole rows, fitted by expectation maximisation: the plain reference.

scikit-learn's `GaussianMixture` with full covariances, on standardised columns, headings as cosine and sine.
"""

import warnings
from typing import Annotated, Literal

import torch
from pydantic import Field
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture
from torch import Tensor

from swarmtwin.generators.columns import Columns
from swarmtwin.generators.generator import Generator, GeneratorConfig, GeneratorTraining, RealRows, Steps
from swarmtwin.learning.encoding import Scaling


class MixtureOfRows(Generator):
    """Weights, means and triangular factors of covariances of the components.

    Attributes:
        weights: (components,).
        means: (components, columns), of standardised columns.
        factors: (components, columns, columns), lower triangular; a factor times its transpose is the covariance.
    """

    config: "Config"
    weights: Tensor
    means: Tensor
    factors: Tensor

    def __init__(self, columns: Columns, config: "Config") -> None:
        super().__init__(columns, config)
        width, components = columns.width + len(columns.headings), config.components
        self.scaling = Scaling(width, "standard")
        self.register_buffer("weights", torch.full((components,), 1 / components))
        self.register_buffer("means", torch.zeros(components, width))
        self.register_buffer("factors", torch.eye(width).repeat(components, 1, 1))

    def sample(self, count: int, rng: torch.Generator) -> Tensor:
        """Draw a component for each row, then the row."""
        component = torch.multinomial(self.weights.cpu(), count, replacement=True, generator=rng)
        noise = torch.randn(count, self.means.shape[1], generator=rng).to(self.means.device)
        standard = torch.einsum("nij,nj->ni", self.factors[component], noise) + self.means[component]
        return self.columns.with_angles(self.scaling.inverse(standard))


class MixtureTraining(GeneratorTraining):
    """One iteration of expectation maximisation a step, until it has converged."""

    generator: MixtureOfRows

    def __init__(self, generator: MixtureOfRows, real: RealRows) -> None:
        super().__init__(generator)
        config, rows = generator.config, generator.columns.with_directions(real.train)
        generator.scaling.learn(rows)
        self.rows = generator.scaling(rows).double().numpy()
        self.validation_rows = generator.scaling(generator.columns.with_directions(real.validation)).double().numpy()
        self.mixture = GaussianMixture(
            config.components,
            init_params="k-means++",
            tol=config.tolerance,
            reg_covar=config.least_variance,
            max_iter=1,
            warm_start=True,
            random_state=int(torch.randint(2**31, ())),
        )

    def configure_optimizers(self) -> None:
        """None: no gradient is followed."""

    def training_step(self, step: int, batch_index: int) -> dict[str, Tensor]:
        """Take an iteration, unless the last one changed nothing any more."""
        if not getattr(self.mixture, "converged_", False):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)
                self.mixture.fit(self.rows)
        return {"negative_log_likelihood": torch.tensor(-self.mixture.lower_bound_)}

    def validation_figures(self) -> dict[str, float]:
        """Take the mixture over into the generator; return what it makes of validation rows, in nats a row."""
        generator, mixture = self.generator, self.mixture
        generator.weights.copy_(torch.as_tensor(mixture.weights_))
        generator.means.copy_(torch.as_tensor(mixture.means_))
        generator.factors.copy_(torch.linalg.cholesky(torch.as_tensor(mixture.covariances_)))
        return {"validation_negative_log_likelihood": -float(mixture.score(self.validation_rows))}


class Config(GeneratorConfig):
    """`conf/generator/gaussian_mixture.yaml`.

    Attributes:
        components: of the mixture.
        iterations: of expectation maximisation, at most.
        tolerance: it has converged when the log-likelihood of a row grows by less, in nats.
        least_variance: added to each column's variance in every component, of standardised columns.
    """

    name: Literal["gaussian_mixture"] = "gaussian_mixture"
    components: Steps = 50
    iterations: Steps = 100
    tolerance: Annotated[float, Field(ge=0)] = 1e-3
    least_variance: Annotated[float, Field(ge=0)] = 1e-5

    @property
    def training_steps(self) -> int:
        """The iterations."""
        return self.iterations

    def build(self, columns: Columns) -> MixtureOfRows:
        """Build it."""
        return MixtureOfRows(columns, self)

    def training(self, generator: Generator, real: RealRows) -> MixtureTraining:
        """Return its training."""
        assert isinstance(generator, MixtureOfRows)
        return MixtureTraining(generator, real)
