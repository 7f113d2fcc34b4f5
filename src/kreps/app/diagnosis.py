"""What limits a run, in words and with what to try: from the rows of ``progress.csv`` to findings.

One short function per cause.  Each looks at the mean of the latest `RECENT` iterations or at the
trend of the last half of them, and says what is fine as well as what is not.  The thresholds and
their reasons are in ``docs/diagnosis.md``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy.special import stdtrit

from kreps.algorithms.acceptance import ETA_FLOOR_WITH_ACCEPTANCE_TEST
from kreps.algorithms.dual import MIN_ETA, Outcome
from kreps.kernels.arrays import FloatArray

Severity = Literal["limit", "note", "fine"]
Row = Mapping[str, Any]

RECENT = 5
"""Iterations that a mean is taken over."""

LEAST_ROWS = 8
"""Iterations from which on a trend of the last half can be told from noise at all."""

ERROR_NOTE, ERROR_LIMIT = 0.4, 0.8
"""Relative leave-one-out error of the transition model; 1 is what no model at all has."""

MODEL_FALL = 0.1
"""Fall of that error over the last half of a run, as a share of it, that counts as one."""

BOUND_USED, BOUND_UNUSED = 0.8, 0.5
"""Share of the KL bound above which it counts as used up, and below which as unused."""

LEAST_EFFECTIVE, LEAST_SHARE = 30.0, 0.05
"""Effective targets that a policy can be fitted to, and effective samples as a share of all."""

REFUSED_NOTE = 0.5
"""Share of new policies that the model finds worse above which learning hardly goes on."""

CLIPPED_NOTE = 0.9
"""Share of commands beyond the limits above which exploration is hardly felt."""

NOISE_LEAST, NOISE_MOST = 0.02, 1.0
"""Standard deviation of the policy in units of half the action range: too still, too wild."""

NOISE_COST = 0.1
"""Share of the range of rewards seen in training that the exploration noise may cost."""

RESIDUAL_NOTE, RESIDUAL_LIMIT = 0.1, 0.5
"""Largest squared residual of a basis that is full; 1 is a state that it does not see at all."""

JITTER_NOTE = 1e-8
"""Jitter above which the factorised matrices are no longer the ones that were meant."""

REWARD_NEAR = 0.05
"""Share of the way from worst to best reference within which a reward is near another one."""

LEAST_RISE, LEVEL = 0.02, 0.25
"""Rise of the reward, as a share of its range so far, from which on it counts as improvement, and
which it must surely stay below to count as level."""

CONFIDENCE = 0.95
"""With which a trend is told, one-sided."""


@dataclass(frozen=True)
class Finding:
    """One cause, judged.

    Attributes:
        name: of the cause.
        severity: ``"limit"``: it holds the run back; ``"note"``: worth knowing; ``"fine"``.
        value: what was measured.
        limit: what it was judged by; NaN where no single number was.
        sentence: what is the case.
        remedy: what to try, to be read after "Try:"; settings are those of a new run, and RUN
            stands for the run's folder.  Empty where nothing has to be tried.
    """

    name: str
    severity: Severity
    value: float
    limit: float
    sentence: str
    remedy: str = ""


@dataclass(frozen=True)
class Trend:
    """A straight line through the last half of a curve.

    Attributes:
        iterations: that it was fitted to.
        rise: from its first to its last iteration.
        error: half the width of its interval of `CONFIDENCE`.
    """

    iterations: int
    rise: float
    error: float

    def rises(self, least: float = 0.0) -> bool:
        return self.rise > max(self.error, least)

    def falls(self, least: float = 0.0) -> bool:
        return -self.rise > max(self.error, least)

    def below(self, most: float) -> bool:
        """Whether the rise is surely no larger."""
        return self.rise + self.error <= most


def column(rows: Sequence[Row], name: str) -> FloatArray:
    return np.array([float(row[name]) for row in rows])


def latest(rows: Sequence[Row], name: str) -> float:
    """What holds now, such as a limit, which need not be what held before; NaN if unknown."""
    return float(rows[-1][name])


def recent(rows: Sequence[Row], name: str) -> float:
    """Mean of a column over the latest iterations that have it; NaN if none has."""
    values = column(rows[-RECENT:], name)
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def recorded(rows: Sequence[Row]) -> bool:
    """Whether the last update was made by a version that records all columns."""
    return bool(np.isfinite(latest(rows, "clipped")))


def weighted(rows: Sequence[Row]) -> FloatArray:
    """Samples that were given weights, imagined ones included."""
    found = column(rows, "weighted")
    return np.where(np.isfinite(found), found, column(rows, "samples"))


def effective_share(rows: Sequence[Row]) -> FloatArray:
    """Effective samples as a share of those that were given weights."""
    return column(rows, "effective_samples") / weighted(rows)


def targets(rows: Sequence[Row]) -> FloatArray:
    """What the policy can be fitted to: the actions imagined in one state make one target."""
    return np.minimum(weighted(rows), column(rows, "samples"))


def trend(values: FloatArray) -> Trend | None:
    """Of the last half of ``values``; None if there are too few, or some are not known."""
    if len(values) < LEAST_ROWS:
        return None
    half = values[len(values) // 2 :] - values[-1]
    if not np.isfinite(half).all():
        return None
    m = len(half)
    time = np.arange(m) - 0.5 * (m - 1)
    slope = float(time @ half / (time @ time))
    left = half - half.mean() - slope * time
    deviation = float(np.sqrt(left @ left / (m - 2) / (time @ time)))
    return Trend(m, slope * (m - 1), float(stdtrit(m - 2, CONFIDENCE)) * deviation * (m - 1))


def diagnose(
    rows: Sequence[Row],
    evaluation: Mapping[str, Any] | None = None,
    references: Mapping[str, float] | None = None,
) -> list[Finding]:
    """Everything that can be said of a run, the gravest first.

    Causes whose numbers were not recorded are left out, as is the model's where there is none.

    Args:
        rows: of ``progress.csv``, at least one.
        evaluation: of ``evaluation.json``, of the policy of the last row.
        references: reference rewards of the task by name, from best to worst.
    """
    references = references or {}
    found = [
        updates(rows),
        goal(rows),
        local_optimum(rows, evaluation, references),
        progress(rows, evaluation, references),
        step(rows),
        effective_samples(rows),
        judgement(rows),
        model(rows),
        basis(rows),
        noise(rows, evaluation),
        clipping(rows),
    ]
    order = get_args(Severity)
    return sorted((f for f in found if f is not None), key=lambda f: order.index(f.severity))


def higher_floor(rows: Sequence[Row]) -> str:
    """The setting of twice the least temperature; of 0.2 where it is not known, or was none."""
    floor = latest(rows, "eta_floor")
    return f"--set eta_floor={2.0 * floor if floor > 2.0 * MIN_ETA else 0.2:.2g}"


def larger_ridge(rows: Sequence[Row]) -> str:
    """The setting of ten times the ridge, and of 1 at least."""
    ridge = np.fmax(1.0, 10.0 * recent(rows, "ridge"))
    return f"--set ridge={float(f'{ridge:.2g}'):g}"


# ---- the solver -------------------------------------------------------------------------------


def updates(rows: Sequence[Row]) -> Finding:
    """Whether the dual was solved, and whether the matrices were well conditioned."""
    name = "updates"
    failed = [r["iteration"] for r in rows if r["outcome"] == Outcome.NOT_CONVERGED.name]
    jitter = float(column(rows[-RECENT:], "jitter").max())
    if failed:
        lately = any(row["iteration"] in failed for row in rows[-RECENT:])
        return Finding(
            name,
            "limit" if lately else "note",
            len(failed),
            0.0,
            f"{_count(len(failed), 'update')} of {len(rows)} did not converge, the last one in "
            f"iteration {failed[-1]}: its weights are not certified.",
            f"a softer problem: a larger ridge ({larger_ridge(rows)}), or a higher least "
            f"temperature ({higher_floor(rows)}).",
        )
    if jitter > JITTER_NOTE:
        return Finding(
            name,
            "note",
            jitter,
            JITTER_NOTE,
            f"All updates converged, but matrices were nearly singular: a jitter of {jitter:.0e} "
            "was added to factorise them.",
            "leaving out coordinates that repeat each other or never change, or a basis that "
            "stops earlier (--set basis_tolerance=1e-5).",
        )
    gap = float(column(rows, "gap").max())
    return Finding(
        name,
        "fine",
        len(failed),
        0.0,
        f"All updates converged and are certified; the largest duality gap is {max(gap, 0.0):.0e}.",
    )


# ---- the reward -------------------------------------------------------------------------------


def goal(rows: Sequence[Row]) -> Finding | None:
    """Whether any reward tells of the states; None if it does, or if that was not recorded."""
    told = column(rows, "exploring")
    if not told[-1] > 0.0:
        return None
    return Finding(
        "goal",
        "limit",
        float(np.sum(told > 0.0)),
        0.0,
        "The rewards of the kept roll-outs are constant, or a price of the actions: no goal in "
        "sight, they say that to do nothing is best. Roll-outs explore meanwhile.",
        f"more of them (kreps resume RUN --iterations {2 * len(rows)}), or a new run with longer "
        "ones (--set restart_probability=0.01); from Python, update(rollouts) with some that reach "
        "the goal.",
    )


def reward_of(rows: Sequence[Row], evaluation: Mapping[str, Any] | None) -> float:
    """Of the greedy policy where it was evaluated, else of the latest training roll-outs."""
    return evaluation["greedy"]["mean"] if evaluation else recent(rows, "average_reward")


def nearby(references: Mapping[str, float], reward: float) -> tuple[str, float] | None:
    """The reference, neither best nor worst, that a reward is near: a known local optimum."""
    values = list(references.values())
    for name, value in list(references.items())[1:-1]:
        if abs(reward - value) < REWARD_NEAR * abs(values[0] - values[-1]):
            return name, value
    return None


def improving(rows: Sequence[Row]) -> Trend | None:
    """Trend of the training reward."""
    return trend(column(rows, "average_reward"))


def reward_range(rows: Sequence[Row]) -> float:
    """Best less worst training reward so far."""
    return float(np.ptp(column(rows, "average_reward")))


def still_rising(rows: Sequence[Row]) -> bool:
    found = improving(rows)
    return found is not None and found.rises(LEAST_RISE * reward_range(rows))


def local_optimum(
    rows: Sequence[Row], evaluation: Mapping[str, Any] | None, references: Mapping[str, float]
) -> Finding | None:
    """Whether the reward is near a known local optimum and does not leave it."""
    reward = reward_of(rows, evaluation)
    near = nearby(references, reward)
    if near is None or still_rising(rows):
        return None
    name, value = near
    return Finding(
        "local optimum",
        "limit",
        reward,
        value,
        f"The reward, {reward:.4g}, is near {name} ({value:g}): the run is probably stuck there.",
        "a new run, as going on from a stuck policy seldom helps: another --seed, more roll-outs "
        "at first (--set initial_rollouts=60), or smaller steps (--set kl_bound=0.5).",
    )


def progress(
    rows: Sequence[Row], evaluation: Mapping[str, Any] | None, references: Mapping[str, float]
) -> Finding:
    """Whether the reward still rises."""
    name = "progress"
    found = improving(rows)
    if found is None:
        return Finding(
            name,
            "note",
            len(rows),
            LEAST_ROWS,
            f"{_count(len(rows), 'iteration')}: too few to tell whether the reward rises; "
            f"{LEAST_ROWS} are needed.",
            "kreps resume RUN --iterations 20",
        )
    least = LEAST_RISE * reward_range(rows)
    judged_by = max(found.error, least)
    past = f"over the last {found.iterations} iterations"
    rise = f"{found.rise:+.3g} ± {found.error:.2g}"
    if found.falls(least):
        return Finding(
            name,
            "limit",
            found.rise,
            -judged_by,
            f"The reward falls: {rise} {past}.",
            "smaller steps (--set kl_bound=0.3), from more roll-outs each "
            "(--set rollouts_per_iteration=20). Earlier policies are not kept; the same run with "
            "fewer iterations gives the best of them again.",
        )
    if found.rises(least):
        return Finding(
            name, "fine", found.rise, judged_by, f"The reward still rises: {rise} {past}."
        )
    level = f"The reward does not rise ({rise} {past})"
    reward, values = reward_of(rows, evaluation), list(references.values())
    if values and values[0] - reward < REWARD_NEAR * (values[0] - values[-1]):
        return Finding(
            name,
            "fine",
            found.rise,
            judged_by,
            f"{level}, but is near the best known one ({values[0]:g}): little is left to gain.",
        )
    if not found.below(LEVEL * reward_range(rows)):
        return Finding(
            name,
            "note",
            found.rise,
            judged_by,
            f"Whether the reward rises cannot be told from its noise ({rise} {past}).",
            f"more iterations (kreps resume RUN --iterations {2 * len(rows)}), or more roll-outs "
            "in each (--set rollouts_per_iteration=20).",
        )
    half = rows[-found.iterations :]
    used = float(np.mean(column(half, "kl") / column(half, "kl_bound")))
    if used > BOUND_UNUSED:
        return Finding(
            name,
            "limit",
            found.rise,
            judged_by,
            f"{level}, though the updates use {used:.0%} of the KL bound: they follow errors of "
            "the model, or noise.",
            "more data (--set rollouts_per_iteration=20 --set window=60), or less trust in it "
            f"(--set kl_bound=0.5 {higher_floor(rows)}).",
        )
    return Finding(
        name, "fine", found.rise, judged_by, f"{level}, and the updates are small: it has settled."
    )


# ---- the step ---------------------------------------------------------------------------------


def step(rows: Sequence[Row]) -> Finding:
    """Whether the KL bound or the least temperature holds the update back."""
    name = "step"
    late = rows[-RECENT:]
    share = float(np.mean(column(late, "kl") / column(late, "kl_bound")))
    bound = latest(rows, "kl_bound")
    floor = latest(rows, "eta_floor")
    at_floor = np.mean([row["outcome"] == Outcome.AT_FLOOR.name for row in late]) > 0.5
    if share >= BOUND_USED and still_rising(rows):
        return Finding(
            name,
            "limit",
            share,
            BOUND_USED,
            f"The updates use {share:.0%} of the KL bound ({bound:g}), and the reward still rises: "
            "the run was stopped while it learnt.",
            f"more iterations: kreps resume RUN --iterations {2 * len(rows)}",
        )
    if at_floor and share < BOUND_UNUSED:
        least = f" ({floor:.2g})" if np.isfinite(floor) else ""
        found = improving(rows)
        if found is None or found.rises(LEAST_RISE * reward_range(rows)):
            return Finding(
                name,
                "fine",
                share,
                BOUND_UNUSED,
                f"The updates use {share:.0%} of the KL bound ({bound:g}): eta is at its floor"
                f"{least}, so that decides the step.",
            )
        lower = (
            "" if floor <= ETA_FLOOR_WITH_ACCEPTANCE_TEST else ", and only then a lower eta_floor"
        )
        return Finding(
            name,
            "note",
            share,
            BOUND_UNUSED,
            f"The updates use {share:.0%} of the KL bound, as eta is at its floor{least}: the run "
            "has converged as far as its data and its model tell.",
            "if it is not good enough, more data for each update "
            f"(--set rollouts_per_iteration=20 --set window=60){lower}.",
        )
    said = f"The updates use {share:.0%} of the KL bound ({bound:g})."
    return Finding(name, "fine", share, BOUND_USED, said)


def effective_samples(rows: Sequence[Row]) -> Finding:
    """Whether enough samples keep weight after the update."""
    name = "effective samples"
    late = rows[-RECENT:]
    count = float(np.mean(effective_share(late) * targets(late)))
    share = float(np.mean(effective_share(late)))
    remedy = (
        "smaller steps (--set kl_bound=0.5), or more roll-outs "
        "(--set rollouts_per_iteration=20 --set window=60)."
    )
    if count < LEAST_EFFECTIVE:
        return Finding(
            name,
            "limit",
            count,
            LEAST_EFFECTIVE,
            f"The weights rest on {count:.0f} effective samples: too few to fit a policy to, and "
            "luck decides which.",
            remedy,
        )
    if share < LEAST_SHARE:
        return Finding(
            name,
            "note",
            share,
            LEAST_SHARE,
            f"The weights leave {share:.1%} of the samples ({count:.0f} effective ones): most of "
            "what was tried does not count.",
            remedy,
        )
    return Finding(
        name,
        "fine",
        count,
        LEAST_EFFECTIVE,
        f"The weights rest on {count:.0f} effective samples, {share:.0%} of all.",
    )


def judgement(rows: Sequence[Row]) -> Finding | None:
    """Whether new policies pass the model's judgement; None if nothing was judged."""
    name = "judgement"
    share = recent(rows, "refused")
    if not np.isfinite(share):
        return None
    said = f"Of the latest updates the model found {share:.0%} worse than the policy before"
    if share <= REFUSED_NOTE:
        return Finding(name, "fine", share, REFUSED_NOTE, f"{said}.")
    return Finding(
        name,
        "note",
        share,
        REFUSED_NOTE,
        f"{said}, which acts on: what V promises, roll-outs in the model do not keep.",
        "nothing, if the reward is good enough; else more data for each update "
        "(--set rollouts_per_iteration=20 --set window=60).",
    )


