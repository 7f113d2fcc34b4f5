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
}
