"""Files, settings and names of version 0.1: they load, act and continue as before, or are refused.

``tests/data/v0.1`` has files that version 0.1 wrote, and the actions that it took.
"""

from __future__ import annotations

import itertools
import json
import shutil
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import safetensors.numpy

import kreps
from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError, StorageError
from kreps.learning.learner import Learner
from kreps.learning.methods import LEARNERS
from kreps.legacy import (
    checkpoint_settings,
    present_columns,
    present_name,
    present_preset,
    present_settings,
)
from kreps.presets import changed, flat, settings_of
from kreps.settings import RKHS, Exploration, Grid, LowRank, ModelBased, Settings

FOLDER = Path(__file__).parent / "data" / "v0.1"
EXPECTED = json.loads((FOLDER / "expected.json").read_text())
STATES, NOISE = np.array(EXPECTED["states"]), np.array(EXPECTED["noise"])
CHECKPOINTS = [*EXPECTED["checkpoints"]]
POLICIES = [*EXPECTED["policies"]]
REPLACED = {"fourier", "uniform"}
IMPROVED = {"default", "low_rank"}
"""Checkpoints with a model-based step, which draws other random numbers now."""
"""Approximations that are replaced by pivoted Cholesky: the next update is another one."""


def resume(name: str, path: Path | None = None, env: gym.Env[Any, Any] | None = None) -> Any:
    method = name if name in LEARNERS else "reps"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if name == "fourier" else "error", UserWarning)
        warnings.filterwarnings("ignore", "(?s).*has no checksum")
        return LEARNERS[method].resume(path or FOLDER / f"checkpoint_{name}.safetensors", env)


def assert_acts(process: Any, expected: dict[str, Any], atol: float = 1e-9) -> None:
    """The range of the actions is 60."""
    greedy, act = process.greedy(STATES)[:, 0], process.act(STATES, NOISE)[:, 0]
    np.testing.assert_allclose(greedy, expected["greedy"], rtol=0, atol=atol)
    np.testing.assert_allclose(act, expected["act"], rtol=0, atol=atol)


# ---- files that load --------------------------------------------------------------------------


def test_the_files_are_those_of_the_old_formats() -> None:
    versions = {header_of(path)["version"] for path in FOLDER.rglob("*.safetensors")}
    assert versions == {1, 2}


@pytest.mark.parametrize("kind", POLICIES)
def test_an_old_policy_acts_as_before(kind: str, tmp_path: Path) -> None:
    policy = kreps.load_policy(FOLDER / f"policy_{kind}.safetensors")
    assert_acts(policy.process, EXPECTED["policies"][kind])
    policy.save(tmp_path / "new")
    assert header_of(tmp_path / "new")["version"] == 4
    assert_acts(kreps.load_policy(tmp_path / "new").process, EXPECTED["policies"][kind])


def test_the_actions_of_an_old_policy_are_literally_these() -> None:
    policy = kreps.load_policy(FOLDER / "policy_softmax.safetensors")
    actions, _ = policy.predict(STATES, deterministic=True)
    assert actions[:, 0].tolist() == [-30.0, -30.0, -30.0]
    policy = kreps.load_policy(FOLDER / "policy_cost-sensitive-gp.safetensors")
    actions, _ = policy.predict(STATES, deterministic=True)
    np.testing.assert_allclose(actions[:, 0], [0.0, -4.259557306, -0.004400634], atol=1e-8)


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_an_old_checkpoint_acts_as_before(name: str, tmp_path: Path) -> None:
    learner, expected = resume(name), EXPECTED["checkpoints"][name]
    assert (learner.seed, learner.state.iteration) == (4, 1)
    assert learner.task.periodic == (0,)
    assert_acts(learner.policy.process, expected)
    if "value" in expected and name != "fourier":
        np.testing.assert_allclose(learner.state.value(STATES), expected["value"], rtol=1e-9)
    learner.save(tmp_path / "new")
    again = resume(name, tmp_path / "new")
    assert again.settings == learner.settings
    assert_acts(again.policy.process, expected)
    again.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "new").read_bytes()


