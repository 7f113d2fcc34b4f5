"""Policies that regulators are part of, and the candidates of an update."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kreps.algorithms.candidates import with_regulators
from kreps.algorithms.policy_targets import PolicyFit
from kreps.algorithms.regulated_policies import (
    SwitchingPolicies,
    best_regulator,
    best_switching_policy,
)
from kreps.algorithms.regulators import regulators
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from tests.pole import TASK, compared, observed, steps_upright


def idle(noise: float = 0.25) -> CostSensitiveGP:
    """A policy whose mean is no torque."""
    env = compared().from_starts
    states = compared().world.states[::5]
    none = np.zeros((len(states), 1))
    return CostSensitiveGP(TASK, env.kernel, states, none, np.ones(len(states)), 1.0, noise)


def test_a_switching_policy_is_the_regulator_near_its_equilibrium_only() -> None:
    (_, regulator), policy = regulators(compared().world, compared().from_starts, 1), idle(0.04)
    states = np.array([observed(angle, 0.0) for angle in (0.0, 0.1, 0.5, 1.0)])
    cost = float(regulator.with_expected_costs(states[2:3])[1][0])
    switching = SwitchingPolicies(policy.predictor, [(regulator, cost)])
    wanted = np.append(regulator.scaled(states[:3])[:, 0], 0.0)[:, None]
    np.testing.assert_allclose(switching.scaled(states), wanted, atol=1e-12)
    noise = np.ones((4, 1))
    deviation = policy.standard_deviation(states)
    np.testing.assert_allclose(
        switching.act(states, noise), TASK.unscaled(wanted) + deviation, rtol=1e-9
    )


def test_switching_policies_side_by_side_have_the_returns_of_each_alone() -> None:
    """Also where episodes end at different steps."""
    policy, found = idle(1e-2).predictor, regulators(compared().world, compared().from_starts, 2)
    switches = [(regulator, size) for regulator in found for size in (0.0, 1.0, np.inf)]
    alone = [compared().returns(SwitchingPolicies(policy, [each])) for each in switches]
    together = SwitchingPolicies(policy, switches)
    returns = compared().returns(together, len(switches))
    np.testing.assert_allclose(returns, np.concatenate(alone), rtol=1e-6, atol=1e-9)
    means = [float(each.mean()) for each in alone]
    assert max(means) - min(means) > 0.1
    assert together.best(compared(), 1).switches == [switches[int(np.argmax(means))]]


def test_a_fit_to_the_best_switching_policy_keeps_the_pole_upright() -> None:
    """An idle policy lets it fall; so the regulator has to act in most states."""
    found = regulators(compared().world, compared().from_starts, 2)
    policy = idle(1e-2)
    fit = best_switching_policy(compared(), policy.predictor, found)
    assert steps_upright(policy) < 15
    assert steps_upright(fit) > 250
    assert compared().returns(fit).mean() > compared().returns(policy).mean()
    assert fit.noise == policy.noise and len(fit.states) <= 300


def test_a_fit_to_the_best_regulator_keeps_the_pole_upright() -> None:
    """Random torques keep it up for about ten steps, and no sample is of a longer rollout."""
    world, env = compared().world, compared().from_starts
    assert steps_upright(idle()) < 15
    found = best_regulator(compared(), idle().predictor, regulators(world, env, 2), env.kernel)
    assert steps_upright(found) == 300
    np.testing.assert_allclose(found.standard_deviation(world.states), 0.01 * 2.0, rtol=1e-6)


@pytest.mark.parametrize(("ends", "noise"), [(True, 1e-4), (False, 0.25)])
def test_regulators_act_alone_only_where_episodes_end(ends: bool, noise: float) -> None:
    policy = idle()
    fit = PolicyFit(policy, np.zeros(1), 100, 0.25)
    case = replace(compared(), has_ends=ends)
    before, kernel = case.returns(policy), case.from_starts.kernel
    found, returns = with_regulators(fit, before, case, kernel, 2)
    np.testing.assert_array_equal(returns, case.returns(found.policy))
    assert returns.mean() > before.mean()
    assert found.noise == pytest.approx(noise)
    assert with_regulators(fit, before, case, kernel, 0) == (fit, before)
    # a policy that is better is kept
    hopeless = returns + 1.0
    assert with_regulators(fit, hopeless, case, kernel, 2) == (fit, hopeless)
