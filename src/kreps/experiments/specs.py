"""What is compared: tasks, methods, and which of them each figure shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from kreps.evaluation import EPISODES

Options = Mapping[str, Any]


def _none() -> Options:
    return MappingProxyType({})


@dataclass(frozen=True)
class Task:
    """One task and its protocol.

    Attributes:
        environment: Gymnasium name.
        iterations: policy updates of each trial.
        exploration: options of every learner that explores by itself.
        ranges: of the grid of states, for the learner that has one (an angle gets a whole turn).
        episodes: of the evaluation after each update; the last policy is evaluated in full.
    """

    environment: str
    iterations: int
    exploration: Options = field(default_factory=_none)
    ranges: tuple[tuple[float, float], ...] | None = None
    episodes: int = 10


TASKS: dict[str, Task] = {
    # first policy as in the paper: N(0, 0.5^2) N m, here in units of half the range
    "reaching": Task(
        "kreps/Reaching-v0",
        15,
        {"exploration": "gaussian", "exploration_scale": 0.05},
        ranges=((-4.0, 4.0), (-4.0, 4.0), (-8.0, 8.0), (-8.0, 8.0)),
    ),
    "swing-up": Task(
        "kreps/SwingUp-v0", 20, ranges=((-2.0, 5.0), (-12.0, 12.0)), episodes=EPISODES
    ),
    "images": Task("kreps/ImageSwingUp-v0", 15),
}


@dataclass(frozen=True)
class Method:
    """One way to learn.

    Attributes:
        learner: a name of `kreps.learner.LEARNERS`.
        options: of its constructor that make it this method.
        tuned: whether the outcome of the parameter search applies.
        once: it needs one iteration only, as its data does not come from its policy.
    """

    learner: str
    options: Options = field(default_factory=_none)
    tuned: bool = True
    once: bool = False


KERNEL = "kernel REPS"
SAMPLE = "REPS, sample model"
FEATURES = "REPS, RBF grid"
VALUES = "value iteration"
ANY_STATE = "value iteration on a grid (simulator set to any state)"
NPALP = "NPALP"
DEFAULT = "kreps (default)"
PAPER = "paper-like"
IMAGES = "kreps (images)"
LOW_RANK = "low rank"
UNIFORM = "low rank, uniform"
FOURIER = "low rank, Fourier"
LOW_RANK_IMAGES = "kreps (images), low rank"
REMEMBERING = "nothing forgotten"

METHODS: dict[str, Method] = {
    KERNEL: Method("reps"),
    SAMPLE: Method("reps", {"model": "sample"}),
    FEATURES: Method("reps", {"features": "grid"}),
    VALUES: Method("value-iteration"),
    ANY_STATE: Method("grid-value-iteration", once=True),
    NPALP: Method("npalp"),
    DEFAULT: Method("reps", tuned=False),
    PAPER: Method("reps", {"recipe": "paper"}, tuned=False),
    IMAGES: Method("reps", {"recipe": "images"}, tuned=False),
    LOW_RANK: Method("reps", {"approximation": "pivoted"}, tuned=False),
    UNIFORM: Method("reps", {"approximation": "uniform"}, tuned=False),
    FOURIER: Method("reps", {"approximation": "fourier"}, tuned=False),
    LOW_RANK_IMAGES: Method("reps", {"recipe": "images", "approximation": "pivoted"}, tuned=False),
    REMEMBERING: Method("reps", {"window": None}, tuned=False),
}

Curve = tuple[str, str]
"""A task and a method."""

FIGURES: dict[str, tuple[Curve, ...]] = {
    # Feature-based REPS needs a grid over the state space: left out on reaching, as in the paper.
    "figure-1a": tuple(("reaching", m) for m in (KERNEL, SAMPLE, NPALP, VALUES, ANY_STATE)),
    # NPALP is for deterministic tasks: left out on the swing-up, as in the paper.
    "figure-1b": tuple(("swing-up", m) for m in (KERNEL, SAMPLE, FEATURES, VALUES, ANY_STATE)),
    "figure-2b": (("images", KERNEL), ("images", SAMPLE), ("swing-up", KERNEL)),
    "swing-up": tuple(("swing-up", m) for m in (DEFAULT, PAPER)),
    # one configuration for all tasks, nothing tuned
    "defaults": tuple((task, DEFAULT) for task in TASKS),
}
BEYOND: dict[str, tuple[Curve, ...]] = {
    "low-rank": (
        *(("swing-up", m) for m in (DEFAULT, LOW_RANK, UNIFORM, FOURIER)),
        *(("reaching", m) for m in (DEFAULT, LOW_RANK)),
        *(("images", m) for m in (IMAGES, LOW_RANK_IMAGES)),
    ),
    "forgetting": tuple(("swing-up", m) for m in (DEFAULT, REMEMBERING)),
}
"""Experiments that are not among the paper's: run by name, not by ``all``."""
PICTURES = ("figure-2a",)
"""Figures without an experiment: the features of the images."""