# ---- the model and V --------------------------------------------------------------------------


def model(rows: Sequence[Row]) -> Finding | None:
    """Whether the transition model predicts; None if there is none."""
    name = "transition model"
    error = recent(rows, "model_error")
    if not np.isfinite(error):
        return None
    said = f"Its relative leave-one-out error is {error:.2f} (1: as good as no model)"
    if error < ERROR_NOTE:
        return Finding(name, "fine", error, ERROR_NOTE, f"{said}: it predicts well.")
    found = trend(column(rows, "model_error"))
    if found is not None and found.falls(MODEL_FALL * error):
        said += ", and it falls."
        more = "more iterations or roll-outs, which bring it down further"
    else:
        said += " and does not fall."
        more = "more roll-outs (--set rollouts_per_iteration=20 --set window=60)"
    return Finding(
        name,
        "limit" if error >= ERROR_LIMIT else "note",
        error,
        ERROR_LIMIT if error >= ERROR_LIMIT else ERROR_NOTE,
        said,
        f"{more}; naming angles (--periodic) or the shape of images (image_shape); leaving out "
        "coordinates that say nothing; a shorter time step. What is noise of the task itself "
        "stays.",
    )


def basis(rows: Sequence[Row]) -> Finding | None:
    """Whether the basis of V was cut short; None if that was not recorded."""
    name = "basis of V"
    last = rows[-1]
    rank, cap = int(last["rank"]), float(last["max_rank"])
    if not recorded(rows):
        return None
    if not np.isfinite(cap):
        return Finding(
            name,
            "note",
            rank,
            cap,
            f"V has {rank} features, a number fixed beforehand (a grid, or Fourier features): what "
            "they leave out is not measured.",
            f"more of them: a larger grid_size, or for Fourier features --set max_rank={2 * rank}.",
        )
    residual = float(last["rank_residual"])
    if rank < cap:
        said = f"Complete with {rank} features of at most {cap:.0f}."
        return Finding(name, "fine", rank, cap, said)
    if residual < RESIDUAL_NOTE:
        said = f"Full with {rank} features, and what they leave out ({residual:.1g}) is little."
        return Finding(name, "fine", residual, RESIDUAL_NOTE, said)
    return Finding(
        name,
        "limit" if residual >= RESIDUAL_LIMIT else "note",
        residual,
        RESIDUAL_LIMIT if residual >= RESIDUAL_LIMIT else RESIDUAL_NOTE,
        f"Cut short at {rank} features: for some states {residual:.2g} of their kernel's square "
        "is missing, and V is coarse there.",
        f"a higher cap (--set max_rank={2 * rank}); the time of an update grows with its square.",
    )


