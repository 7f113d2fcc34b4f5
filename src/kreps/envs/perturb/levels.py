"""Perturbations by difficulty, with the numbers of the Real-World RL suite.

These are its "combined challenges" (Dulac-Arnold et al., Machine Learning 110, 2021), without those
of rewards, of physical parameters and of dummy coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypedDict

from kreps.envs.perturb.perturbation import Perturbation
from kreps.envs.perturb.sensors import Delay, Dropped, Noise, Stuck
from kreps.errors import ConfigurationError

LEVELS: dict[str, Mapping[str, Perturbation]] = {
    "easy": {
        "noise": Noise(0.1),
        "dropped": Dropped(0.01, 1),
        "stuck": Stuck(0.01, 1),
        "delay": Delay(3),
    },
    "medium": {
        "noise": Noise(0.3),
        "dropped": Dropped(0.05, 5),
        "stuck": Stuck(0.05, 5),
        "delay": Delay(6),
    },
    "hard": {
        "noise": Noise(1.0),
        "dropped": Dropped(0.1, 10),
        "stuck": Stuck(0.1, 10),
        "delay": Delay(9),
    },
}
"""By level and name, in the order in which observations are perturbed."""


class Sides(TypedDict):
    """The perturbations of both signals, as arguments of `Perturbed`."""

    actions: list[Perturbation]
    observations: list[Perturbation]


def level(name: str) -> Sides:
    """All perturbations of a level: ``Perturbed(env, **level("easy"))``.

    Actions are delayed, then noisy; observations are noisy, dropped, stuck, then delayed.

    Raises:
        ConfigurationError: no such level.
    """
    if name not in LEVELS:
        raise ConfigurationError(f"level {name!r:.60} is none of {', '.join(LEVELS)}")
    found = LEVELS[name]
    return Sides(actions=[found["delay"], found["noise"]], observations=list(found.values()))