@pytest.mark.parametrize("converted", [False, True])
@pytest.mark.parametrize("name", CHECKPOINTS)
def test_an_old_checkpoint_continues_as_before(name: str, converted: bool, tmp_path: Path) -> None:
    env = gym.make("kreps/SwingUp-v0")
    learner = resume(name, env=env)
    if converted:  # to the present format in between
        learner.save(tmp_path / "new")
        learner = resume(name, tmp_path / "new", env)
    learner.learn(1, progress=False)
    assert learner.state.iteration == 2
    if name not in REPLACED | IMPROVED:
        after = EXPECTED["checkpoints"][name]["after one more update"]
        assert_acts(learner.policy.process, after, atol=1e-3)


def test_settings_of_old_checkpoints_are_these() -> None:
    single_step = settings_of(
        "single_step",
        restart_probability=0.12,
        initial_rollouts=5,
        rollouts_per_iteration=3,
        window=5,
    )
    assert resume("observed").settings == single_step
    assert resume("grid").settings == changed(single_step, {"value": Grid(size=4)})
    assert resume("uniform").settings == changed(
        single_step, {"low_rank": LowRank(15, 0), "value.max_rank": 16}
    )
    exact = {"model": "sample", "low_rank": None, "exploration": Exploration("pink", 0.7)}
    assert resume("exact").settings == changed(single_step, exact)
    fourier = resume("fourier").settings
    assert fourier.low_rank == LowRank(rank=15, above=0)
    assert fourier.value == RKHS(max_rank=16)
    assert fourier.model_based == ModelBased(
        actions_per_state=1, improvement_steps=0, random_policies=0, regulators=0, gradient_steps=0
    )
    assert resume("default").settings.model_based == ModelBased(
        actions_per_state=2,
        acceptance_rollouts=10,
        improvement_steps=0,
        random_policies=0,
        regulators=0,
        gradient_steps=0,
    )
    assert resume("value-iteration").settings.actions == 5
    assert resume("grid-value-iteration").settings.ranges == ((-3.0, 3.0), (-8.0, 8.0))


def test_a_v_in_fourier_features_is_left_out_with_a_warning(tmp_path: Path) -> None:
    path = FOLDER / "checkpoint_fourier.safetensors"
    with pytest.warns(UserWarning, match="Fourier features.*next update estimates V anew"):
        learner = kreps.KREPS.resume(path, gym.make("kreps/SwingUp-v0"))
    with pytest.raises(ConfigurationError, match="no V"):
        _ = learner.value_function
    learner.learn(1, progress=False)
    assert np.isfinite(learner.value_function(STATES)).all()


def test_files_of_the_first_format_load_with_the_settings_of_then(tmp_path: Path) -> None:
    policy = kreps.load_policy(FOLDER / "policy_format_1.safetensors")
    actions = policy.predict(STATES, deterministic=True)[0][:, 0]
    expected = [8.262534537838326e-06, -14.643726679424729, -3.9008425816716774]
    np.testing.assert_allclose(actions, expected, rtol=1e-9)
    env = gym.make("kreps/SwingUp-v0")
    learner = kreps.KREPS.resume(FOLDER / "checkpoint_format_1.safetensors", env)
    np.testing.assert_allclose(
        learner.value_function(STATES), [3.0730654913674, -6.8679916308781, 26.062613737282]
    )
    settings = learner.settings
    assert settings.model_based is None and settings.exploring_starts == 0.0
    assert settings.rollout_lengths == "independent"
    assert settings.value == RKHS(angle_wrap="continuous")
    learner.learn(1, progress=False)
    assert learner.state.iteration == 2


