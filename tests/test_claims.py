"""The claims of the paper: effects over seeds, intervals that cover, corrected verdicts."""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from kreps.errors import StorageError
from kreps.experiments import claims, verdicts
from kreps.experiments.claims import CLAIMS, Claim, Kind
from kreps.experiments.specs import COLUMNS
from kreps.experiments.statistics import (
    effect_of,
    holm_adjusted,
    holm_levels,
    probability_of_superiority,
)
from kreps.experiments.verdicts import assess, compare, verdict, write_claims
from kreps.seeding import Purpose, integer_seed

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
import coverage

# ---- statistics -------------------------------------------------------------------------------


def test_location_and_error_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    first, second = rng.normal(1.0, 1.0, 12), rng.normal(0.0, 3.0, 10)
    for trimmed in (0.0, 0.25):
        found = effect_of([first, second], rng, trimmed=trimmed)
        means = [stats.trim_mean(sample, trimmed) for sample in (first, second)]
        assert found.estimate == pytest.approx(means[0] - means[1])
        yuen = stats.ttest_ind(first, second, equal_var=False, trim=trimmed)
        assert found.estimate / found.error == pytest.approx(yuen.statistic)
        assert found.freedom == pytest.approx(yuen.df)


def test_p_values_and_intervals_agree() -> None:
    found = effect_of([np.random.default_rng(1).normal(size=10)], np.random.default_rng(2))
    for level in (0.9, 0.95, 0.998):
        low, high = found.interval(level)
        for end in (low, high):
            away = 1e-9 * np.sign(end - found.estimate)
            assert found.p_value(end + away) <= 1 - level + 1e-12
            assert found.p_value(end - 1e6 * away) > 1 - level


@pytest.mark.parametrize("scores", ["normal", "1 in 10 fails", "3 in 10 fail"])
def test_the_interval_holds_the_true_value_as_often_as_it_says(scores: str) -> None:
    """Of 300 samples of ten seeds at least 92 %: 95 % less 2.4 standard errors of the count.

    ``benchmarks/coverage.py`` has more samples, distributions and methods.
    """
    draws = coverage.CASES[scores]
    values = {"normal": 0.0, "1 in 10 fails": -0.08, "3 in 10 fail": -4.19}
    held = {0.0: 0, 0.25: 0}
    for number in range(300):
        rng = np.random.default_rng((7, number))
        sample = draws[0](rng, (10,))
        means = {"normal": 0.0, "1 in 10 fails": -4.0, "3 in 10 fail": -12.0}
        for trimmed, value in ((0.25, values[scores]), (0.0, means[scores])):
            low, high = effect_of([sample], rng, trimmed=trimmed, resamples=399).interval(0.95)
            held[trimmed] += low <= value <= high
    assert held[0.25] >= 0.92 * 300
    if scores == "1 in 10 fails":  # why verdicts are not about the mean
        assert held[0.0] < 0.75 * 300


def test_holm_is_stricter_than_single_tests_and_milder_than_bonferroni() -> None:
    p_values = [0.04, 0.001, 0.03, 0.012]
    assert holm_adjusted(p_values) == pytest.approx([0.06, 0.004, 0.06, 0.036])
    levels = holm_levels(p_values)
    assert levels == pytest.approx([1 - 0.05 / 2, 1 - 0.05 / 4, 1 - 0.05 / 2, 1 - 0.05 / 3])
    for p, level, adjusted in zip(p_values, levels, holm_adjusted(p_values), strict=True):
        assert (p <= 1 - level) == (adjusted <= 0.05)
    # after the first one that is not significant, none is
    assert holm_levels([0.001, 0.04, 0.045])[2] == pytest.approx(1 - 0.05 / 2)


def test_probability_of_superiority() -> None:
    assert probability_of_superiority([np.array([1.0, 2.0, 0.0, -1.0])]) == 0.625
    assert probability_of_superiority([np.array([1.0, 3.0]), np.array([2.0, 0.0])]) == 0.75


