"""Versions of the software that a result depends on."""

from __future__ import annotations

import platform
from importlib.metadata import version

import numpy as np
import scipy


def versions() -> dict[str, str]:
    """Of kreps, NumPy, SciPy and Python, by name, as result files record them."""
    return {
        "kreps": version("kreps"),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "python": platform.python_version(),
    }
