"""Delays, sensor failures and imperfect actuators, around any environment with Box spaces.

See `docs/perturbations.md` for the list with units.
"""

from kreps.envs.perturb.actuators import Backlash, DeadZone, Lag
from kreps.envs.perturb.levels import LEVELS, level
from kreps.envs.perturb.perturbation import Perturbation
from kreps.envs.perturb.sensors import Delay, Dropped, Hidden, Noise, Stuck
from kreps.envs.perturb.wrapper import Perturbed, PerturbedBatch

__all__ = [
    "LEVELS",
    "Backlash",
    "DeadZone",
    "Delay",
    "Dropped",
    "Hidden",
    "Lag",
    "Noise",
    "Perturbation",
    "Perturbed",
    "PerturbedBatch",
    "Stuck",
    "level",
]
