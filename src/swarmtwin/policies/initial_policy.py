"""The policy that learning goes on from instead of from nothing, such as in a simulation that a diagnosis extended."""

import hashlib
from collections.abc import Mapping
from typing import NamedTuple, Self

import numpy as np

from swarmtwin.errors import UserError
from swarmtwin.policies.algorithm import AlgorithmConfig
from swarmtwin.policies.policy_folder import InitialOrigin, StoredPolicy
from swarmtwin.world.task import Task


class InitialPolicy(NamedTuple):
    """A policy by its weights.

    Attributes:
        source: how it was named: a folder, models:/NAME/VERSION, or what it was learned in.
        weights: by name.
    """

    source: str
    weights: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, source: str, stored: StoredPolicy, task: Task, algorithm: AlgorithmConfig) -> Self:
        """Take the weights of a stored policy, for an algorithm that is to learn a task.

        Raises:
            UserError: the policy looks at other numbers, or the algorithm's network is another one.
        """
        looks_at, shown = stored.policy.observation_names, task.observation_names
        if looks_at != shown:
            raise UserError(
                f"start_from={source}: that policy, of task {stored.task.name!r}, looks at {len(looks_at)} numbers "
                f"that are not the {len(shown)} that task {task.config.name!r} shows: give the options of the task "
                "that it was learned with, or leave start_from out"
            )
        if stored.policy.architecture != algorithm.architecture:
            layers = ",".join(str(width) for width in stored.policy.architecture.layers)
            raise UserError(
                f"start_from={source}: its network is another than that of policy={algorithm.name}: learn with "
                f"policy={stored.provenance.algorithm['name']} policy.layers=[{layers}], as it was learned"
            )
        return cls(source, {name: tensor.numpy().copy() for name, tensor in stored.policy.state_dict().items()})

    @property
    def origin(self) -> InitialOrigin:
        """What a policy's description says of it."""
        whole = hashlib.sha256()
        for name, values in sorted(self.weights.items()):
            whole.update(name.encode())
            whole.update(np.ascontiguousarray(values).tobytes())
        return InitialOrigin(source=self.source, digest=whole.hexdigest())
