"""The finding about a delay or a hidden state: whether earlier steps make predictions better."""

from __future__ import annotations

from dataclasses import replace

from kreps.app.diagnosis.finding import Finding, counted
from kreps.app.diagnosis.thresholds import HELD_OUT_NOTE, MAX_COLUMNS, MIN_HELD_OUT_STEPS
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.threads import blas_threads
from kreps.models.history_choice import HeldOut, HistoryChoice, choose_history, described
from kreps.seeding import Purpose, generator


def delay_or_hidden_state(window: ReplayWindow | None) -> Finding | None:
    """Whether states need earlier observations or actions; None for images, or with few samples."""
    if window is None or window.steps < MIN_HELD_OUT_STEPS:
        return None
    task = window.task
    if task.image_shape is not None or task.observation_size > MAX_COLUMNS:
        return None
    bare = replace(task, delay=0, history=0)
    with blas_threads(1):
        choice = choose_history(window.rollouts, bare, 0, generator(0, Purpose.PREDICTION))
    return None if choice is None else finding_of(choice, task)


def finding_of(choice: HistoryChoice, task: TaskSpec) -> Finding:
    """The finding about a choice for a task whose states may have earlier steps already."""
    name, chosen, none = "delay or hidden state", choice.chosen, choice.none
    share = chosen.relative / none.relative if none.relative else 1.0
    errors = f"from {none.relative:.2g} to {chosen.relative:.2g}"
    if chosen is none:
        sentence = (
            f"The held-out error of predictions of observation and reward is {none.relative:.2g}, "
            "and earlier observations and actions do not lower it clearly."
        )
        return Finding(name, "fine", share, HELD_OUT_NOTE, sentence)
    sentence = (
        f"The held-out error of predictions of observation and reward falls {errors} where "
        f"{described(chosen)}: {_cause(chosen, task)}."
    )
    if task.action_lags >= chosen.delay and task.history >= chosen.history:
        return Finding(
            name, "fine", share, HELD_OUT_NOTE, f"{sentence} The run's states have them."
        )
    remedy = "states with earlier steps (--set history=auto)."
    return Finding(name, "limit", share, HELD_OUT_NOTE, sentence, remedy)


def _cause(chosen: HeldOut, task: TaskSpec) -> str:
    if chosen.history:
        return "a part of the state, such as a velocity, is not observed"
    seconds = "" if task.dt is None else f" ({chosen.delay * task.action_repeat * task.dt:.3g} s)"
    late = counted(chosen.delay * task.action_repeat, "step") + seconds
    return f"actions take effect, or observations arrive, {late} late"
