"""Findings about the samples of the replay window: idle columns, and the price of actions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kreps.app.diagnosis.finding import Finding
from kreps.app.diagnosis.thresholds import (
    ACTION_COST_NOTE,
    COPY_CORRELATION,
    EFFECT_NOTE,
    MAX_COLUMNS,
    NOISE_R2,
    SAMPLES_PER_TERM,
)
from kreps.data.rewards import quadratic_terms
from kreps.data.rollouts import Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.kernels.arrays import FloatArray
from kreps.models.dynamics import CONSTANT_RTOL


@dataclass(frozen=True)
class IdleColumns:
    """Observation columns without information that other columns do not have.

    Attributes:
        constant: columns that never change.
        copies: pairs of a column and the one before it that it is a linear function of.
        noise: columns that nothing predicts, and that predict nothing.
    """

    constant: tuple[int, ...]
    copies: tuple[tuple[int, int], ...]
    noise: tuple[int, ...]

    @classmethod
    def from_samples(cls, data: Transitions, task: TaskSpec) -> IdleColumns:
        """The idle columns of n transitions."""
        points = data.points
        spread = points.std(axis=0)
        varies = spread > CONSTANT_RTOL * np.abs(points).max(axis=0)
        kept = list(np.flatnonzero(varies))
        z = (points[:, kept] - points[:, kept].mean(axis=0)) / spread[kept]
        alike = np.abs(z.T @ z) / len(z) > COPY_CORRELATION
        copies = [
            (int(kept[j]), int(kept[alike[:j, j].argmax()]))
            for j in range(len(kept))
            if alike[:j, j].any()
        ]
        copied = {column for column, _ in copies}
        own = [i for i, column in enumerate(kept) if column not in copied]
        noise = _noise(z[:, own], data, task)
        return cls(
            tuple(int(i) for i in np.flatnonzero(~varies)),
            tuple(copies),
            tuple(int(kept[own[i]]) for i in noise if int(kept[own[i]]) not in task.periodic),
        )


def _noise(z: FloatArray, data: Transitions, task: TaskSpec) -> list[int]:
    """Which columns are noise.

    Such a column has a successor that is no linear function of states and actions, and neither the
    column nor its square has an effect on the other successors or the reward.

    Args:
        z: (m, k) standardised columns of all points.
        data: n transitions, whose states are rows of ``z``.
        task: limits of the actions.
    """
    actions = task.scaled_applied(data.actions)
    states, successors = z[data.state], z[data.successor]
    inputs = np.column_stack([np.ones(len(data)), states, actions])
    if len(data) < SAMPLES_PER_TERM * inputs.shape[1]:
        return []
    left = successors - inputs @ np.linalg.lstsq(inputs, successors)[0]
    share = np.var(left, axis=0) / np.maximum(np.var(successors, axis=0), 1e-300)
    unpredicted = [i for i, left_share in enumerate(share) if 1.0 - left_share < NOISE_R2]
    targets = np.column_stack([successors, data.rewards])
    return [i for i in unpredicted if not _has_effect(i, inputs, targets)]


def _has_effect(i: int, inputs: FloatArray, targets: FloatArray) -> bool:
    """Whether column i or its square explains a part of other targets than its own successor.

    Args:
        i: number of the column.
        inputs: (n, 1 + k + da) one, states and actions.
        targets: (n, k + 1) successors and rewards.
    """
    own, others = inputs[:, 1 + i], np.delete(inputs, 1 + i, axis=1)
    wanted = np.column_stack([np.delete(targets, i, axis=1), own, own**2])
    left = wanted - others @ np.linalg.lstsq(others, wanted)[0]
    size = np.maximum(np.linalg.norm(left, axis=0), 1e-300)
    explained = ((left[:, :-2] / size[:-2]).T @ (left[:, -2:] / size[-2:])) ** 2
    return bool((explained > EFFECT_NOTE).any())


def idle_columns(
    window: ReplayWindow | None, labels: Sequence[str] | None = None
) -> Finding | None:
    """Idle observation columns; None for images, or without samples.

    Args:
        window: with the samples.
        labels: names of the columns in a recording; None for their numbers.
    """
    name = "idle columns"
    if window is None or not window.rollouts or window.task.image_shape is not None:
        return None
    width = window.task.observation_size
    if width > MAX_COLUMNS:
        return None
    found = IdleColumns.from_samples(window.rollouts.transitions, window.task)
    names = [str(i) for i in range(width)] if labels is None else labels
    constant, noise = (", ".join(names[i] for i in each) for each in (found.constant, found.noise))
    said = [
        *([f"{constant} never changes"] if len(found.constant) == 1 else []),
        *([f"{constant} never change"] if len(found.constant) > 1 else []),
        *(f"{names[column]} is a copy of {names[other]}" for column, other in found.copies),
        *([f"{noise} is noise"] if len(found.noise) == 1 else []),
        *([f"{noise} are noise"] if len(found.noise) > 1 else []),
    ]
    idle = len(found.copies) + len(found.noise)
    if not said:
        sentence = f"None of the {width} observation columns is constant, a copy or noise."
        return Finding(name, "fine", 0.0, 0.0, sentence)
    numbered = " (from 0)" if labels is None else ""
    sentence = f"Of {width} observation columns{numbered}, {'; '.join(said)}."
    if not idle:
        return Finding(name, "fine", 0.0, 0.0, sentence)
    return Finding(
        name,
        "note",
        idle,
        0.0,
        f"{sentence} They add nothing, and samples that differ in them count as different.",
        "leaving them out of the observation (gymnasium.wrappers.TransformObservation)."
        if labels is None
        else "leaving them out of the observations.",
    )


def action_cost(window: ReplayWindow | None) -> Finding | None:
    """Whether the price of actions dominates the reward; None if the samples do not tell."""
    name = "action cost"
    if window is None or not window.rollouts or window.task.observation_size > MAX_COLUMNS:
        return None
    share = action_cost_share(window.rollouts.transitions, window.task)
    if not np.isfinite(share):
        return None
    measured = f"A quadratic cost of the actions makes {share:.0%} of the variance of the reward"
    if share < ACTION_COST_NOTE:
        return Finding(name, "fine", share, ACTION_COST_NOTE, f"{measured}.")
    return Finding(
        name,
        "note",
        share,
        ACTION_COST_NOTE,
        f"{measured}. Learning may save actions before it finds what they are for.",
        "a smaller weight of the actions in the reward, or smaller steps (--set kl_bound=0.5).",
    )


def action_cost_share(data: Transitions, task: TaskSpec) -> float:
    """Share of the variance of the reward that is a quadratic cost of the actions.

    The reward is fitted by a quadratic in the applied actions and the states, the latter without
    products.  A policy makes the actions functions of the state, so that a fit by the actions alone
    would count what the state explains.  Terminating steps are left out, as their reward may jump.

    Returns:
        0 where no action is no better than the average one, so that it is no cost; NaN with too few
        steps, or if all rewards are equal.
    """
    going_on = ~data.terminated
    rewards, states = data.rewards[going_on], data.states[going_on]
    actions = quadratic_terms(task.scaled_applied(data.actions[going_on]))[:, 1:]
    if len(rewards) < SAMPLES_PER_TERM * (1 + actions.shape[1] + 2 * states.shape[1]):
        return float("nan")
    centred = rewards - rewards.mean()
    size = float(np.abs(centred).max())
    if size <= CONSTANT_RTOL * float(np.abs(rewards).max()):
        return float("nan")
    z = (states - states.mean(axis=0)) / np.maximum(states.std(axis=0), 1e-300)
    columns = np.column_stack([actions - actions.mean(axis=0), z, z**2 - (z**2).mean(axis=0)])
    weights = np.linalg.lstsq(columns, centred / size)[0][: actions.shape[1]]
    part = actions @ weights
    nothing = quadratic_terms(task.scaled_applied(np.zeros((1, task.action_size))))[0, 1:] @ weights
    if nothing <= part.mean():
        return 0.0
    return min(float(np.var(part) / np.var(centred / size)), 1.0)
