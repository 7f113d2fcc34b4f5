"""A cart that has to stop at a flag far away, for the tutorial on a run that fails."""

import gymnasium as gym
import numpy as np


class Flag(gym.Env):
    """A cart of 1 kg on a rail.

    Observation: position in m, velocity in m/s.  Action: force in N, from -1 to 1.  A step is
    0.1 s.  The reward is 1 within 1 m of the flag at 8 m, minus a hundredth of the squared force.
    """

    metadata = {"dt": 0.1, "render_modes": []}
    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-0.1, 0.1), 0.0])
        return self.state.astype(np.float32), {}

    def step(self, action):
        position, velocity = self.state
        velocity += 0.1 * (np.clip(action, -1.0, 1.0)[0] - 0.2 * velocity)
        self.state = np.array([position + 0.1 * velocity, velocity])
        reward = float(abs(self.state[0] - 8.0) < 1.0) - 0.01 * float(action[0]) ** 2
        return self.state.astype(np.float32), reward, False, False, {}


gym.register("Flag-v0", Flag)
