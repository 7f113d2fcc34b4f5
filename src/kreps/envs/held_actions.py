"""Holding an action for several steps, so that a policy decides less often than it could."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from kreps.intake import as_flag, as_number


class HeldActions(gym.Wrapper[Any, Any, Any, Any]):
    """Takes each action several times and sums the rewards; an end of the episode ends the hold.

    Args:
        env: any Gymnasium environment.
        repeat: steps of ``env`` in one of this wrapper, at most.

    Attributes:
        steps_taken: steps of ``env`` since the wrapper was made.
    """

    def __init__(self, env: gym.Env[Any, Any], repeat: int) -> None:
        super().__init__(env)
        self.repeat = repeat
        self.steps_taken = 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """So many steps as the action is held for, with the last observation and flags.

        Raises:
            DataError: a reward or flag that is none.
        """
        total = 0.0
        for _ in range(self.repeat):
            observation, reward, ended, cut, info = self.env.step(action)
            self.steps_taken += 1
            total += as_number("reward", reward)
            terminated, truncated = as_flag("terminated", ended), as_flag("truncated", cut)
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


def held(env: gym.Env[Any, Any], repeat: int) -> gym.Env[Any, Any]:
    """The environment with each action held; itself if it holds them already, or not at all."""
    return env if repeat == 1 or isinstance(env, HeldActions) else HeldActions(env, repeat)
