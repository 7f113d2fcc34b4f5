"""What is noticed in a recording before anything is learnt from it: one function per cause.

Each finding names rows of the recording.  The thresholds are rules of thumb and have no effect on
learning.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from kreps.app.diagnosis import Finding
from kreps.app.diagnosis.delay import delay_or_hidden_state
from kreps.app.diagnosis.finding import counted
from kreps.app.diagnosis.samples import action_cost, idle_columns
from kreps.data.outliers import find_outliers
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import BoolArray
from kreps.recordings.recording import Recording

JITTER_NOTE = 0.1
"""Standard deviation of the control period, as a share of it, from which on steps differ."""

PERIOD_TOLERANCE = 0.05
"""Difference of the recorded period and that of the task, as a share, that is no error."""

SATURATED_NOTE = 0.5
"""Share of the actions of a coordinate at or beyond a limit from which on little is seen of what
smaller actions do."""

AT_LIMIT = 1e-6
"""Distance from a limit, in units of half the action range, at which an action is at it."""

FROZEN_ROWS = 10
"""Rows in which a value that otherwise changes stays the same, from which on that is said."""

FROZEN_VALUES = 20
"""Smallest number of different values of a column that changes all the time."""

TURNS = {"rad": 2.0 * np.pi, "degrees": 360.0}
TURN_TOLERANCE = 0.25
"""Difference of a jump from a whole turn, as a share of it, at which an angle was wrapped."""

FITTED_STEPS = 50_000
"""Steps from which on findings that fit a model do so to every second rollout, or to fewer."""

SHOWN = 3
"""Suspicious values that are named."""


def data_report(recording: Recording, task: TaskSpec | None) -> list[Finding]:
    """All findings about a recording, in the order of reading.

    Args:
        recording: with R rollouts.
        task: that it is of; None leaves out what needs the action limits.
    """
    found = [sampling(recording, task), *left_out(recording), *wrapped_angles(recording, task)]
    found += [suspicious_values(recording), *frozen_values(recording)]
    if task is not None:
        every = max(1, recording.rollouts.steps // FITTED_STEPS)
        window = ReplayWindow(task, None).append(recording.rollouts[::every])
        found += [*saturated_actions(recording, task), *_informative(window)]
        idle = idle_columns(window, recording.values.labels)
        more = idle, action_cost(window), delay_or_hidden_state(window)
        found += [each for each in more if each is not None]
    return found


def sampling(recording: Recording, task: TaskSpec | None) -> Finding:
    """The control period and its jitter, and whether it is that of the task."""
    name, times = "sampling", recording.rollouts.times
    if times is None:
        sentence = "No time stamps: gaps and jitter cannot be seen."
        return Finding(name, "note", np.nan, np.nan, sentence, "naming the column of the time.")
    intervals = np.diff(times)[_within(recording)]
    period, jitter = recording.clock.period, float(np.std(intervals) / np.mean(intervals))
    longest = int(np.argmax(intervals))
    measured = (
        f"The control period is {period:.4g} s ({1.0 / period:.4g} Hz); it varies by {jitter:.1%} "
        f"(standard deviation), and the longest is {intervals[longest]:.4g} s, after "
        f"{recording.table.place(int(recording.step_rows[longest]))}."
    )
    if task is not None and task.dt and abs(period / task.dt - 1.0) > PERIOD_TOLERANCE:
        sentence = f"{measured} The dt of the task is {task.dt:g} s."
        return Finding(name, "limit", period, task.dt, sentence, "the same dt, or another column.")
    if jitter > JITTER_NOTE:
        remedy = "recording by the control loop, one row per cycle; or resampling the recording."
        return Finding(name, "note", jitter, JITTER_NOTE, measured, remedy)
    return Finding(name, "fine", jitter, JITTER_NOTE, measured)


def left_out(recording: Recording) -> Iterator[Finding]:
    """Gaps, missing values, time that does not increase, and terminations without their end."""
    places, missing = recording.table.places, recording.missing
    gaps, backwards, ends = recording.gaps, recording.backwards, recording.incomplete
    cut = "rollouts are cut there"
    if len(gaps):
        lost = np.rint(recording.clock.intervals[gaps] / recording.clock.period) - 1.0
        sentence = (
            f"About {counted(int(lost.sum()), 'row')} missing in {counted(len(gaps), 'gap')}, "
            f"after {places(gaps)}; {cut}."
        )
        yield Finding("gaps", "note", len(gaps), 0.0, sentence, "a recording without lost rows.")
    if len(backwards):
        sentence = f"Time does not increase after {places(backwards)}; {cut}."
        remedy = "removing repeated rows, and naming the column of the episode."
        yield Finding("order of time", "note", len(backwards), 0.0, sentence, remedy)
    for name, rows in missing.items():
        sentence = f"{name} has no finite number in {places(rows)}; {cut}."
        remedy = "filling in what is known, or another column."
        yield Finding("missing values", "note", len(rows), 0.0, sentence, remedy)
    if len(ends):
        sentence = (
            f"The task terminated in {places(ends)}, but the observation after that was not "
            "recorded, so these steps are left out and no termination is learnt from them."
        )
        remedy = "next_observations, or one more row per episode, without an action."
        yield Finding("terminal observations", "limit", len(ends), 0.0, sentence, remedy)
    if not (missing or len(gaps) or len(backwards)):
        used, of = np.count_nonzero(np.bincount(recording.rows)), len(recording.table)
        sentence = f"No gap and no missing value; {used} of {of} rows are in rollouts."
        yield Finding("missing values", "fine", 0.0, 0.0, sentence)


def wrapped_angles(recording: Recording, task: TaskSpec | None) -> Iterator[Finding]:
    """Observation coordinates that jump by a whole turn."""
    points, name = recording.rollouts.points, "wrapped angles"
    periodic = () if task is None else task.periodic
    changes = np.where(_within(recording)[:, None], np.diff(points, axis=0), 0.0)
    for i, label in enumerate(recording.values.labels):
        for unit, turn in TURNS.items():
            jumps = np.abs(np.abs(changes[:, i]) - turn) < TURN_TOLERANCE * turn
            if not jumps.any() or np.ptp(points[:, i]) > (1.0 + TURN_TOLERANCE) * turn:
                continue
            rows = recording.rows[:-1][jumps]
            measured = f"{label} jumps by a turn of {turn:.4g} after {recording.table.places(rows)}"
            if unit == "rad" and i in periodic:
                yield Finding(name, "fine", len(rows), 0.0, f"{measured}; it is an angle.")
                continue
            convert = "" if unit == "rad" else "converting it to rad, and "
            remedy = f'{convert}periodic = ["{label}"] in [task].'
            sentence = f"{measured}: an angle in {unit} that is taken for a number."
            yield Finding(name, "limit", len(rows), 0.0, sentence, remedy)


def suspicious_values(recording: Recording) -> Finding:
    """Single numbers far from all others, as `kreps.data.outliers` finds them."""
    rollouts, name = recording.rollouts, "suspicious values"
    found = find_outliers(rollouts)
    if not found:
        return Finding(name, "fine", 0.0, 0.0, "No number is far from all others of its column.")
    labels = {f"observation coordinate {i}": n for i, n in enumerate(recording.values.labels)}
    said = []
    for each in found[:SHOWN]:
        row = recording.rows[rollouts.offsets[each.rollout] + each.rollout + each.row]
        said.append(
            f"{labels.get(each.name, each.name)} is {each.value:.3g} in "
            f"{recording.table.place(int(row))}, {each.distance:,.0f} times as far from the "
            "median as nine in ten others"
        )
    more = f"; and {len(found) - SHOWN} more" if len(found) > SHOWN else ""
    remedy = "correcting the values in the file, or leaving them empty."
    return Finding(name, "limit", len(found), 0.0, f"{'; '.join(said)}{more}.", remedy)


def frozen_values(recording: Recording) -> Iterator[Finding]:
    """Observation coordinates that change all the time, but stay the same for many rows."""
    points, within = recording.rollouts.points, _within(recording)
    for i, label in enumerate(recording.values.labels):
        if len(np.unique(points[:, i])) < FROZEN_VALUES:
            continue
        start, length = _longest_run((points[1:, i] == points[:-1, i]) & within)
        if length + 1 >= FROZEN_ROWS:
            sentence = (
                f"{label} has the same value in {length + 1} rows, from "
                f"{recording.table.place(int(recording.rows[start]))}."
            )
            remedy = "nothing if the robot was at rest; otherwise a sensor that is read faster."
            yield Finding("repeated values", "note", length + 1, FROZEN_ROWS, sentence, remedy)


def saturated_actions(recording: Recording, task: TaskSpec) -> Iterator[Finding]:
    """Action coordinates that are constant, or mostly at a limit."""
    scaled, name = task.scaled(recording.rollouts.actions), "saturated actions"
    for label, each in zip(recording.values.action_labels, scaled.T, strict=True):
        if np.ptp(each) <= AT_LIMIT:
            sentence = f"{label} never changes, so nothing can be learnt about it."
            remedy = "leaving the column out, or a recording in which it varies."
            yield Finding(name, "limit", 0.0, AT_LIMIT, sentence, remedy)
            continue
        at = np.abs(each) >= 1.0 - AT_LIMIT
        beyond = np.flatnonzero(np.abs(each) > 1.0 + AT_LIMIT)
        share = float(at.mean())
        measured = f"{label} is at a limit or beyond it in {share:.0%} of the steps"
        if len(beyond):
            rows = recording.step_rows[beyond]
            measured += f", and beyond it in {recording.table.places(rows)}"
        if share < SATURATED_NOTE:
            yield Finding(name, "fine", share, SATURATED_NOTE, f"{measured}.")
            continue
        remedy = "the limits of the robot in [task], or a recording with smaller actions."
        yield Finding(name, "note", share, SATURATED_NOTE, f"{measured}.", remedy)


def _informative(window: ReplayWindow) -> Iterator[Finding]:
    """A finding if no reward depends on the state."""
    if not window.reward_depends_on_state:
        sentence = "The reward does not depend on the observation, so only actions can be saved."
        remedy = "another reward, or a recording in which the goal is reached."
        yield Finding("reward", "limit", 0.0, 0.0, sentence, remedy)


def _within(recording: Recording) -> BoolArray:
    """(n + R - 1,) whether a point and the next one are of the same rollout."""
    within = np.ones(len(recording.rows) - 1, bool)
    within[recording.rollouts.offsets[1:-1] + np.arange(len(recording.rollouts) - 1)] = False
    return within


def _longest_run(flags: BoolArray) -> tuple[int, int]:
    """Start and length of the longest run of true flags."""
    edges = np.diff(np.concatenate([[0], flags.astype(np.intp), [0]]))
    starts, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    if not len(starts):
        return 0, 0
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest] - starts[longest])
