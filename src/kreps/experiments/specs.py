"""What is compared in each experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True)
class Method:
    """One way to learn: a recipe of `kreps.KREPS` with some settings changed."""

    recipe: str
    settings: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True)
class Experiment:
    """Methods on one task by one protocol.

    Attributes:
        environment: Gymnasium name.
        iterations: policy updates of each trial.
        methods: by the name that figures and tables show.
    """

    environment: str
    iterations: int
    methods: Mapping[str, Method]


EXPERIMENTS: dict[str, Experiment] = {
    "swing-up": Experiment(
        environment="kreps/SwingUp-v0",
        iterations=20,
        methods={
            "kreps (default)": Method("default"),
            "paper-like": Method("paper"),
        },
    ),
    # the paper's first policy on this task, N(0, 0.5^2) N m, in units of half the range
    "reaching": Experiment(
        environment="kreps/Reaching-v0",
        iterations=15,
        methods={
            "kreps (default)": Method(
                "default", {"exploration": "gaussian", "exploration_scale": 0.05}
            ),
            "sample model": Method(
                "default",
                {"model": "sample", "exploration": "gaussian", "exploration_scale": 0.05},
            ),
        },
    ),
}