def test_old_rollouts_load(tmp_path: Path) -> None:
    rollouts = kreps.load_rollouts(FOLDER / "rollouts.safetensors")
    assert [len(r) for r in rollouts] == EXPECTED["lengths"] == [3, 6, 1, 16, 12]
    np.testing.assert_allclose([r.rewards.sum() for r in rollouts], EXPECTED["rewards"])
    ended = kreps.load_rollouts(FOLDER / "rollouts_terminated.safetensors")
    assert [r.terminated for r in ended] == [True, False, True]
    shutil.copy(FOLDER / "rollouts.safetensors", tmp_path)
    kreps.save_rollouts(rollouts, tmp_path / "new.safetensors")
    assert len(kreps.rollout_folder(tmp_path)) == 2 * 38


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_the_window_of_an_old_checkpoint_counts_rollouts_only(name: str) -> None:
    learner = resume(name)
    assert learner.settings.window_steps == learner.state.window.min_steps == 0


def test_an_old_run_continues_as_before(tmp_path: Path) -> None:
    path = FOLDER / "run" / "checkpoint.safetensors"
    learner = kreps.KREPS.resume(path, gym.make("kreps/SwingUp-v0"))
    assert_acts(learner.policy.process, EXPECTED["run"])
    assert_acts(kreps.load_policy(FOLDER / "run" / "policy.safetensors").process, EXPECTED["run"])
    learner.learn(1, progress=False)
    assert learner.state.iteration == 3
    assert np.isfinite(learner.policy.process.greedy(STATES)).all()


def test_the_config_of_an_old_run_is_the_settings_of_its_checkpoint() -> None:
    config = json.loads((FOLDER / "run" / "config.json").read_text())
    changes = present_settings(config["settings"], config["recipe"])
    settings = settings_of(present_preset(config["recipe"]), **changes)
    assert settings == kreps.KREPS.resume(FOLDER / "run" / "checkpoint.safetensors").settings
    columns = (FOLDER / "run" / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"rejected", "cpu_seconds_acceptance_test"} <= set(present_columns(columns))
    assert present_columns(present_columns(columns)) == present_columns(columns)


def test_an_old_run_folder_is_read() -> None:
    folder = RunFolder(FOLDER / "run")
    config = folder.config()
    assert (config.environment, config.seed, config.preset) == (
        "kreps/SwingUp-v0",
        3,
        "single_step",
    )
    # without effect in version 0.1, as it made no model-based step and had no grid
    assert not {"model_based.acceptance_rollouts", "value.size"} & config.settings.keys()
    learner = kreps.KREPS.resume(folder.checkpoint_file)
    assert settings_of(config.preset, **config.settings) == learner.settings
    assert [int(row["iteration"]) for row in folder.rows()] == [1, 2]
    assert [row["rejected"] for row in folder.rows()] == ["nan", "nan"]


# ---- files that are refused -------------------------------------------------------------------


def header_of(path: Path) -> dict[str, Any]:
    content = path.read_bytes()
    (size,) = struct.unpack("<Q", content[:8])
    return json.loads(json.loads(content[8 : 8 + size])["__metadata__"]["kreps"])


FILES = [path.name for path in sorted(FOLDER.glob("*.safetensors"))]


def load(name: str, path: Path) -> Any:
    kind, _, rest = name.removesuffix(".safetensors").partition("_")
    if kind == "checkpoint":
        return resume(rest, path)
    return kreps.load_policy(path) if kind == "policy" else kreps.load_rollouts(path)


def refused(name: str, tensors: dict[str, Any], header: dict[str, Any], folder: Path) -> str:
    arrays = {n: np.array(values, order="C") for n, values in tensors.items()}
    path = folder / "forged"
    path.write_bytes(safetensors.numpy.save(arrays, metadata={"kreps": json.dumps(header)}))
    with pytest.raises(StorageError) as caught:
        load(name, path)
    assert str(path) in str(caught.value)
    return str(caught.value)