def test_training_and_evaluation_have_seeds_of_their_own() -> None:
    seeds = range(30)
    training = {
        integer_seed(seed, Purpose.ENVIRONMENT, iteration, rollout)
        for seed in seeds
        for iteration in range(20)
        for rollout in range(30 if iteration == 0 else 10)
    }
    evaluation = {
        integer_seed(seed, Purpose.EVALUATION_ENVIRONMENT, rollout)
        for seed in seeds
        for rollout in range(200)
    }
    assert len(training) == 30 * (30 + 19 * 10)
    assert len(evaluation) == 30 * 200
    assert not training & evaluation


# ---- claims -----------------------------------------------------------------------------------


def rows_with(
    curve: str,
    values: Sequence[float],
    task: str = "reaching",
    iterations: int = 15,
    shared: bool = False,
) -> list[dict[str, str]]:
    """Rows of a curve, with the same first rollouts as those of other ``shared`` curves."""
    return [
        {
            "task": task,
            "method": curve,
            "seed": str(seed),
            "iteration": str(iteration),
            "steps": str(100 * iteration),
            "training_reward": str(seed) if shared else f"{curve}, {seed}",
            "stochastic": str(value + 0.001 * iteration),
            "greedy": str(value),
        }
        for seed, value in enumerate(values)
        for iteration in range(1, iterations + 1)
    ]


def claim_of(better: str, worse: str | None, kind: Kind = Kind.BETTER, **changes: Any) -> Claim:
    return Claim("a claim", "figure-1b", better, worse, changes.get("measure", claims.late), kind)


def assessed(claim: Claim, rows: list[dict[str, str]]) -> dict[str, Any]:
    """The row of a claim that is tested alone."""
    comparison = compare(claim, rows)
    assert comparison is not None
    (found,) = assess([comparison])
    return found


def test_the_verdict_follows_from_the_interval_of_the_difference() -> None:
    rng = np.random.default_rng(1)
    good, bad = rng.normal(10.0, 0.5, 10), rng.normal(0.0, 0.5, 10)
    rows = [*rows_with("A", good.tolist()), *rows_with("B", bad.tolist())]
    found = assessed(claim_of("A", "B"), rows)
    difference = stats.trim_mean(good, 0.25) - stats.trim_mean(bad, 0.25)
    assert found["effect"] == pytest.approx(difference, abs=1e-4)
    assert found["mean"] == pytest.approx(good.mean() - bad.mean(), abs=1e-4)
    assert found["low"] < found["effect"] < found["high"]
    assert (found["level"], found["superiority"], found["paired"]) == (0.95, 1.0, False)
    assert found["verdict"] == "confirmed"
    assert assessed(claim_of("B", "A"), rows)["verdict"] == "contradicted"
    assert compare(claim_of("A", "C"), rows) is None


def test_a_small_effect_is_no_better_however_certain() -> None:
    rows = [*rows_with("A", [1.0, 1.1] * 5), *rows_with("B", [0.0, 0.1] * 5)]
    found = assessed(claim_of("A", "B"), rows)  # the margin is 4
    assert found["low"] > 0.0
    assert found["verdict"] == "within the margin"
    assert assessed(claim_of("B", "A", Kind.AS_GOOD), rows)["verdict"] == "confirmed"


def test_seeds_with_the_same_first_rollouts_are_paired() -> None:
    spread = np.linspace(-30.0, 30.0, 10)  # between seeds, the same for both curves
    noise = np.random.default_rng(3).normal(size=10)
    for shared, found in ((True, "confirmed"), (False, "not separated")):
        rows = [
            *rows_with("A", (spread + 6.0 + noise).tolist(), shared=shared),
            *rows_with("B", spread.tolist(), shared=shared),
        ]
        row = assessed(claim_of("A", "B"), rows)
        assert (row["paired"], row["verdict"]) == (shared, found)
    assert row["superiority"] < 0.8


