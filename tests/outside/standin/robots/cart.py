"""A stand-in of the cart: wheels that follow at once. Unit 9 is worn: it loses a third of its speed in reverse."""

from dataclasses import dataclass

import numpy as np

from swarmtwin.standin.physics import Physics, Unit


@dataclass(frozen=True)
class CartUnit(Unit):
    """How fast each vehicle goes in reverse, over how fast it goes ahead, (V,)."""

    reverse: np.ndarray

    @classmethod
    def of(cls, vehicles, dtype=np.float64):
        return cls(np.array([2 / 3 if vehicle == "9" else 1.0 for vehicle in vehicles], dtype))


class StandIn(Physics):
    """Effort → speed of the wheels → motion of the body."""

    unit_class = CartUnit
    command_columns = ("left", "right")
    states = ("x_mm", "y_mm", "heading_rad")
    substeps = 5
    noises = 2
    position_noise_mm = 0.5
    heading_noise_rad = 0.005
    resting_command = (0.0, 0.0)
    memory_of_place = False
    latent_draws = 32
    bank_rows = 4096

    def target(self, command, strength):
        return np.where(command < 0, command * self.unit.reverse, command) * strength

    def step(self, state, target, dt_s, surroundings, noise):
        travel = target * dt_s * surroundings.traction
        if noise is not None:
            travel = travel * (1 + 0.03 * self.conditions.noise_factor / np.sqrt(dt_s) * noise)
        forward_mm, turn_rad = (travel[0] + travel[1]) / 2, (travel[1] - travel[0]) / 80
        after = state.copy()
        after[0] += np.cos(state[2] + turn_rad / 2) * forward_mm + surroundings.carried_x_mm_s * dt_s
        after[1] += np.sin(state[2] + turn_rad / 2) * forward_mm + surroundings.carried_y_mm_s * dt_s
        after[2] += turn_rad
        return after

    def guess(self, command):
        forward_mm, turn_rad = command.mean(axis=-1) / 2, (command[..., 1] - command[..., 0]) / 160
        return np.stack([forward_mm, forward_mm * turn_rad / 2, turn_rad], axis=-1)
