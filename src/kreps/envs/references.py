"""Reference rewards of the tasks: average per step of the process with restarts (p = 0.02)."""

from __future__ import annotations

REFERENCE_RESTART_PROBABILITY = 0.02

REFERENCE_REWARDS: dict[str, dict[str, float]] = {
    "kreps/SwingUp-v0": {
        "optimum (dynamic programming)": -21.2,
        "local optimum (constant torque)": -61.9,
        "zero torque": -99.0,
        "uniformly random torque": -101.0,
    },
    "kreps/Reaching-v0": {
        "best known (direct optimal control)": -0.061,
        "random torques (0.5 N m)": -0.8,
    },
}
"""From best to worst, at least two per task.  The constant-torque local optimum is full torque to
one side at all times, with which many learners end.  Tests measure all but the first of each task,
which `benchmarks/` computes."""

REFERENCE_REWARDS["kreps/ImageSwingUp-v0"] = REFERENCE_REWARDS["kreps/SwingUp-v0"]
"""The same process observed as images, so that the optimum from states is an upper bound."""