def good(name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    return safetensors.numpy.load((FOLDER / name).read_bytes()), header_of(FOLDER / name)


@pytest.mark.parametrize("name", FILES)
def test_every_array_of_an_old_file_is_needed_in_its_shape(name: str, tmp_path: Path) -> None:
    tensors, header = good(name)
    optional = {"start.embedding", "start.reward", "start.policy", "value.cuts"}
    for array, values in tensors.items():
        others = {n: v for n, v in tensors.items() if n != array}
        assert array in refused(name, others, header, tmp_path)
        if name == "checkpoint_fourier.safetensors" and array.startswith(("value.", "start.rew")):
            continue  # is not read
        if array not in optional:
            refused(name, others, {**header, "arrays": sorted(others)}, tmp_path)
        wide = np.concatenate([values, values], axis=-1)
        for wrong in (wide, values[:-1], values[None], values.ravel()[:0], np.zeros(())):
            free = name.startswith("rollouts") and wrong is wide and values.ndim == 2
            if wrong.shape != values.shape and not free:
                refused(name, {**others, array: wrong}, header, tmp_path)
        for dtype in (np.float32, np.int64, np.bool_):
            message = refused(name, {**others, array: values.astype(dtype)}, header, tmp_path)
            assert "not F64" in message
        for number in (np.nan, np.inf):
            spoilt = values.copy()
            spoilt.flat[-1] = number
            assert array in refused(name, {**others, array: spoilt}, header, tmp_path)


@pytest.mark.parametrize("name", FILES)
def test_headers_that_do_not_fit_an_old_file_are_refused(name: str, tmp_path: Path) -> None:
    tensors, header = good(name)
    kept = (
        {"kind", "version", "samples"} if header["version"] == 2 else {"kind", "version", "arrays"}
    )
    for field in header.keys() - kept:
        without = {n: v for n, v in header.items() if n != field}
        refused(name, tensors, without, tmp_path)
        for wrong in (None, 7.5, "x", [], {}):
            if (field, wrong) != ("settings", {}):  # are the defaults
                refused(name, tensors, {**header, field: wrong}, tmp_path)
    for wrong in (["x"], [None], [[]], ["policy.states", {}], sorted(tensors)[1:]):
        refused(name, tensors, {**header, "arrays": wrong}, tmp_path)
    message = refused(name, {**tensors, "x": np.zeros(1)}, header, tmp_path)
    assert "has no array 'x'" in message


def put(where: int, value: float) -> Callable[[Any], Any]:
    """A change of one number of a vector."""
    return lambda v: np.where(np.arange(len(v)) == where, value, v)


IMPOSSIBLE: dict[str, dict[str, Callable[[Any], Any]]] = {
    "lengthscales": {"policy.lengthscales": lambda v: -v},
    "lengthscales of V": {"value.lengthscales": put(0, 1e-101)},
    "weights": {"policy.weights": put(0, 0.0)},
    "signal": {"policy.signal_and_noise": put(0, 0.0)},
    "noise": {"policy.signal_and_noise": put(1, -1.0)},
    "temperature": {"policy.offset_and_temperature": put(1, -1.0)},
    "slope": {"policy.slope_and_noise": put(0, -1.0)},
    "noise fraction": {"policy.slope_and_noise": put(1, 1.5)},
    "noise scale": {"policy.slope_and_noise": put(2, -1.0)},
    **{
        f"length {length}": {
            "window.lengths": lambda v, length=length: np.array(
                [length, v[0] + v[1] - length, *v[2:]]
            )
        }
        for length in (0.0, -1.0, 0.5, 1e18, 1e99)
    },
}


@pytest.mark.parametrize("changes", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_impossible_numbers_of_old_files_are_refused(
    changes: dict[str, Callable[[Any], Any]], tmp_path: Path
) -> None:
    concerned = 0
    for name in FILES:
        tensors, header = good(name)
        if changes.keys() <= tensors.keys():
            if name == "checkpoint_fourier.safetensors" and "value.lengthscales" in changes:
                continue
            concerned += 1
            changed_arrays = {array: change(tensors[array]) for array, change in changes.items()}
            refused(name, {**tensors, **changed_arrays}, header, tmp_path)
    assert concerned


# ---- settings ---------------------------------------------------------------------------------

OLD_DEFAULTS: dict[str, Any] = {
    "restart_probability": 0.02,
    "window": 30,
    "exploration": "bang-bang",
    "exploration_scale": 1.0,
    "initial_rollouts": 30,
    "rollouts_per_iteration": 10,
    "restarts": "stratified",
    "kl_bound": 1.0,
    "eta_floor": None,
    "ridge": None,
    "exploring_starts": 0.25,
    "imagined": 4,
    "imagined_noise": 1.2,
    "imagined_rollouts": 0.5,
    "judging_rollouts": 50,
    "optimism": 0.1,
    "angles": "cut",
    "model": "dynamics",
    "features": "rkhs",
    "grid_size": 10,
    "policy_fit": "map",
    "max_rank": 400,
    "basis_tolerance": 1e-6,
    "approximation": "auto",
    "rank": 1000,
}
"""All settings of REPS in version 0.1.  Its windows had no smallest number of steps."""

OLD_OBSERVED = {
    **OLD_DEFAULTS,
    "restarts": "independent",
    "eta_floor": 0.1,
    "ridge": 0.1,
    "exploring_starts": 0.0,
    "imagined": 0,
    "angles": "round",
    "model": "change",
}
OLD_PAPER = {
    **OLD_OBSERVED,
    "kl_bound": 0.5,
    "eta_floor": 0.02,
    "model": "embedding",
    "policy_fit": "bounded",
}
OLD_RECIPES = {"default": OLD_DEFAULTS, "observed": OLD_OBSERVED, "paper": OLD_PAPER}

CHANGES: dict[str, list[Any]] = {
    "window": [None, 7],
    "kl_bound": [0.25],
    "restarts": ["independent", "stratified"],
    "exploration": ["bang-bang", "gaussian", "pink"],
    "exploration_scale": [0.5],
    "features": ["rkhs", "grid"],
    "grid_size": [4],
    "max_rank": [50],
    "basis_tolerance": [1e-3],
    "angles": ["cut", "round"],
    "approximation": ["auto", "exact", "pivoted", "uniform", "fourier"],
    "rank": [70],
    "imagined": [0, 2],
    "imagined_noise": [1.5],
    "imagined_rollouts": [0.0],
    "judging_rollouts": [0],
    "optimism": [0.0],
}


NO_SETTINGS_THEN: dict[str, Any] = {
    "window_steps": 0,
    "restart_probability": 0.02,
    "action_repeat": 1,
    "initial_rollouts": 30,
    "growth": 0.0,
}
"""What the presets of today leave to other rules than version 0.1."""


@pytest.mark.parametrize("recipe", OLD_RECIPES)
def test_a_whole_old_recipe_is_the_present_preset(recipe: str) -> None:
    base = Settings(window_steps=0, growth=0.0, action_repeat=1)
    whole = changed(base, present_settings(OLD_RECIPES[recipe]))
    assert whole == settings_of(present_preset(recipe), **NO_SETTINGS_THEN)


@pytest.mark.parametrize("recipe", OLD_RECIPES)
@pytest.mark.parametrize("names", [*itertools.combinations(CHANGES, 2)], ids="-".join)
def test_changes_of_an_old_recipe_are_changes_of_the_preset(
    names: tuple[str, str], recipe: str
) -> None:
    """As a checkpoint, with all settings, and as a run's config, with those that were changed."""
    for values in itertools.product(*(CHANGES[name] for name in names)):
        changes = dict(zip(names, values, strict=True))
        old = present_settings({**OLD_RECIPES[recipe], **changes})
        whole = changed(Settings(window_steps=0, growth=0.0, action_repeat=1), old)
        new = present_settings(changes, recipe)
        part = settings_of(present_preset(recipe), **NO_SETTINGS_THEN, **new)
        assert part == whole, changes
        assert settings_of(present_preset(recipe), **present_settings(flat(part), recipe)) == part


def test_old_settings_mean_this() -> None:
    def now(**given: Any) -> dict[str, Any]:
        return present_settings(given)

    assert now() == {}
    assert now(kl_bound=0.5, window=None) == {"kl_bound": 0.5, "window": None}
    assert now(restarts="independent") == {"rollout_lengths": "independent"}
    assert now(exploration="pink", exploration_scale=0.3) == {
        "exploration": "pink",
        "exploration.scale": 0.3,
    }
    assert now(features="grid", grid_size=4, max_rank=9, angles="cut") == {
        "value": "grid",
        "value.size": 4,
    }
    assert now(features="rkhs", grid_size=4, max_rank=9, angles="round") == {
        "value.max_rank": 9,
        "value.angle_wrap": "continuous",
    }
    assert now(angles="cut") == {"value.angle_wrap": "discontinuous"}
    assert now(basis_tolerance=1e-3) == {"value.tolerance": 1e-3}
    assert now(approximation="auto", rank=5) == {"low_rank.rank": 5}
    assert now(approximation="exact", rank=5) == {"low_rank": None}
    for kind in ("pivoted", "uniform", "fourier"):
        assert now(approximation=kind, rank=5) == {"low_rank.rank": 5, "low_rank.above": 0}
    assert now(imagined=0, judging_rollouts=5, optimism=0.2) == {"model_based": None}
    assert now(imagined=3, imagined_noise=2.0, imagined_rollouts=0.1) == {
        "model_based.actions_per_state": 3,
        "model_based.proposal_std_scale": 2.0,
        "model_based.model_rollout_fraction": 0.1,
    }
    assert now(judging_rollouts=5, optimism=0.2) == {
        "model_based.acceptance_rollouts": 5,
        "model_based.exploration_bonus": 0.2,
    }
    assert present_settings({"judging_rollouts": 5}, "observed") == {}
    assert present_settings({"judging_rollouts": 5}, "single_step") == {}


@pytest.mark.parametrize(
    "changes",
    [
        {"imagined": -1},
        {"imagined": "4"},
        {"features": "RKHS"},
        {"approximation": "nystroem"},
        {"angles": "square"},
        {"angles": ["cut"]},
        {"exploration": "brown"},
        {"restarts": None},
        {"colour": "red"},
    ],
)
def test_what_was_no_setting_is_none_now(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigurationError):
        settings_of("model_based", **present_settings(changes))


def test_the_first_checkpoints_keep_the_meaning_that_they_had() -> None:
    first = {
        name: value
        for name, value in OLD_OBSERVED.items()
        if name
        not in {
            "imagined",
            "exploring_starts",
            "imagined_noise",
            "imagined_rollouts",
            "judging_rollouts",
            "restarts",
            "optimism",
            "angles",
        }
    }
    assert changed(Settings(), checkpoint_settings(first, "reps")) == settings_of("single_step")
    with_model = changed(Settings(), checkpoint_settings({**first, "imagined": 4}, "reps"))
    assert with_model.model_based == ModelBased(
        actions_per_state=4,
        proposal_std_scale=1.0,
        model_rollout_fraction=0.0,
        acceptance_rollouts=0,
        exploration_bonus=0.0,
        improvement_steps=0,
        random_policies=0,
        regulators=0,
        gradient_steps=0,
    )
    assert with_model.window_steps == 0  # their windows count rollouts only
    assert checkpoint_settings({"restarts": "stratified"}, "npalp") == {
        "rollout_lengths": "stratified"
    }


def test_old_names_of_presets_and_settings() -> None:
    assert [present_preset(name) for name in ("default", "observed", "paper", "x")] == [
        "model_based",
        "single_step",
        "paper",
        "x",
    ]
    assert present_name("judging_rollouts") == "model_based.acceptance_rollouts"
    assert present_name("recipe") == "preset"
    assert present_name("kl_bound") is None


def test_every_learner_refuses_old_keywords() -> None:
    task = kreps.TaskSpec(2, [-1.0], [1.0])
    learners: list[type[Learner[Any]]] = [LEARNERS["value-iteration"], LEARNERS["npalp"]]
    for learner in learners:
        with pytest.raises(ConfigurationError, match="rollout_lengths='stratified'"):
            learner(task, restarts="stratified")
