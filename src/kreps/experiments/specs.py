"""The experiments: tasks, methods, and which methods each figure shows on which task.

A figure of the paper has three columns: as the authors' scripts (their tasks and settings), as
printed, and the default of this library.  The rivals that do not learn by REPS have no settings in
print, so the last two columns show them with the library's defaults, after the same search.

Options are keyword arguments of a learner's constructor.  Their values are plain JSON: a section of
the settings is given by the name of its kind, one field of a section by a dotted name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from kreps.learning.evaluate import EPISODES

Options = Mapping[str, Any]


def _no_options() -> Options:
    return MappingProxyType({})


@dataclass(frozen=True)
class Task:
    """One task and its experimental protocol.

    Attributes:
        environment: Gymnasium name.
        iterations: policy updates of each trial.
        exploration: options of every learner that explores by its own policy.
        options: options of every learner.
        ranges: (smallest, largest) value of each observation coordinate, for the learner that
            places a grid over the states.  An angle gets a whole turn in any case.
        episodes: evaluation rollouts after each update; the last policy gets `EPISODES`.
    """

    environment: str
    iterations: int
    exploration: Options = field(default_factory=_no_options)
    options: Options = field(default_factory=_no_options)
    ranges: tuple[tuple[float, float], ...] | None = None
    episodes: int = 10


TASKS: dict[str, Task] = {
    # First policy as in the paper: N(0, 0.5^2) N m.  The scale is in units of half the range.
    "reaching": Task(
        "kreps/Reaching-v0",
        15,
        {"exploration.noise": "gaussian", "exploration.scale": 0.05},
        ranges=((-4.0, 4.0), (-4.0, 4.0), (-8.0, 8.0), (-8.0, 8.0)),
    ),
    "swing-up": Task("kreps/SwingUp-v0", 20, ranges=((-2.0, 5.0), (-12.0, 12.0)), episodes=50),
    "images": Task("kreps/ImageSwingUp-v0", 15),
    # With the constants of the authors' scripts.
    "authors-reaching": Task(
        "kreps/AuthorsReaching-v0",
        20,
        options={"restart_probability": 0.04},
        ranges=((-4.0, 4.0), (-4.0, 4.0), (-10.0, 10.0), (-10.0, 10.0)),
    ),
    "authors-swing-up": Task(
        "kreps/AuthorsSwingUp-v0", 20, ranges=((-2.0, 5.0), (-20.0, 20.0)), episodes=50
    ),
    "authors-images": Task("kreps/AuthorsImageSwingUp-v0", 20),
    # Not in the paper: more updates, other first policies, and two environments of Gymnasium.
    "swing-up, long": Task("kreps/SwingUp-v0", 40, episodes=EPISODES),
    "swing-up, Gaussian start": Task(
        "kreps/SwingUp-v0", 17, {"exploration.noise": "gaussian"}, episodes=EPISODES
    ),
    "swing-up, pink noise": Task(
        "kreps/SwingUp-v0", 17, {"exploration.noise": "pink"}, episodes=EPISODES
    ),
    "reaching, own start": Task("kreps/Reaching-v0", 15, episodes=50),
    "images, long": Task("kreps/ImageSwingUp-v0", 17, episodes=50),
    "pendulum": Task("Pendulum-v1", 15, episodes=20),
    "mountain-car": Task("MountainCarContinuous-v0", 18, episodes=50),
}


@dataclass(frozen=True)
class Method:
    """A learner with options, under the name that figures show.

    Attributes:
        learner: key of `kreps.learning.learner.LEARNERS`.
        options: of the learner's constructor.
        once: whether one iteration is enough because the data does not depend on the policy.
    """

    learner: str
    options: Options = field(default_factory=_no_options)
    once: bool = False


# The paper's methods, each with several presets.
KERNEL = "kernel REPS"
SAMPLE = "REPS, sample model"
FEATURES = "REPS, RBF grid"
VALUES = "value iteration"
GRID_VI = "value iteration on a grid"
NPALP = "NPALP"

DEFAULT = "kreps (default)"
PAPER = "paper-like"
SINGLE_STEP = "observed actions only"
LOW_RANK = "low rank"
UNLIMITED_WINDOW = "nothing forgotten"


def with_preset(method: str, preset: str) -> str:
    """The name of one of the paper's methods with a preset."""
    return f"{method} ({preset})"


AUTHORS = with_preset(KERNEL, "authors")
METHODS: dict[str, Method] = {
    **{
        with_preset(method, preset): Method("reps", {"preset": preset, **options})
        for preset in ("authors", "paper")
        for method, options in (
            (KERNEL, {}),
            (SAMPLE, {"model": "sample"}),
            (FEATURES, {"value": "grid"}),
        )
    },
    DEFAULT: Method("reps"),
    # without a learnt model there is no model-based step, and no error to take the ridge from
    with_preset(SAMPLE, "default"): Method(
        "reps", {"model": "sample", "model_based": None, "ridge": 0.1}
    ),
    with_preset(FEATURES, "default"): Method("reps", {"value": "grid"}),
    **{
        with_preset(method, preset): Method(learner, {"preset": preset}, once=method == GRID_VI)
        for preset in ("authors", "default")
        for method, learner in (
            (VALUES, "value-iteration"),
            (GRID_VI, "grid-value-iteration"),
            (NPALP, "npalp"),
        )
    },
    # Not in the paper.
    PAPER: Method("reps", {"preset": "paper"}),
    SINGLE_STEP: Method("reps", {"preset": "single_step"}),
    LOW_RANK: Method("reps", {"preset": "single_step", "low_rank.above": 0}),
    UNLIMITED_WINDOW: Method("reps", {"preset": "single_step", "window": None}),
}

