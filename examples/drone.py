"""A drone that holds its height in gusts of wind: the environment of the tutorials."""

import gymnasium as gym
import numpy as np


class Drone(gym.Env):
    """A mass of 1 kg with a rotor.

    Observation: height above the target in m, velocity in m/s.  Action: thrust in N beyond that
    which carries the weight, from -4 to 4.  A step is 0.1 s.
    """

    metadata = {"dt": 0.1, "render_modes": []}  # control period in s
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-4.0, 4.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-2.0, 2.0), 0.0])
        return self.state.astype(np.float32), {}

    def step(self, action):
        height, velocity = self.state
        force = np.clip(action, -4.0, 4.0)[0] + 0.5 * self.np_random.normal()
        velocity += 0.1 * (force - 0.2 * velocity)
        self.state = np.array([height + 0.1 * velocity, velocity])
        reward = -(self.state[0] ** 2) - 0.01 * float(action[0]) ** 2
        return self.state.astype(np.float32), reward, False, False, {}


gym.register("Drone-v0", Drone, max_episode_steps=100)
