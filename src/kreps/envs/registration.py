"""Registration of the tasks with Gymnasium, for ``gymnasium.make("kreps/SwingUp-v0")``."""

from __future__ import annotations

import gymnasium as gym

ENVIRONMENTS = {
    "kreps/SwingUp-v0": "kreps.envs.swing_up:SwingUp",
    "kreps/Reaching-v0": "kreps.envs.reaching:Reaching",
    "kreps/ImageSwingUp-v0": "kreps.envs.image_swing_up:ImageSwingUp",
    "kreps/AuthorsSwingUp-v0": "kreps.envs.authors.swing_up:AuthorsSwingUp",
    "kreps/AuthorsReaching-v0": "kreps.envs.authors.reaching:AuthorsReaching",
    "kreps/AuthorsImageSwingUp-v0": "kreps.envs.authors.image_swing_up:AuthorsImageSwingUp",
}


def register() -> None:
    """Register every task that is not registered yet."""
    for name, entry_point in ENVIRONMENTS.items():
        if name not in gym.registry:
            gym.register(id=name, entry_point=entry_point)
