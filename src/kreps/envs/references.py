"""Reference values of the tasks: average reward per step of the restarting chain (p = 0.02)."""

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
"""From best to worst, at least two.  Many learners stop in the constant-torque local optimum: the
full torque held to one side.  Tests measure all but the best, which `benchmarks/` computes."""

REFERENCE_REWARDS["kreps/ImageSwingUp-v0"] = REFERENCE_REWARDS["kreps/SwingUp-v0"]
"""The same process observed by a camera: the optimum with full state information is a bound."""
