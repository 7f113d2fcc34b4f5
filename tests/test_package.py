"""Cost of importing, public names, and speed of the control loop."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest

import kreps
from kreps.data.task import TaskSpec
from kreps.kernels.kernel import Kernel, factors_of
from kreps.policies.cost_sensitive_gp import CostSensitiveGP

LAZY = ("matplotlib", "PIL", "rich", "typer", "scipy", "pandas", "torch")


def printed(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout.strip()


def test_importing_takes_less_than_600_ms_of_cpu() -> None:
    # with the start of the interpreter; the smallest of three, as the machine may be shared
    code = "import kreps, time; print(time.process_time())"
    assert min(float(printed(code)) for _ in range(3)) < 0.6


def test_importing_loads_neither_plotting_nor_scipy() -> None:
    code = f"import kreps, sys; print([m for m in {LAZY!r} if m in sys.modules])"
    assert printed(code) == "[]"


def test_importing_registers_the_environments() -> None:
    code = "import gymnasium as gym, kreps; print(gym.make('kreps/SwingUp-v0').reset(seed=0)[0])"
    assert printed(code).startswith("[3.14")
    # with the module that registers it, as Gymnasium has it
    code = "import gymnasium as gym; print(gym.make('kreps:kreps/SwingUp-v0').reset(seed=0)[0])"
    assert printed(code).startswith("[3.14")


def test_learning_does_not_load_plotting() -> None:
    code = """
import gymnasium as gym, kreps, sys
learner = kreps.KREPS(gym.make("kreps/SwingUp-v0"), initial_rollouts=3)
learner.learn(1, progress=False)
print([m for m in ("matplotlib", "PIL", "rich", "typer") if m in sys.modules])
"""
    assert printed(code) == "[]"


def test_every_public_name_exists_and_is_documented() -> None:
    assert len(set(kreps.__all__)) == len(kreps.__all__)
    assert set(kreps.__all__) <= set(dir(kreps))
    for name in kreps.__all__:
        public = getattr(kreps, name)
        assert name == "PRESETS" or public.__doc__
    with pytest.raises(AttributeError, match="Nothing"):
        _ = kreps.Nothing


def test_all_errors_derive_from_one() -> None:
    errors = [getattr(kreps, n) for n in kreps.__all__ if n.endswith(("Error", "Failure"))]
    assert len(errors) >= 7
    assert all(issubclass(error, kreps.KrepsError) for error in errors)


def test_the_version_is_that_of_the_distribution() -> None:
    assert printed("import importlib.metadata as m; print(m.version('kreps'))") == kreps.__version__


def test_predict_with_1500_support_points_takes_less_than_a_millisecond() -> None:
    rng = np.random.default_rng(0)
    states = np.stack([rng.uniform(-1.5, 4.7, 1500), rng.uniform(-8.0, 8.0, 1500)], axis=1)
    process = CostSensitiveGP(
        task=TaskSpec(2, [-30.0], [30.0], (0,)),
        kernel=Kernel(factors_of(2, (0,)), np.array([0.6, 2.0])),
        states=states,
        targets=rng.normal(size=(1500, 1)),
        weights=rng.uniform(0.1, 3.0, 1500),
        signal=1.0,
        noise=0.3,
    )
    policy = kreps.Policy(process)
    queries = [row.copy() for row in states[rng.permutation(1500)]]
    percentiles = []
    for _ in range(3):
        seconds = np.empty(2000)
        for i in range(2000):
            started = time.thread_time()
            policy.predict(queries[i % 1500])
            seconds[i] = time.thread_time() - started
        percentiles.append(np.quantile(seconds, 0.99))
    assert min(percentiles) < 1e-3  # the best of three, as the machine may be shared
