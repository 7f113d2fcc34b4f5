"""Golden values: presets that follow a source must not move with work on the default.

Actions and V after two updates on small data, from one run of each preset.  They are compared to
1e-3 of the largest, as other builds of BLAS may end the fits of hyper-parameters elsewhere.  Where
a number is to change, ``python tests/test_golden.py`` prints those for ``data/golden.json``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from kreps.learning.methods import LEARNERS

TINY = {"initial_rollouts": 6, "rollouts_per_iteration": 3, "window": 8}
STATES = {
    2: [[0.1, -0.5], [2.0, 1.0], [4.0, -3.0]],
    4: [[0.1, -0.5, 1.0, 0.0], [1.5, 0.3, -1.0, 2.0], [-2.0, 1.0, 0.0, -1.0]],
}
CASES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "paper, swing-up": ("reps", "kreps/SwingUp-v0", {"preset": "paper"}),
    "paper, reaching": ("reps", "kreps/Reaching-v0", {"preset": "paper"}),
    "authors, swing-up": ("reps", "kreps/AuthorsSwingUp-v0", {"preset": "authors"}),
    "authors, reaching": ("reps", "kreps/AuthorsReaching-v0", {"preset": "authors"}),
    "authors, value iteration": (
        "value-iteration",
        "kreps/AuthorsSwingUp-v0",
        {"preset": "authors"},
    ),
    "authors, NPALP": ("npalp", "kreps/AuthorsReaching-v0", {"preset": "authors"}),
}


def numbers(name: str) -> dict[str, list[float]]:
    """Actions, with and without noise, and V where there is one, after two updates."""
    method, environment, options = CASES[name]
    learner = LEARNERS[method](gym.make(environment), seed=5, **TINY, **options)
    learner.learn(2, progress=False)
    states = np.array(STATES[learner.task.observation_size])
    noise = np.array([[0.3], [-1.2], [0.7]]) * np.ones(learner.task.action_size)
    policy, value = learner.policy.process, learner.state.value
    found = {"greedy": policy.greedy(states), "act": policy.act(states, noise)}
    found |= {} if value is None else {"value": value(states)}
    return {part: values.ravel().tolist() for part, values in found.items()}


GOLDEN = json.loads((Path(__file__).parent / "data" / "golden.json").read_text())


@pytest.mark.parametrize("name", CASES)
def test_learning_by_a_source_has_not_moved(name: str) -> None:
    found, golden = numbers(name), GOLDEN[name]
    assert found.keys() == golden.keys()
    for part, values in golden.items():
        scale = np.abs(values).max()
        np.testing.assert_allclose(found[part], values, atol=1e-3 * scale, err_msg=part)


if __name__ == "__main__":
    print(json.dumps({name: numbers(name) for name in CASES}, indent=1))