# ---- exploration ------------------------------------------------------------------------------


def noise(rows: Sequence[Row], evaluation: Mapping[str, Any] | None) -> Finding | None:
    """Whether the policy explores, and what that costs; None if its noise was not recorded."""
    name = "exploration noise"
    size = recent(rows, "policy_noise")
    if not np.isfinite(size):
        return None
    said = f"Near its data the policy's noise is {size:.2g} of half the action range"
    if size < NOISE_LEAST:
        return Finding(
            name,
            "note" if still_rising(rows) else "limit",
            size,
            NOISE_LEAST,
            f"{said}: it tries hardly anything new.",
            "a new run with smaller steps (--set kl_bound=0.5) or a higher least temperature "
            f"({higher_floor(rows)}), so that it shrinks more slowly.",
        )
    if size > NOISE_MOST:
        return Finding(
            name,
            "note",
            size,
            NOISE_MOST,
            f"{said}: more than the limits let through. The samples do not yet agree on what to "
            "do.",
            "more iterations or roll-outs; see the transition model, too.",
        )
    if evaluation:
        cost = evaluation["greedy"]["mean"] - evaluation["stochastic"]["mean"]
        seen = reward_range(rows)
        if cost > NOISE_COST * seen > 0.0:
            return Finding(
                name,
                "note",
                cost,
                NOISE_COST * seen,
                f"{said}, and it costs {cost:.3g} of reward per step.",
                "the policy without its noise, predict(observation, deterministic=True); more "
                "iterations, which shrink it.",
            )
        return Finding(name, "fine", size, NOISE_MOST, f"{said}; it costs little.")
    return Finding(name, "fine", size, NOISE_MOST, f"{said}.")


def clipping(rows: Sequence[Row]) -> Finding | None:
    """Whether exploration can be felt inside the limits; None if it was not recorded."""
    name = "clipped actions"
    share = recent(rows, "clipped")
    if not np.isfinite(share):
        return None
    if share >= CLIPPED_NOTE:
        return Finding(
            name,
            "note",
            share,
            CLIPPED_NOTE,
            f"{share:.0%} of the commands lie beyond the limits: there the noise changes nothing, "
            "so little else is tried.",
            "nothing, if the task wants full force all the time; otherwise a new run with another "
            "--seed or smaller steps (--set kl_bound=0.5), or larger limits.",
        )
    return Finding(
        name, "fine", share, CLIPPED_NOTE, f"{share:.0%} of the commands lie beyond the limits."
    )


def _count(number: int, thing: str) -> str:
    return f"{number} {thing}" + ("" if number == 1 else "s")