def test_the_correction_is_over_all_claims() -> None:
    rng = np.random.default_rng(5)
    rows = [
        *rows_with("A", rng.normal(7.0, 5.0, 10).tolist()),
        *rows_with("B", rng.normal(0.0, 5.0, 10).tolist()),
        *rows_with("C", rng.normal(0.0, 5.0, 10).tolist()),
    ]
    alone = assessed(claim_of("A", "B"), rows)
    assert alone["verdict"] == "confirmed"
    comparisons = [compare(claim_of("A", "B"), rows)]
    comparisons += [compare(claim_of("C", "B"), rows)] * 1
    comparisons += [compare(claim_of("C", "B", measure=claims.whole), rows) for _ in range(30)]
    together = assess([each for each in comparisons if each is not None])[0]
    assert together["level"] == pytest.approx(1 - 0.05 / 32, abs=1e-5)
    assert together["high"] - together["low"] > alone["high"] - alone["low"]
    assert together["interval_95"] == alone["interval_95"] == [alone["low"], alone["high"]]
    assert together["verdict"] == "not separated"


def test_a_claim_about_a_single_curve() -> None:
    rows = rows_with("A", [1.0, 2.0, 5.0, 3.0, 7.0, 4.0])
    gains = assessed(claim_of("A", None, measure=claims.later_gain), rows)
    assert gains["effect"] == pytest.approx(0.001 * (13.0 - 7.0), abs=1e-4)
    assert (gains["comparison"], gains["superiority"]) == ("A", 1.0)


def test_curves_are_compared_over_their_common_iterations() -> None:
    long = rows_with("A", [0.0] * 6, iterations=20)
    found = assessed(claim_of("A", "B"), [*long, *rows_with("B", [0.0] * 6, iterations=15)])
    assert (found["iterations"], found["effect"]) == (15, 0.0)
    once = assessed(claim_of("A", "B"), [*long, *rows_with("B", [0.0] * 6, iterations=1)])
    assert once["iterations"] == 20  # one iteration is all that the other needs


@pytest.mark.parametrize(
    ("seeds", "iterations", "reason"),
    [
        (1, 20, "too few seeds: 1, at least 6"),
        (5, 20, "too few seeds: 5, at least 6"),
        (6, 1, "too few iterations: 1, at least 14"),
        (6, 13, "too few iterations: 13, at least 14"),
    ],
)
@pytest.mark.parametrize("worse", ["B", None])
@pytest.mark.filterwarnings("error")
def test_too_few_seeds_or_iterations_get_no_verdict(
    seeds: int, iterations: int, reason: str, worse: str | None
) -> None:
    rows = rows_with("A", [1.0] * seeds, iterations=iterations)
    rows += rows_with("B", [0.0] * 10, iterations=iterations)
    for measure in (claims.early, claims.late, claims.later_gain, claims.steadiness):
        found = assessed(claim_of("A", worse, measure=measure), rows)
        assert found["verdict"] == reason
        assert found["effect"] is found["low"] is found["high"] is None
        row = verdicts.claims_table([found]).splitlines()[2]
        assert f"| – | – | – | – | – | **{reason}** |" in row and "nan" not in row


@pytest.mark.filterwarnings("error")
def test_seeds_that_are_all_equal_have_an_interval_without_a_warning() -> None:
    found = assessed(claim_of("A", "B"), [*rows_with("A", [5.0] * 6), *rows_with("B", [0.0] * 6)])
    assert found["effect"] == found["low"] == found["high"] == 5.0
    assert found["verdict"] == "confirmed"


