"""Gradient-boosted regression trees (Friedman 2001), one sum of trees for each component of the displacement.

Scikit-learn's histogram-based boosting fits them. What it finds is kept as arrays, so that a model folder holds plain
numbers as every other one does, nothing pickled, and no scikit-learn is needed to predict.
"""

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from swarmtwin.dynamics.model_config import FittedModelConfig, Steps
from swarmtwin.learning.batches import Examples
from swarmtwin.learning.encoding import ScalingMethod
from swarmtwin.robot import Positive, Robot

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingRegressor


class BoostedTrees(nn.Module):
    """Sums of binary trees: standardised inputs (N, inputs) → standardised displacements (N, 3).

    Each of the 3 · `trees` trees has room for `leaves` − 1 questions, asked of one input each: "at most the threshold?"
    leads left. Where an answer leads says a number: 0 and above the next question, below it the leaf −1 − number. Trees
    that were not grown ask a question whose answers both lead to a leaf of value 0.
    """

    feature: Tensor
    threshold: Tensor
    left: Tensor
    right: Tensor

    def __init__(self, trees: int, leaves: int, depth: int) -> None:
        """Make room for trees that say nothing yet.

        Args:
            trees: for each component of the displacement.
            leaves: of a tree, at most.
            depth: questions between a tree's root and a leaf, at most.
        """
        super().__init__()
        self.depth = depth
        self.register_buffer("feature", torch.zeros(3 * trees, leaves - 1, dtype=torch.int16))
        self.register_buffer("threshold", torch.zeros(3 * trees, leaves - 1, dtype=torch.float64))
        self.register_buffer("left", torch.full((3 * trees, leaves - 1), -1, dtype=torch.int16))
        self.register_buffer("right", torch.full((3 * trees, leaves - 1), -1, dtype=torch.int16))
        self.leaf_value = nn.Parameter(torch.zeros(3 * trees, leaves))
        self.usual = nn.Parameter(torch.zeros(3))

    def forward(self, values: Tensor) -> Tensor:
        """Sum what each component's trees say of inputs (N, inputs)."""
        tree = torch.arange(len(self.feature), device=values.device)
        feature, left, right = self.feature.long(), self.left.long(), self.right.long()
        asked = values.double()
        at = torch.zeros(len(values), len(tree), dtype=torch.long, device=values.device)
        for _ in range(self.depth):
            question = at.clamp(min=0)
            is_at_most = asked.gather(1, feature[tree, question]) <= self.threshold[tree, question]
            led = torch.where(is_at_most, left[tree, question], right[tree, question])
            at = torch.where(at >= 0, led, at)
        total: Tensor = self.leaf_value[tree, -1 - at].reshape(len(values), 3, -1).sum(dim=-1) + self.usual
        return total

    def take(self, component: int, fitted: "HistGradientBoostingRegressor") -> None:
        """Take over the trees that scikit-learn has grown for one component of the displacement."""
        first = component * len(self.feature) // 3
        with torch.no_grad():
            self.usual[component] = float(np.squeeze(fitted._baseline_prediction))
            for number, (predictor,) in enumerate(fitted._predictors, start=first):
                self._take_tree(number, predictor.nodes)

    def _take_tree(self, number: int, nodes: Any) -> None:
        """Take over one tree, whose nodes are a record array with the root first."""
        is_leaf = nodes["is_leaf"].astype(bool)
        place = np.where(is_leaf, -np.cumsum(is_leaf), np.cumsum(~is_leaf) - 1)
        questions, leaves = nodes[~is_leaf], nodes[is_leaf]
        columns = {"feature": questions["feature_idx"], "threshold": questions["num_threshold"]}
        columns |= {"left": place[questions["left"]], "right": place[questions["right"]]}
        for name, column in columns.items():
            row = getattr(self, name)[number]
            row[: len(questions)] = torch.as_tensor(np.asarray(column, dtype=float)).to(row)
        self.leaf_value[number, : len(leaves)] = torch.as_tensor(leaves["value"].astype(np.float32))


class Config(FittedModelConfig):
    """`conf/model/boosted_trees.yaml`.

    Attributes:
        learning_rate: what each tree counts (shrinkage); recipes have no say in it.
        steps: trees for each component, at most: growing ends when the validation runs gain nothing for `patience`.
        leaves: of a tree, at most.
        depth: questions between a tree's root and a leaf, at most.
        least_in_leaf: transitions that a leaf answers for, at least.
        patience: trees without a gain on the validation runs after which no more are grown.
    """

    scaling: ClassVar[ScalingMethod] = "standard"

    name: Literal["boosted_trees"] = "boosted_trees"
    learning_rate: Positive = 0.1
    steps: Steps = 300
    leaves: Annotated[int, Field(ge=2, le=1024)] = 31
    depth: Annotated[int, Field(ge=1, le=32)] = 8
    least_in_leaf: Annotated[int, Field(ge=1)] = 20
    patience: Annotated[int, Field(ge=1)] = 10

    def build(self, robot: Robot, inputs: int) -> nn.Module:
        """Make room for the trees."""
        return BoostedTrees(self.steps, self.leaves, self.depth)

    def fit(self, network: nn.Module, train: Examples, validation: Examples, seed: int) -> None:
        """Grow each component's trees on one thread, by least squares."""
        from sklearn.ensemble import HistGradientBoostingRegressor  # for learning alone: robots' computers lack it
        from threadpoolctl import threadpool_limits

        assert isinstance(network, BoostedTrees)
        (inputs, outputs), (asked, answers) = (
            tuple(part.double().numpy() for part in each) for each in (train, validation)
        )
        for component in range(3):
            regressor = HistGradientBoostingRegressor(
                learning_rate=self.learning_rate,
                max_iter=self.steps,
                max_leaf_nodes=self.leaves,
                max_depth=self.depth,
                min_samples_leaf=self.least_in_leaf,
                early_stopping=True,
                n_iter_no_change=self.patience,
                random_state=seed,
            )
            with threadpool_limits(1):
                regressor.fit(inputs, outputs[:, component], X_val=asked, y_val=answers[:, component])
            network.take(component, regressor)
