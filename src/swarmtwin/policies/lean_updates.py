"""DDPG and TD3 with the gradient steps of stable-baselines3, the same numbers in less time.

The networks are so small that much of a gradient step of stable-baselines3 is bookkeeping. Here

- the parameters of a network are views of one vector: the optimiser moves that, and the target follows it, in one
  operation each, whatever the number of layers;
- the gradient of the actor's loss is formed for the actor alone, not for the critic as well;
- no loss is recorded, which on a GPU would wait for it to be computed;
- noise for exploration is drawn at once for all vehicles.

The networks must be the same in training and in use: without dropout, without batch normalisation.
"""

import numpy as np
import torch
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.noise import ActionNoise, NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import functional as F
from torch.nn.utils import parameters_to_vector, vector_to_parameters


class LeanTD3(TD3):
    """TD3, twin delayed DDPG (Fujimoto et al. 2018), with lean gradient steps.

    Attributes:
        critic_updates: gradient steps that the critics learn for before the actor begins. A critic that knows nothing
            yet can drive the actor's outputs to their limits within a hundred of them, where its gradient vanishes.
    """

    critic_updates = 0

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Do gradient steps, each with a minibatch of its own."""
        assert self.replay_buffer is not None
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        for _ in range(gradient_steps):
            self._n_updates += 1
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            values = self.critic(batch.observations, batch.actions)
            wanted = self._wanted_value(batch)
            self._critic_vector.descend(torch.stack([F.mse_loss(value, wanted) for value in values]).sum())
            if self._n_updates % self.policy_delay == 0:
                if self._n_updates > self.critic_updates:
                    chosen = self.actor(batch.observations)
                    self._actor_vector.descend(-self.critic.q1_forward(batch.observations, chosen).mean())
                self._critic_vector.lead(self._critic_target_vector, self.tau)
                self._actor_vector.lead(self._actor_target_vector, self.tau)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what the vehicles do and what is remembered of it: the same, for actions of −1…1."""
        if self.num_timesteps < learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        with torch.no_grad():
            action = self.actor(torch.as_tensor(self._last_obs, device=self.device)).cpu().numpy()
        if action_noise is not None:
            if isinstance(action_noise, SharedGaussianNoise):
                action_noise.reach(self.num_timesteps // n_envs)
            action = np.clip(action + action_noise(), -1.0, 1.0)
        return action, action

    def _setup_model(self) -> None:
        super()._setup_model()
        self._actor_vector, self._actor_target_vector = _Vector(self.actor), _Vector(self.actor_target)
        self._critic_vector, self._critic_target_vector = _Vector(self.critic), _Vector(self.critic_target)
        for vector in (self._actor_vector, self._critic_vector):
            vector.network.optimizer = self.policy.optimizer_class(
                [vector.values],
                lr=self.lr_schedule(1.0),  # type: ignore[call-arg]
                **self.policy.optimizer_kwargs,
            )

    @torch.no_grad()
    def _wanted_value(self, batch: ReplayBufferSamples) -> torch.Tensor:
        """Return what the critics should say: reward, and the lower of the targets' values of what follows, (B, 1)."""
        action = self.actor_target(batch.next_observations)
        if self.target_noise_clip > 0:
            noise = torch.empty_like(action).normal_(0, self.target_policy_noise)
            action = (action + noise.clamp_(-self.target_noise_clip, self.target_noise_clip)).clamp_(-1, 1)
        values = torch.cat(self.critic_target(batch.next_observations, action), dim=1)
        discount = self.gamma if batch.discounts is None else batch.discounts
        return batch.rewards + (1 - batch.dones) * discount * values.amin(dim=1, keepdim=True)


class LeanDDPG(LeanTD3, DDPG):
    """DDPG, deep deterministic policy gradient, with lean gradient steps: one critic, no delay, no noise on targets."""


class SharedGaussianNoise(VectorizedActionNoise):
    """Noise for exploration: normal, drawn for all sub-environments at once.

    Attributes:
        spread: its standard deviation now, on actions of −1…1.
        first: in the beginning.
        last: in the end.
        steps: control periods over which it goes straight from the first to the last.
        shape: sub-environments and columns of an action.
    """

    def __init__(self, env: VecEnv, first: float, last: float, steps: int) -> None:
        assert env.action_space.shape is not None
        self.spread = self.first = first
        self.last = last
        self.steps = steps
        self.shape = (env.num_envs, *env.action_space.shape)
        mean = np.zeros(env.action_space.shape)
        super().__init__(NormalActionNoise(mean, np.full_like(mean, first)), env.num_envs)

    def reach(self, step: int) -> None:
        """Take the standard deviation of a control period."""
        self.spread = self.first + (self.last - self.first) * min(1.0, step / self.steps)

    def __call__(self) -> np.ndarray:
        """Return the noise of one control period, (sub-environments, m)."""
        return np.random.normal(0.0, self.spread, self.shape).astype(np.float32)  # noqa: NPY002 — as the library draws


class _Vector:
    """All parameters of a network as one vector of which they are views.

    Attributes:
        network: the network.
        values: its parameters, one after the other.
    """

    def __init__(self, network: BaseModel) -> None:
        self.network = network
        self._parameters = list(network.parameters())
        self.values = parameters_to_vector(self._parameters).detach()
        vector_to_parameters(self.values, self._parameters)

    def descend(self, loss: torch.Tensor) -> None:
        """Let the network's optimiser do one step down the slope of a loss."""
        slopes = torch.autograd.grad(loss, self._parameters)
        self.values.grad = parameters_to_vector(slopes)
        self.network.optimizer.step()

    @torch.no_grad()
    def lead(self, target: "_Vector", share: float) -> None:
        """Let a target follow by a share of the way."""
        target.values.lerp_(self.values, share)