ABLATIONS: dict[str, Options] = {
    "no model-based step": {"model_based": None},
    "no states from model rollouts": {"model_based.model_rollout_fraction": 0.0},
    "no acceptance test": {"model_based.acceptance_rollouts": 0},
    "proposals with the policy's noise": {"model_based.proposal_std_scale": 1.0},
    "no exploring starts": {"exploring_starts": 0.0},
    "one generated action per state": {"model_based.actions_per_state": 1},
    "ridge 0.1": {"ridge": 0.1},
    "temperature floor 0.05": {"eta_floor": 0.05},
    "half the KL bound": {"kl_bound": 0.5},
    "independent rollout lengths": {"rollout_lengths": "independent"},
    "no exploration bonus": {"model_based.exploration_bonus": 0.0},
    "no random policies": {"model_based.random_policies": 0},
    "no regulators": {"model_based.regulators": 0},
    "no gradient steps": {"model_based.gradient_steps": 0},
    "continuous angle wrap": {"value.angle_wrap": "continuous"},
    "bounded policy fit": {"policy_fit": "bounded"},
    "feature changes embedded": {"model": "change"},
    "successor features embedded": {"model": "embedding"},
}
"""The default with one part at a time replaced by what the paper or an earlier version has."""

METHODS |= {name: Method("reps", options) for name, options in ABLATIONS.items()}

Curve = tuple[str, str]
"""A key of `TASKS` and a key of `METHODS`."""

AS_SCRIPTS = "As the authors' scripts, on their tasks"
AS_PRINTED = "As printed"
BY_DEFAULT = "Default of kreps"


def _columns(*shown: Curve) -> dict[str, tuple[Curve, ...]]:
    """The columns of a figure of the paper, from the tasks and methods that it shows."""
    rivals = (VALUES, GRID_VI, NPALP)
    return {
        AS_SCRIPTS: tuple((f"authors-{task}", with_preset(m, "authors")) for task, m in shown),
        AS_PRINTED: tuple(
            (task, with_preset(m, "default" if m in rivals else "paper")) for task, m in shown
        ),
        BY_DEFAULT: tuple(
            (task, DEFAULT if m == KERNEL else with_preset(m, "default")) for task, m in shown
        ),
    }


COLUMNS: dict[str, dict[str, tuple[Curve, ...]]] = {
    # Feature-based REPS needs a grid over the state space: left out on reaching, as in the paper.
    "figure-1a": _columns(*(("reaching", m) for m in (KERNEL, SAMPLE, NPALP, VALUES, GRID_VI))),
    # NPALP is for deterministic tasks: left out on the swing-up, as in the paper.
    "figure-1b": _columns(*(("swing-up", m) for m in (KERNEL, SAMPLE, FEATURES, VALUES, GRID_VI))),
    "figure-2b": _columns(("images", KERNEL), ("images", SAMPLE), ("swing-up", KERNEL)),
}
"""The figures of the paper, by the titles of their columns."""

FIGURES: dict[str, tuple[Curve, ...]] = {
    figure: tuple(dict.fromkeys(curve for curves in columns.values() for curve in curves))
    for figure, columns in COLUMNS.items()
}
"""The curves of each figure; a curve in two columns is learnt once."""

# The default of kreps and two presets of the paper's single step.
FIGURES["swing-up"] = tuple(("swing-up", m) for m in (DEFAULT, SINGLE_STEP, PAPER))

EXTRA_EXPERIMENTS: dict[str, tuple[Curve, ...]] = {
    "low-rank": tuple(
        (task, m) for task in ("swing-up", "reaching", "images") for m in (SINGLE_STEP, LOW_RANK)
    ),
    "forgetting": tuple(("swing-up", m) for m in (SINGLE_STEP, UNLIMITED_WINDOW)),
    # KREPS(env) without further arguments
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
    # A few cheap trials that the tests run again and compare: neither work on the default nor the
    # search can move them.
    "golden": (
        ("swing-up", PAPER),
        ("swing-up", AUTHORS),
        ("reaching, own start", with_preset(NPALP, "default")),
    ),
}
"""Experiments that the paper does not have: run by name, not by ``all``."""

FIRST_SEED = {"untuned": 1240, "ablation": 1220}
"""First seed of experiments that use fresh seeds, unseen during development; 0 elsewhere."""

PICTURES = ("figure-2a",)
"""Figures that need no experiment: the features of the images."""
