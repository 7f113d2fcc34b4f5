"""The expected KL divergence between successive policies."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

import kreps
from kreps.algorithms.policy_divergence import expected_policy_kl, gaussian_kl
from kreps.data.rollouts import Rollout, Transitions
from kreps.policies.exploration import BangBang

TASK = kreps.TaskSpec(2, [-2.0], [2.0])


def rollouts_of(seed: int, count: int = 6) -> list[Rollout]:
    rng = np.random.default_rng(seed)
    return [
        Rollout(rng.normal(size=(11, 2)), rng.normal(size=(10, 1)), rng.normal(size=10))
        for _ in range(count)
    ]


def test_the_divergence_of_two_normal_distributions_is_the_integral() -> None:
    new, old = scipy.stats.norm(0.4, 0.8), scipy.stats.norm(-0.3, 1.5)
    integral, _ = scipy.integrate.quad(
        lambda u: new.pdf(u) * (new.logpdf(u) - old.logpdf(u)), -10, 10
    )
    one, other = np.array([[0.4, 0.0]]), np.array([[0.8, 1.0]])
    found = gaussian_kl(one, other, np.array([[-0.3, 0.0]]), np.array([[1.5, 1.0]]))
    assert found[0] == pytest.approx(integral)


@pytest.mark.parametrize("preset", ["model_based", "single_step", "authors"])
def test_an_update_reports_the_divergence_over_its_states(preset: str) -> None:
    learner = kreps.KREPS(TASK, preset=preset, restart_probability=0.1)
    first = learner.update(rollouts_of(0))
    assert math.isnan(first.policy_kl)  # there is no policy before
    before = learner.policy.process
    second = learner.update(rollouts_of(1))
    states = Transitions.from_rollouts(rollouts_of(0) + rollouts_of(1)).states
    after = learner.policy.process
    if not second.rejected:
        new, old = (p.predictor if hasattr(p, "predictor") else p for p in (after, before))
        divergence = gaussian_kl(
            new.greedy(states),
            new.standard_deviation(states),
            old.greedy(states),
            old.standard_deviation(states),
        )
        assert second.policy_kl == pytest.approx(divergence.mean())
    assert second.policy_kl > 0.0
    assert expected_policy_kl(before, before, Transitions.from_rollouts(rollouts_of(0))) == 0.0


def test_it_is_of_gaussian_policies_only() -> None:
    data = Transitions.from_rollouts(rollouts_of(0))
    other = BangBang(TASK)
    assert math.isnan(expected_policy_kl(other, other, data))  # type: ignore[arg-type]
