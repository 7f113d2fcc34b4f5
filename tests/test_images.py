"""Kernels of images, the shape of images in a task, and the origin of the embedding."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import kreps
from kreps.algorithms.state import LearnerState
from kreps.algorithms.update import batch_of
from kreps.data.compute import Compute
from kreps.data.rollouts import Rollout, Transitions
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.envs.image_swing_up import PIXELS, image
from kreps.errors import ConfigurationError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import RKHSBasis
from kreps.kernels.gram import squared_distances
from kreps.kernels.kernel import (
    IMAGE_BLUR,
    Kernel,
    SmoothedImage,
    SquaredExponential,
    factors_of,
    median_lengthscales,
)
from kreps.kernels.regression import KernelEmbedding
from kreps.learning.storage.checksum import sealed
from kreps.models.transition import embedding_origin, state_kernel, successor_features
from kreps.presets import settings_of

ALL = tuple(range(PIXELS**2))
SMOOTHED = SmoothedImage(ALL, (PIXELS, PIXELS))
RAW = SquaredExponential(ALL)
DEGREES = np.arange(0, 181, 5)


def distances_from_start(factor: SmoothedImage | SquaredExponential, start: float) -> FloatArray:
    """Of the rod at ``start`` (rad) and turned by each of `DEGREES`; of opposite rods: one."""
    pictures = image(start + np.deg2rad(DEGREES))
    distances: FloatArray = np.sqrt(squared_distances(factor.coordinates(pictures))[0])
    return distances / distances[-1]


# ---- the kernel -------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(3, 5), (5, 3), (1, 6), (4, 4)])
def test_gram_matrices_are_positive_semi_definite(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    size = shape[0] * shape[1]
    x = rng.normal(size=(40, 2 * size))
    factors = factors_of(2 * size, groups=(range(size), range(size, 2 * size)), image_shape=shape)
    kernel = Kernel(factors, median_lengthscales(factors, x, rng))
    gram = kernel.gram(x)
    np.testing.assert_allclose(gram, gram.T, atol=1e-12)
    np.testing.assert_array_equal(np.diagonal(gram), 1.0)
    assert np.linalg.eigvalsh(gram).min() > -1e-12
    assert 0.0 <= gram.min() < 0.9
    # the product of one Gaussian for each image
    wanted = np.ones_like(gram)
    for factor, lengthscale in zip(factors, kernel.lengthscales, strict=True):
        wanted *= np.exp(-0.5 * squared_distances(factor.coordinates(x)) / lengthscale**2)
    np.testing.assert_allclose(gram, wanted, atol=1e-12)


@pytest.mark.parametrize("shape", [(20, 20), (7, 12), (12, 7)])
def test_distances_are_those_of_explicitly_smoothed_images(shape: tuple[int, int]) -> None:
    height, width = shape
    x = np.random.default_rng(1).normal(size=(5, height * width))
    found = SmoothedImage(tuple(range(height * width)), shape).coordinates(x)
    widths = (IMAGE_BLUR * height, IMAGE_BLUR * width)
    wanted = np.stack(
        [
            gaussian_filter(each.reshape(shape), widths, mode="constant", truncate=30.0).ravel()
            for each in x
        ]
    )
    # of a normal density on a grid of unit spacing, cut off nowhere
    factor = 2.0 * np.pi * widths[0] * widths[1]
    # in other axes, and fewer of them: what counts is distances
    assert found.shape[1] < height * width
    inner = factor**2 * wanted @ wanted.T
    np.testing.assert_allclose(found @ found.T, inner, atol=1e-6 * np.abs(inner).max())


def test_an_image_may_be_any_group_of_coordinates() -> None:
    rng = np.random.default_rng(2)
    dims = tuple(range(6, 18))
    x = rng.normal(size=(4, 20))
    alone = SmoothedImage(tuple(range(12)), (3, 4)).coordinates(x[:, dims])
    np.testing.assert_array_equal(SmoothedImage(dims, (3, 4)).coordinates(x), alone)
    # pixels are smoothed along rows and columns, not along their numbers
    pixels = SmoothedImage(tuple(range(20)), (10, 2)).coordinates(np.eye(20))
    tall = (pixels @ pixels[0]).reshape(10, 2)  # how much of each the first one has
    assert (tall[:, 1] < tall[:, 0]).all()
    assert tall[1, 0] > tall[0, 1]  # one of ten rows is nearer than one of two columns


def test_smoothing_is_linear() -> None:
    x, y = np.random.default_rng(3).normal(size=(2, 4, PIXELS**2))
    both = SMOOTHED.coordinates(2.0 * x - y)
    apart = 2.0 * SMOOTHED.coordinates(x) - SMOOTHED.coordinates(y)
    np.testing.assert_allclose(both, apart, atol=1e-9)


# ---- distances of pictures of the rod, as docs/deviations.md has them -------------------------


@pytest.mark.parametrize("start", np.deg2rad([0.0, 17.0, 45.0, 90.0, 133.0]))
def test_distances_grow_with_the_angle_where_raw_ones_saturate(start: float) -> None:
    smoothed, raw = (distances_from_start(f, start) for f in (SMOOTHED, RAW))
    quarter = DEGREES <= 90
    # from 60 to 90 degrees: a third more, where distances of raw images no longer grow
    growth = {}
    for name, distances in (("smoothed", smoothed), ("raw", raw)):
        growth[name] = distances[DEGREES == 90].item() / distances[DEGREES == 60].item()
    assert (np.diff(smoothed[quarter]) > 0.005).all()
    assert growth["smoothed"] > 1.25 and growth["raw"] < 1.1
    assert raw[DEGREES == 60].item() > 0.9 > 0.6 > smoothed[DEGREES == 60].item()
    chord = np.sin(np.deg2rad(DEGREES) / 2.0)
    assert np.abs(smoothed - chord).max() < 0.12 < 0.35 < np.abs(raw - chord).max()


def test_the_relative_distances_are_those_of_the_documentation() -> None:
    at = np.isin(DEGREES, (30, 90))
    np.testing.assert_allclose(distances_from_start(RAW, 0.0)[at], [0.65, 0.98], atol=0.006)
    np.testing.assert_allclose(distances_from_start(SMOOTHED, 0.0)[at], [0.34, 0.75], atol=0.006)
    page = (Path(__file__).resolve().parents[1] / "docs/deviations.md").read_text()
    assert "| raw images | 0.65 | 0.98 |\n| smoothed images | 0.34 | 0.75 |" in page


@pytest.mark.parametrize("velocity", [2.0, 5.0, 8.0])
def test_difference_images_of_one_speed_are_distinguished(velocity: float) -> None:
    """Raw ones are as far apart at 30 degrees as on opposite sides; smoothed ones are not."""
    angles = np.deg2rad(np.arange(0.0, 360.0, 15.0))

    def mean_distance(factor: SmoothedImage | SquaredExponential, degrees: float) -> float:
        a, b = (
            factor.coordinates(image(at) - image(at - 0.05 * velocity))
            for at in (angles, angles + np.deg2rad(degrees))
        )
        return float(np.linalg.norm(a - b, axis=1).mean())

    shares = {f: mean_distance(f, 30.0) / mean_distance(f, 180.0) for f in (RAW, SMOOTHED)}
    assert shares[RAW] > 0.95
    assert shares[SMOOTHED] < 0.5


# ---- the shape of images in a task ------------------------------------------------------------


def task_of_images(shape: Any = (2, 3), **changes: Any) -> TaskSpec:
    fields: dict[str, Any] = {
        "observation_size": 12,
        "action_low": np.array([-1.0]),
        "action_high": np.array([1.0]),
        "groups": (tuple(range(6)), tuple(range(6, 12))),
        "image_shape": shape,
    }
    return TaskSpec(**{**fields, **changes})


def test_an_image_shape_makes_smoothed_factors() -> None:
    task = task_of_images((np.int64(2), 3))
    assert task.image_shape == (2, 3)
    assert all(type(size) is int for size in task.image_shape)
    assert task.state_factors == tuple(SmoothedImage(group, (2, 3)) for group in task.groups)
    assert task.factor_count == len(task.state_factors) == 2
    raw = task_of_images(None)
    assert raw.state_factors == tuple(SquaredExponential(group) for group in task.groups)


@pytest.mark.parametrize(
    ("shape", "changes", "message"),
    [
        ((2, 2), {}, "each group must be an image of 2 x 2"),
        ((3, 4), {}, "each group must be an image of 3 x 4"),
        ((2, 3), {"groups": ()}, "each coordinate must be in a group"),
        ((2, 3), {"groups": (tuple(range(6)),)}, "each coordinate must be in a group"),
        ((2, 3), {"groups": (tuple(range(6)), tuple(range(6, 11)))}, "each group must be an image"),
        ((2, 3), {"observation_size": 13}, "each coordinate must be in a group"),
        ((2.5, 3), {}, "whole number"),
        ((2, 3, 1), {}, "whole number"),
        (6, {}, "whole number"),
        ("ab", {}, "whole number"),
    ],
)
def test_a_shape_that_does_not_fit_is_an_error(
    shape: Any, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message):
        task_of_images(shape, **changes)


def rollouts_of_images(count: int, rng: np.random.Generator) -> list[Rollout]:
    """A bump that moves along a row of six pixels where the action pushes it, more or less."""
    rollouts = []
    for _ in range(count):
        actions = rng.uniform(-1.0, 1.0, size=(8, 1))
        steps = actions[:, 0] + 0.3 * rng.normal(size=8)
        positions = np.clip(np.concatenate([[2.5], 2.5 + np.cumsum(steps)]), 0.0, 5.0)
        pictures = np.exp(-((positions[:, None] - np.arange(6)) ** 2))
        observations = np.concatenate([pictures, np.diff(pictures, axis=0, prepend=0.0)], axis=1)
        rollouts.append(Rollout(observations, actions, -((positions[:-1] - 2.5) ** 2)))
    return rollouts


@pytest.fixture(scope="module")
def learnt() -> kreps.KREPS:
    learner = kreps.KREPS(task_of_images((1, 6)), seed=1)
    learner.update(rollouts_of_images(8, np.random.default_rng(4)))
    return learner


def test_the_shape_is_restored_from_a_policy_file(learnt: kreps.KREPS, tmp_path: Path) -> None:
    learnt.policy.save(tmp_path / "policy")
    again = kreps.load_policy(tmp_path / "policy").process
    assert again.task.image_shape == (1, 6)
    assert again.task.groups == learnt.task.groups
    seen = rollouts_of_images(1, np.random.default_rng(5))[0].observations
    assert learnt.state.policy is not None
    np.testing.assert_array_equal(again.greedy(seen), learnt.state.policy.greedy(seen))


def test_the_shape_is_restored_from_a_checkpoint(learnt: kreps.KREPS, tmp_path: Path) -> None:
    learnt.save(tmp_path / "one")
    again = kreps.KREPS.resume(tmp_path / "one")
    assert again.task.image_shape == (1, 6)
    assert again.settings == learnt.settings
    assert again.value_function.kernel.factors == learnt.task.state_factors
    new = rollouts_of_images(3, np.random.default_rng(6))
    for learner in (going_on := kreps.KREPS.resume(tmp_path / "one"), again):
        learner.update(new)
    going_on.save(tmp_path / "two")
    again.save(tmp_path / "three")
    assert (tmp_path / "two").read_bytes() == (tmp_path / "three").read_bytes()


def test_a_missing_shape_is_restored_as_none(tmp_path: Path) -> None:
    learner = kreps.KREPS(task_of_images(None), seed=1)
    learner.save(tmp_path / "empty")
    assert kreps.KREPS.resume(tmp_path / "empty").task.image_shape is None


def test_a_forged_shape_is_an_error_when_it_is_read(learnt: kreps.KREPS, tmp_path: Path) -> None:
    learnt.policy.save(tmp_path / "good")
    content = (tmp_path / "good").read_bytes()
    for shape in (b"[1, 9]", b"[-1,6]"):
        forged = content.replace(rb"\"image_shape\": [1, 6]", rb"\"image_shape\": " + shape)
        assert forged != content
        (digits,) = re.findall(rb"[0-9a-f]{64}", content)
        (tmp_path / "bad").write_bytes(sealed(forged.replace(digits, b"0" * 64)))
        with pytest.raises(StorageError, match="image_shape"):
            kreps.load_policy(tmp_path / "bad")


@pytest.mark.parametrize("shape", [(-1, -6), (1, 2000), (6,), "ab", (0, 6), (1.0, 6)])
def test_impossible_shapes_are_named_in_the_error(shape: Any) -> None:
    with pytest.raises(ConfigurationError, match="image_shape"):
        TaskSpec(6, np.zeros(1), np.ones(1), groups=(range(6),), image_shape=shape)


def test_the_shape_is_taken_from_the_environment() -> None:
    learner = kreps.KREPS(gym.make("kreps/ImageSwingUp-v0"))
    assert learner.task.image_shape == (PIXELS, PIXELS)
    groups = learner.task.groups
    assert learner.task.state_factors == tuple(SmoothedImage(g, (PIXELS, PIXELS)) for g in groups)
    assert kreps.KREPS(gym.make("kreps/SwingUp-v0")).task.image_shape is None


# ---- the origin of the embedding --------------------------------------------------------------

TASK = TaskSpec(2, np.array([-1.0]), np.array([1.0]))


def random_walks(rng: np.random.Generator, far: float = 0.0) -> list[Rollout]:
    """Three rollouts; the last one starts ``far`` away from the others."""
    rollouts = []
    for shift in (0.0, 0.0, far):
        actions = rng.uniform(-1.0, 1.0, size=(10, 1))
        steps = np.concatenate([actions, 0.3 * rng.normal(size=(10, 1))], axis=1)
        observations = shift + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        rollouts.append(Rollout(observations, actions, -np.abs(observations[:-1, 0])))
    return rollouts


def embedding_of(data: Transitions, regulariser: float) -> KernelEmbedding:
    inputs = np.concatenate([data.states, TASK.scaled_applied(data.actions)], axis=1)
    return KernelEmbedding.fit(Kernel(factors_of(3), np.ones(3)), inputs, regulariser)


def expected(
    data: Transitions, features: FloatArray, model: KernelEmbedding, name: Any
) -> FloatArray:
    """Expected features of the successors, with the given hyper-parameters."""
    origin = embedding_origin(features[data.state], name)
    return origin + model.expected_features(successor_features(data, features) - origin)


@pytest.fixture
def data() -> Transitions:
    return Transitions.from_rollouts(random_walks(np.random.default_rng(7)))


@pytest.fixture
def features(data: Transitions) -> FloatArray:
    kernel = state_kernel(data, TASK, np.random.default_rng(8))
    return RKHSBasis.fit(kernel, data.points, tolerance=1e-6, max_rank=400)[1]


def test_the_change_is_relative_to_the_state_and_the_embedding_to_zero(
    data: Transitions, features: FloatArray
) -> None:
    own = features[data.state]
    assert kreps.KREPS(TASK, preset="single_step").settings.model == "change"
    np.testing.assert_array_equal(embedding_origin(own, "change"), own)
    assert kreps.KREPS(TASK, preset="paper").settings.model == "embedding"
    np.testing.assert_array_equal(embedding_origin(own, "embedding"), np.zeros_like(own))


@pytest.mark.parametrize("low_rank", [None, kreps.LowRank(above=0)], ids=["exact", "low rank"])
@pytest.mark.parametrize("name", ["change", "embedding"])
def test_an_update_predicts_as_the_embedding_with_its_hyperparameters(
    data: Transitions, name: Any, low_rank: kreps.LowRank | None
) -> None:
    settings = settings_of("single_step", model=name, low_rank=low_rank)
    state, rng = LearnerState(ReplayWindow(TASK, None)), np.random.default_rng(8)
    batch = batch_of(state, random_walks(np.random.default_rng(7)), settings, rng, Compute())
    kernel = state_kernel(batch.data, TASK, rng)
    found = batch.value_features(kernel)
    model = batch.transition_model(found, kernel, None, rng)
    features = found.basis.features(data.points)
    assert model.parameters is not None
    inputs = np.concatenate([data.states, TASK.scaled_applied(data.actions)], axis=1)
    lengthscales, regulariser = np.exp(model.parameters[:-1]), np.exp(model.parameters[-1])
    whole = Kernel(factors_of(3), lengthscales)
    embedding = KernelEmbedding.fit(whole, inputs, float(regulariser))
    wanted = expected(data, features, embedding, name)
    np.testing.assert_allclose(model.expected, wanted, atol=1e-3)


def test_where_the_features_of_states_are_zero_the_change_is_eq_4(
    data: Transitions, features: FloatArray
) -> None:
    # only the last points of rollouts, which are no states, have features here
    only_last = np.zeros_like(features)
    last = np.setdiff1d(data.successor, data.state)
    only_last[last] = features[last]
    model = embedding_of(data, 0.1)
    found = expected(data, only_last, model, "change")
    np.testing.assert_array_equal(found, expected(data, only_last, model, "embedding"))
    # and that is Eq. 4 as printed
    wanted = model.strengths(model.inputs).T @ only_last[data.successor]
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    assert np.abs(found).max() > 0.01


def test_the_change_is_the_sum_of_the_documentation(
    data: Transitions, features: FloatArray
) -> None:
    model = embedding_of(data, 0.1)
    own, after = features[data.state], features[data.successor]
    wanted = own + model.strengths(model.inputs).T @ (after - own)
    found = expected(data, features, model, "change")
    np.testing.assert_allclose(found, wanted, atol=1e-9)
    assert np.abs(found - expected(data, features, model, "embedding")).max() > 0.01


@pytest.mark.parametrize("name", ["change", "embedding"])
def test_without_regularisation_it_is_the_sample_model(
    data: Transitions, features: FloatArray, name: str
) -> None:
    observed = successor_features(data, features)
    off = [
        np.abs(expected(data, features, embedding_of(data, regulariser), name) - observed).max()
        for regulariser in (1e-1, 1e-4, 1e-10)
    ]
    assert off[0] > off[1] > off[2]
    assert off[2] < 1e-5


def test_far_from_the_data_the_predicted_change_is_zero(
    data: Transitions, features: FloatArray
) -> None:
    model = embedding_of(data, 0.1)
    strengths = model.strengths(np.array([[50.0, 50.0, 0.0]]))[:, 0]
    changes = features[data.successor] - features[data.state]
    np.testing.assert_array_equal(strengths, 0.0)
    own = features[0]
    np.testing.assert_array_equal(own + strengths @ changes, own)


def test_an_isolated_sample_keeps_a_share_of_its_change() -> None:
    data = Transitions.from_rollouts(random_walks(np.random.default_rng(9), far=50.0))
    steps = len(data) // 3
    kept = 2 * steps + 1
    alone = replace(
        data,
        **{
            name: getattr(data, name)[:kept]
            for name in ("state", "successor", "rollout", "actions", "rewards", "terminated")
        },
    )
    features = np.random.default_rng(10).normal(size=(len(data.points), 4))
    own, after = features[alone.state[-1]], features[alone.successor[-1]]
    for regulariser in (0.01, 1.0, 100.0):
        model = embedding_of(alone, regulariser)
        share = 1.0 / (1.0 + regulariser)
        change = expected(alone, features, model, "change")[-1]
        np.testing.assert_allclose(change, own + share * (after - own), atol=1e-9)
        printed = expected(alone, features, model, "embedding")[-1]
        np.testing.assert_allclose(printed, share * after, atol=1e-9)


def test_after_a_termination_the_change_leads_to_the_start_states(
    data: Transitions, features: FloatArray
) -> None:
    ended = replace(data, terminated=np.arange(len(data)) % 10 == 9)
    found = expected(ended, features, embedding_of(ended, 1e-10), "change")
    starts = np.broadcast_to(features[data.start].mean(axis=0), (3, features.shape[1]))
    np.testing.assert_allclose(found[ended.terminated], starts, atol=1e-5)


def test_both_models_learn_and_differ() -> None:
    rollouts = rollouts_of_images(8, np.random.default_rng(11))
    values = []
    for name in ("change", "embedding"):
        learner = kreps.KREPS(task_of_images((1, 6)), seed=2, model=name)
        info = learner.update(rollouts)
        assert info.dual.converged
        values.append(learner.value_function(rollouts[0].observations))
    assert np.abs(values[0] - values[1]).max() > 1e-3
