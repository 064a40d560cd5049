"""What vehicles carry from one control period to the next."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from swarmtwin.geometry import displacement_between


@dataclass(frozen=True)
class State:
    """W worlds of K vehicles of one robot at one moment. Nothing in it ever changes: a step returns another state.

    Attributes:
        pose: (W, K, 3) true poses x_mm, y_mm, heading_rad in the arena's frame, float64.
        elapsed_s: (W, K) time since the session began.
        previous_command: (W, K, m) the command that was in force last; NaN where none was.
        earlier_command: (W, K, m) the command in force before that one; NaN where none was.
        velocity: (W, K, 3) forward_mm_s, left_mm_s, turn_rad_s, the twist of the last simulated displacement over its
            duration; 0 at the start.
        memory: what actuators and mechanisms carry on, each (W, K, ...), by name.
    """

    pose: Tensor
    elapsed_s: Tensor
    previous_command: Tensor
    earlier_command: Tensor
    velocity: Tensor
    memory: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def neighbours(self) -> Tensor:
        """The others of its world as seen from each vehicle, (W, K, K − 1, 3): forward_mm, left_mm, turn_rad."""
        return self.neighbours_at(self.pose)

    def neighbours_at(self, pose: Tensor) -> Tensor:
        """Return the same of others that are at poses (W, K, 3) by then, seen from where each vehicle is now."""
        vehicles = pose.shape[1]
        others = [[other for other in range(vehicles) if other != own] for own in range(vehicles)]
        others_pose = pose[:, torch.tensor(others, dtype=torch.long).reshape(vehicles, vehicles - 1)]
        return displacement_between(self.pose[:, :, None], others_pose)

    def __getitem__(self, worlds: Tensor | slice) -> "State":
        return State.of_parts({name: values[worlds] for name, values in self.parts().items()})

    def with_worlds(self, worlds: Tensor, other: "State") -> "State":
        """Return it with the worlds at indices (n,) replaced by the n worlds of another state."""
        changed = {name: values.clone() for name, values in self.parts().items()}
        for name, values in other.parts().items():
            changed[name][worlds] = values
        return State.of_parts(changed)

    def of_vehicles(self, vehicles: slice) -> "State":
        """Return some vehicles of each world; those are then each other's only neighbours."""
        return State.of_parts({name: values[:, vehicles] for name, values in self.parts().items()})

    @classmethod
    def side_by_side(cls, groups: Sequence["State"]) -> "State":
        """Return the same worlds with the vehicles of several states, one after the other."""
        parts = [group.parts() for group in groups]
        return cls.of_parts({name: torch.cat([part[name] for part in parts], dim=1) for name in parts[0]})

    @classmethod
    def of_worlds(cls, worlds: Sequence[Tensor], states: Sequence["State"]) -> "State":
        """Return all worlds of several states, each with the places (n,) of its worlds, in the order of the places."""
        order = torch.cat(list(worlds)).argsort()
        parts = [state.parts() for state in states]
        return cls.of_parts({name: torch.cat([part[name] for part in parts])[order] for name in parts[0]})

    def parts(self) -> dict[str, Tensor]:
        """Return all its tensors by name, for a checkpoint; those of the memory begin with `memory: `."""
        names = ("pose", "elapsed_s", "previous_command", "earlier_command", "velocity")
        named = {name: getattr(self, name) for name in names}
        return named | {f"memory: {name}": values for name, values in self.memory.items()}

    @classmethod
    def of_parts(cls, parts: Mapping[str, Tensor]) -> "State":
        """Put a state together from its `parts`; those of a checkpoint of an old version have no velocity."""
        parts = {"velocity": torch.zeros_like(parts["pose"]), **parts}
        memory = {name.removeprefix("memory: "): part for name, part in parts.items() if name.startswith("memory: ")}
        return cls(**{name: part for name, part in parts.items() if not name.startswith("memory: ")}, memory=memory)
