"""What is compared: tasks, methods, and which of them each figure shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from kreps.learning.evaluate import EPISODES

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
    # past the paper: longer, from a plain Gaussian, and with the learner's own first policy
    "swing-up, long": Task("kreps/SwingUp-v0", 40, episodes=EPISODES),
    "swing-up, Gaussian start": Task(
        "kreps/SwingUp-v0", 17, {"exploration": "gaussian"}, episodes=EPISODES
    ),
    "swing-up, pink noise": Task(
        "kreps/SwingUp-v0", 17, {"exploration": "pink"}, episodes=EPISODES
    ),
    "reaching, own start": Task("kreps/Reaching-v0", 15, episodes=50),
    "images, long": Task("kreps/ImageSwingUp-v0", 17, episodes=50),
    "pendulum": Task("Pendulum-v1", 15, episodes=20),
    "mountain-car": Task("MountainCarContinuous-v0", 18, episodes=50),
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
GRID_VI = "value iteration on a grid (simulator set to any state)"
NPALP = "NPALP"
DEFAULT = "kreps (default)"
PAPER = "paper-like"
SINGLE_STEP = "observed actions only"
LOW_RANK = "low rank"
UNIFORM = "low rank, uniform"
FOURIER = "low rank, Fourier"
REMEMBERING = "nothing forgotten"

METHODS: dict[str, Method] = {
    # those of the paper learn from the actions that were taken, one step in each update
    KERNEL: Method("reps", {"recipe": "observed"}),
    SAMPLE: Method("reps", {"recipe": "observed", "model": "sample"}),
    FEATURES: Method("reps", {"recipe": "observed", "features": "grid"}),
    VALUES: Method("value-iteration"),
    GRID_VI: Method("grid-value-iteration", once=True),
    NPALP: Method("npalp"),
    DEFAULT: Method("reps", tuned=False),
    PAPER: Method("reps", {"recipe": "paper"}, tuned=False),
    SINGLE_STEP: Method("reps", {"recipe": "observed"}, tuned=False),
    LOW_RANK: Method("reps", {"recipe": "observed", "approximation": "pivoted"}, tuned=False),
    UNIFORM: Method("reps", {"recipe": "observed", "approximation": "uniform"}, tuned=False),
    FOURIER: Method("reps", {"recipe": "observed", "approximation": "fourier"}, tuned=False),
    REMEMBERING: Method("reps", {"recipe": "observed", "window": None}, tuned=False),
}

ABLATIONS: dict[str, Options] = {
    "no imagined step": {"imagined": 0},
    "no imagined roll-outs": {"imagined_rollouts": 0.0},
    "each policy taken": {"judging_rollouts": 0},
    "imagined with the policy's noise": {"imagined_noise": 1.0},
    "no exploring starts": {"exploring_starts": 0.0},
    "one imagined action": {"imagined": 1},
    "ridge 0.1": {"ridge": 0.1},
    "floor 0.05": {"eta_floor": 0.05},
    "half the KL bound": {"kl_bound": 0.5},
    "independent restarts": {"restarts": "independent"},
    "no optimism": {"optimism": 0.0},
    "round angles": {"angles": "round"},
    "hard ranges": {"policy_fit": "bounded"},
    "changes of features embedded": {"model": "change"},
    "successor embedded": {"model": "embedding"},
}
"""Each part of the default taken back alone: what stands in its place in the paper or before."""

METHODS |= {name: Method("reps", options, tuned=False) for name, options in ABLATIONS.items()}

Curve = tuple[str, str]
"""A task and a method."""

FIGURES: dict[str, tuple[Curve, ...]] = {
    # Feature-based REPS needs a grid over the state space: left out on reaching, as in the paper.
    "figure-1a": tuple(("reaching", m) for m in (KERNEL, SAMPLE, NPALP, VALUES, GRID_VI)),
    # NPALP is for deterministic tasks: left out on the swing-up, as in the paper.
    "figure-1b": tuple(("swing-up", m) for m in (KERNEL, SAMPLE, FEATURES, VALUES, GRID_VI)),
    "figure-2b": (("images", KERNEL), ("images", SAMPLE), ("swing-up", KERNEL)),
    # this learner beside the method of the paper
    "swing-up": tuple(("swing-up", m) for m in (DEFAULT, SINGLE_STEP, PAPER)),
}
EXTRA_EXPERIMENTS: dict[str, tuple[Curve, ...]] = {
    "low-rank": (
        *(("swing-up", m) for m in (SINGLE_STEP, LOW_RANK, UNIFORM, FOURIER)),
        *((task, m) for task in ("reaching", "images") for m in (SINGLE_STEP, LOW_RANK)),
    ),
    "forgetting": tuple(("swing-up", m) for m in (SINGLE_STEP, REMEMBERING)),
    # KREPS(env) and nothing else
    "untuned": tuple(
        (task, DEFAULT)
        for task in (
            "swing-up, long",
            "swing-up, Gaussian start",
            "swing-up, pink noise",
            "reaching, own start",
            "images, long",
            "pendulum",
            "mountain-car",
        )
    ),
    "ablation": tuple(("swing-up", m) for m in (DEFAULT, *ABLATIONS)),
}
"""Experiments that are not among the paper's: run by name, not by ``all``."""
FIRST_SEED = {"untuned": 1220, "ablation": 1220}
"""Of experiments that confirm what was found on others; 0 elsewhere."""
PICTURES = ("figure-2a",)
"""Figures without an experiment: the features of the images."""