@pytest.mark.parametrize(
    ("estimate", "low", "high", "kind", "found"),
    [
        (0.5, 0.1, 1.0, Kind.BETTER, "confirmed"),
        (0.15, 0.1, 0.2, Kind.BETTER, "within the margin"),
        (-0.5, -1.0, -0.1, Kind.BETTER, "contradicted"),
        (0.0, -0.1, 0.1, Kind.BETTER, "not separated"),
        (0.5, -0.1, 1.0, Kind.BETTER, "not separated"),
        (0.0, -0.1, 0.1, Kind.AS_GOOD, "confirmed"),
        (5.5, 5.0, 6.0, Kind.AS_GOOD, "confirmed"),
        (-0.1, -0.3, 0.1, Kind.AS_GOOD, "not separated"),
        (-0.4, -0.5, -0.3, Kind.AS_GOOD, "contradicted"),
        (0.0, -0.1, 0.1, Kind.EQUAL, "confirmed"),
        (0.4, 0.3, 0.5, Kind.EQUAL, "contradicted"),
        (0.2, -0.1, 0.5, Kind.EQUAL, "not separated"),
    ],
)
def test_verdicts(estimate: float, low: float, high: float, kind: Kind, found: str) -> None:
    assert verdict(estimate, low, high, kind, 0.2) == found


@pytest.mark.parametrize("kind", Kind)
@pytest.mark.parametrize("centre", [-6.0, -4.5, -1.0, 1.0, 6.0])
def test_a_claim_is_decided_if_its_p_value_is_small_enough(kind: Kind, centre: float) -> None:
    sample = centre + np.random.default_rng(0).normal(0.0, 2.0, 10)
    effect = effect_of([sample], np.random.default_rng(1))
    p = verdicts.p_value(effect, kind, 4.0)
    for level in (0.5, 0.9, 0.95, 0.99, 0.998):
        found = verdict(effect.estimate, *effect.interval(level), kind, 4.0)
        assert (found != "not separated") == (p <= 1 - level + 1e-12)


def test_measures() -> None:
    rows = [{"stochastic": str(v), "greedy": str(v + 1)} for v in (0, 1, 2, 3, 9, 5, 7, 6, 8, 8)]
    assert claims.early(rows) == 1.5
    assert claims.late(rows) == pytest.approx((5 + 7 + 6 + 8 + 8) / 5)
    assert claims.late_greedy(rows) == pytest.approx(claims.late(rows) + 1)
    assert claims.later_gain(rows) == pytest.approx(claims.late(rows) - (9 + 5 + 7 + 6 + 8) / 5)
    assert claims.steadiness(rows) == -1.0
    assert claims.whole(rows) == pytest.approx(4.9)


def test_claims_name_curves_of_their_column() -> None:
    for claim in CLAIMS:
        curves = COLUMNS[claim.figure][claim.column]
        several = claim.figure == "figure-2b"
        shown = {f"{method}, {task}" if several else method for task, method in curves}
        assert {claim.better, claim.worse} <= {*shown, None}
        assert claim.margin > 0.0
    texts = {(claim.column, number % 23): claim.text for number, claim in enumerate(CLAIMS)}
    assert len(CLAIMS) == len(texts) == 46
    for number in range(23):  # each is asked of both columns
        assert texts[claims.AS_SCRIPTS, number] == texts[claims.AS_PRINTED, number]


def test_claims_are_written_from_result_files(tmp_path: Path) -> None:
    assert write_claims(tmp_path) == []
    better, worse = [-0.2, -0.3, -0.25] * 4, [-0.5, -0.4, -0.5] * 4
    rows = [*rows_with("kernel REPS (paper)", better), *rows_with("NPALP (default)", worse)]
    with open(tmp_path / "figure-1a.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    assert [path.name for path in write_claims(tmp_path)] == ["claims.json", "claims.md"]
    found = json.loads((tmp_path / "claims.json").read_text())
    assert {c["comparison"] for c in found} >= {
        "kernel REPS (paper) - NPALP (default)",
        "NPALP (default) - kernel REPS (paper)",
    }
    assert "**confirmed**" in (tmp_path / "claims.md").read_text()
    (tmp_path / "figure-1a.csv").write_text("other,columns\n1,2\n")
    with pytest.raises(StorageError, match="figure-1a"):
        write_claims(tmp_path)
