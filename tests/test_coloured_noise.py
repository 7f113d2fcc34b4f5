"""Temporally correlated exploration noise: its distribution, spectrum and boundary."""

from __future__ import annotations

import numpy as np
import pytest

from kreps.policies.exploration import coloured_noise, noise_rows

WHITE, PINK, RED = 0.0, 1.0, 2.0


@pytest.mark.parametrize("exponent", [PINK, RED])
def test_coloured_noise_is_standard_normal_and_independent_across_columns(exponent: float) -> None:
    rng = np.random.default_rng(0)
    draws = np.stack([coloured_noise(exponent, 40, 2, rng) for _ in range(4000)])
    assert draws.shape == (4000, 40, 2)
    np.testing.assert_allclose(draws.mean(axis=0), 0.0, atol=0.08)
    np.testing.assert_allclose(draws.std(axis=0), 1.0, atol=0.06)
    tails = np.mean(np.abs(draws) > 1.96)
    assert tails == pytest.approx(0.05, abs=0.005)
    assert abs(np.mean(draws[..., 0] * draws[..., 1])) < 0.02


@pytest.mark.parametrize("exponent", [PINK, RED])
def test_the_power_spectrum_falls_with_the_given_exponent(exponent: float) -> None:
    rng = np.random.default_rng(1)
    length = 256
    draws = np.stack([coloured_noise(exponent, length, 1, rng)[:, 0] for _ in range(3000)])
    windowed = draws * np.hanning(length)  # the sequence is not periodic
    power = np.mean(np.abs(np.fft.rfft(windowed, axis=1)) ** 2, axis=0)
    k = np.array([8, 16, 32, 64])
    slope = np.polyfit(np.log(k), np.log(power[k]), 1)[0]
    assert slope == pytest.approx(-exponent, abs=0.1)


def test_the_end_of_a_rollout_is_not_correlated_with_its_beginning() -> None:
    rng = np.random.default_rng(2)
    draws = np.stack([coloured_noise(RED, 50, 1, rng)[:, 0] for _ in range(4000)])
    assert np.mean(draws[:, 0] * draws[:, 1]) > 0.9
    assert np.mean(draws[:, 0] * draws[:, -1]) < 0.0  # half a period away


def test_white_noise_is_the_generators_own() -> None:
    found = coloured_noise(WHITE, 7, 3, np.random.default_rng(3))
    rng = np.random.default_rng(3)
    np.testing.assert_array_equal(found, np.stack([rng.standard_normal(3) for _ in range(7)]))


def test_a_rollout_of_one_step_has_finite_noise() -> None:
    assert np.isfinite(coloured_noise(PINK, 1, 2, np.random.default_rng(4))).all()


@pytest.mark.parametrize("exponent", [WHITE, PINK, RED])
def test_rows_of_noise_are_those_of_all_steps_at_once(exponent: float) -> None:
    rows = noise_rows(exponent, 300, 2, np.random.default_rng(3))
    wanted = coloured_noise(exponent, 300, 2, np.random.default_rng(3))
    np.testing.assert_array_equal(np.array(list(rows)), wanted)


@pytest.mark.parametrize("exponent", [WHITE, PINK, RED])
def test_noise_of_a_rollout_without_end_is_drawn_as_it_is_needed(exponent: float) -> None:
    rows = noise_rows(exponent, 10**18, 1, np.random.default_rng(3))
    some = np.array([next(rows) for _ in range(70_000)])
    assert np.isfinite(some).all()
    white = noise_rows(WHITE, 70_000, 1, np.random.default_rng(3))
    twin = np.random.default_rng(3).standard_normal((70_000, 1))
    np.testing.assert_array_equal(np.array(list(white)), twin)
