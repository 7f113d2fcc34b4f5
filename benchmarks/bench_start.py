"""A new process: importing the library, and learning the first policy."""

from __future__ import annotations

import resource
import subprocess
import sys
from functools import partial

import pytest
from criteria import Beyond, Seconds
from measuring import Measure

IMPORT = "import kreps"
FIRST_POLICY = """
import gymnasium, kreps
kreps.KREPS(gymnasium.make("kreps/SwingUp-v0"), seed=0).learn(1, progress=False).policy
"""


def children() -> float:
    """CPU seconds of all processes started and ended so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def python(program: str) -> None:
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.benchmark(timer=children)
def bench_import(measure: Measure) -> None:
    work = partial(python, IMPORT)
    measure("fresh process, import kreps", "", work, Seconds(), rounds=5)


@pytest.mark.benchmark(timer=children)
def bench_first_policy(measure: Measure) -> None:
    """The learner and SciPy are imported at first use, not by ``import kreps``."""
    measure(
        "fresh process, to the first policy",
        "30 rollouts",
        partial(python, FIRST_POLICY),
        Beyond("import kreps", partial(python, IMPORT), at_most=1.0),
        Beyond("from kreps import KREPS", partial(python, "from kreps import KREPS")),
        rounds=5,
    )
