"""ONNX models, evaluated by ONNX Runtime, against the policies that they were made from."""

from __future__ import annotations

import builtins
import json
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.learning.storage import onnx as export
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP
from kreps.policies.value_based import LipschitzPolicy

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

TOLERANCES = {"float64": 1e-6, "float32": 1e-4}
"""Of mean and deviation, in units of the action scale."""


def tasks() -> dict[str, TaskSpec]:
    low, high = [-30.0], [30.0]
    two = [-1.0, 10.0], [1.0, 30.0]
    pixels = 6 * 9
    images = (tuple(range(pixels, 2 * pixels)), tuple(range(pixels)))
    return {
        "swing-up": TaskSpec(2, low, high, (0,)),
        "joints": TaskSpec(5, *two, (1, 3), ((0, 2), (1, 3))),
        "plain": TaskSpec(4, *two),
        "image": TaskSpec(pixels, low, high, (), (tuple(range(pixels)),), (6, 9)),
        "two images": TaskSpec(2 * pixels, *two, (), images, (6, 9)),
    }


TASKS = tasks()


def states_of(task: TaskSpec, n: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return (
        rng.random((n, task.observation_size))
        if task.image_shape
        else rng.normal(size=(n, task.observation_size))
    )


def random_policy(task: TaskSpec, n: int = 150, noise: float = 0.2) -> kreps.Policy:
    rng, states = np.random.default_rng(1), states_of(task, n, 0)
    lengthscales = rng.uniform(0.7, 1.4, len(task.state_factors))
    if task.image_shape:
        lengthscales *= 4.0  # of smoothed random pixels
    return kreps.Policy(
        CostSensitiveGP(
            task,
            Kernel(task.state_factors, lengthscales),
            states,
            rng.normal(size=(n, task.action_size)),
            rng.uniform(0.1, 4.0, n),
            0.7,
            noise,
        )
    )


@pytest.fixture(scope="module")
def learnt() -> dict[int, kreps.Policy]:
    """Policies of the swing-up by seed, learnt with the presets single_step and model_based."""
    env = gym.make("kreps/SwingUp-v0")
    few = {"model_based.improvement_steps": 2, "model_based.acceptance_rollouts": 10}
    single_step = kreps.KREPS(env, seed=100, preset="single_step").learn(8, progress=False)
    model_based = kreps.KREPS(env, seed=101, **few).learn(3, progress=False)
    return {100: single_step.policy, 101: model_based.policy}


def session(path: Path) -> Any:
    onnx.checker.check_model(str(path), full_check=True)
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def note(path: Path) -> dict[str, Any]:
    model = onnx.load(str(path))
    found = {entry.key: entry.value for entry in model.metadata_props}
    assert set(found) == {"kreps", "sha256"}
    return json.loads(found["kreps"])


def errors(policy: kreps.Policy, path: Path, states: FloatArray, dtype: str) -> tuple[float, float]:
    """Largest errors of action and deviation in units of the action scale."""
    policy.export_onnx(path, dtype)
    return errors_of_model(policy, path, states, dtype)


def errors_of_model(
    policy: kreps.Policy, path: Path, states: FloatArray, dtype: str
) -> tuple[float, float]:
    given = states.astype(dtype)
    action, deviation = session(path).run(None, {"observation": given})
    assert action.dtype == deviation.dtype == dtype
    process, task = policy.process, policy.process.task
    assert isinstance(process, CostSensitiveGP | SparseGP)
    at = given.astype(np.float64)
    wanted, _ = policy.predict(at, deterministic=True)
    return (
        float(np.abs((action - wanted) / task.action_scale).max()),
        float(np.abs((deviation - process.standard_deviation(at)) / task.action_scale).max()),
    )


# ---- what a model computes --------------------------------------------------------------------


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("centres", [None, 20])
@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_a_model_computes_what_the_policy_computes(
    task: TaskSpec, centres: int | None, dtype: str, tmp_path: Path
) -> None:
    policy = random_policy(task)
    if centres is not None:
        policy = policy.compressed(centres)
    own = policy.process
    assert isinstance(own, CostSensitiveGP | SparseGP)
    far = 50.0 + states_of(task, 5, 2)
    at = np.concatenate([states_of(task, 300, 3), own.states, far])
    spread = own.standard_deviation(at)
    assert spread.max() > 1.2 * spread.min()  # some states are close to samples, others are not
    assert np.ptp(policy.predict(at, deterministic=True)[0], axis=0).min() > 0.1
    assert max(errors(policy, tmp_path / "policy.onnx", at, dtype)) < TOLERANCES[dtype]


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("centres", [None, 50])
@pytest.mark.parametrize("seed", [100, 101])
def test_a_model_of_a_learnt_policy_computes_what_the_policy_computes(
    seed: int, centres: int | None, dtype: str, learnt: dict[int, kreps.Policy], tmp_path: Path
) -> None:
    rng, policy = np.random.default_rng(4), learnt[seed]
    at = np.stack([rng.uniform(-np.pi, 2 * np.pi, 2000), rng.uniform(-15.0, 15.0, 2000)], axis=1)
    assert isinstance(policy.process, CostSensitiveGP | SparseGP)
    at = np.concatenate([at, policy.process.states])
    if centres is not None:
        policy = policy.compressed(centres)
    assert max(errors(policy, tmp_path / "policy.onnx", at, dtype)) < TOLERANCES[dtype]


def test_compressed_policies_are_computed_in_single_precision(
    learnt: dict[int, kreps.Policy], tmp_path: Path
) -> None:
    path = tmp_path / "policy.onnx"
    # a smoother policy needs larger weights, and so fewer centres
    for seed, centres in ((100, 50), (101, 10)):
        assert learnt[seed].compressed(centres).export_onnx(path, "float32") == "float32"
        assert note(path)["arithmetic"] == "float32"
        assert {t.data_type for t in onnx.load(str(path)).graph.initializer} == {
            onnx.TensorProto.FLOAT,
            onnx.TensorProto.INT64,
        }


def test_weights_beyond_single_precision_are_computed_in_double(tmp_path: Path) -> None:
    """With little noise, weights are huge and of alternating sign."""
    policy, at = random_policy(TASKS["plain"], 300, 1e-4), states_of(TASKS["plain"], 300, 5)
    assert isinstance(policy.process, CostSensitiveGP | SparseGP)
    bound = export.single_precision_error(policy.process.predictor)
    assert bound > 1e-4
    assert policy.export_onnx(tmp_path / "x.onnx", "float32") == "float64"
    assert note(tmp_path / "x.onnx")["arithmetic"] == "float64"
    assert max(errors(policy, tmp_path / "x.onnx", at, "float32")) < 1e-6


def test_the_error_of_single_precision_is_near_its_bound(
    learnt: dict[int, kreps.Policy], tmp_path: Path
) -> None:
    """Also where it is not used, its error is below the bound, by less than three decades."""
    policies = [
        *learnt.values(),
        *(random_policy(TASKS["plain"], 300, noise) for noise in (0.2, 1e-2, 1e-4)),
    ]
    shares = []
    for policy in policies:
        assert isinstance(policy.process, CostSensitiveGP | SparseGP)
        at = np.concatenate([policy.process.states, states_of(policy.process.task, 1000, 6)])
        wide = TaskSpec(  # so that no clipping hides an error
            policy.process.task.observation_size,
            policy.process.task.action_centre - 1e4,
            policy.process.task.action_centre + 1e4,
            policy.process.task.periodic,
        )
        predictor = policy.process
        if isinstance(predictor, CostSensitiveGP):
            predictor = predictor.predictor
        unclipped = SparseGP(
            wide,
            predictor.kernel,
            predictor.states,
            predictor.mean_weights,
            predictor.explained,
            predictor.signal,
            predictor.noise,
        )
        path = tmp_path / "x.onnx"
        assert export.write_onnx(unclipped, path, "float32", tolerance=np.inf) == "float32"
        found, _ = errors_of_model(kreps.Policy(unclipped), path, at, "float32")
        shares.append(found / export.single_precision_error(predictor))
    assert max(shares) < 1.0
    assert min(shares) > 1e-3


def test_coordinates_far_from_zero_keep_their_digits_in_single_precision(tmp_path: Path) -> None:
    """A position of 10 km in m: the kernel depends on distances from the centres only."""
    task = TaskSpec(2, [-1.0], [1.0])
    rng = np.random.default_rng(7)
    base = 1e4 + np.round(rng.normal(size=(400, 2)) * 256.0) / 256.0  # exact in single precision
    process = CostSensitiveGP(
        task,
        Kernel(task.state_factors, np.ones(2)),
        base[:100],
        rng.normal(size=(100, 1)),
        np.ones(100),
        0.7,
        0.3,
    )
    assert max(errors(kreps.Policy(process), tmp_path / "x.onnx", base, "float32")) < 1e-4


def test_actions_are_clipped_and_never_beyond_the_limits_of_the_task(tmp_path: Path) -> None:
    low, high = np.array([-0.1, 0.1]), np.array([0.7, 0.3])  # none has a float32 of its own
    task = TaskSpec(1, low, high)
    states = np.linspace(-2.0, 2.0, 40)[:, None]
    process = CostSensitiveGP(
        task,
        Kernel(task.state_factors, np.ones(1)),
        states,
        3.0 * np.sign(states) * [1.0, -1.0],
        np.full(40, 100.0),
        1.0,
        0.1,
    )
    assert (np.abs(task.scaled(process.greedy(states))) > 2.0).any()
    for dtype in TOLERANCES:
        policy = kreps.Policy(process)
        assert errors(policy, tmp_path / "x.onnx", states, dtype)[0] < TOLERANCES[dtype]
        (action, _) = session(tmp_path / "x.onnx").run(None, {"observation": states.astype(dtype)})
        action = action.astype(np.float64)
        assert (action >= low).all() and (action <= high).all()
        np.testing.assert_allclose(action.min(axis=0), low, atol=1e-7)
        np.testing.assert_allclose(action.max(axis=0), high, atol=1e-7)


@pytest.mark.parametrize("dtype", TOLERANCES)
def test_rows_of_a_batch_do_not_depend_on_each_other(dtype: str, tmp_path: Path) -> None:
    policy = random_policy(TASKS["two images"])
    policy.export_onnx(tmp_path / "x.onnx", dtype)
    model, at = session(tmp_path / "x.onnx"), states_of(TASKS["two images"], 7, 8).astype(dtype)
    together = model.run(None, {"observation": at})
    for i in range(7):
        alone = model.run(None, {"observation": at[i : i + 1]})
        for a, b in zip(alone, together, strict=True):
            np.testing.assert_allclose(a[0], b[i], rtol=1e-5 if dtype == "float32" else 1e-12)


@pytest.mark.parametrize("dtype", TOLERANCES)
def test_a_batch_may_be_empty(dtype: str, tmp_path: Path) -> None:
    random_policy(TASKS["joints"]).export_onnx(tmp_path / "x.onnx", dtype)
    given = np.zeros((0, 5), dtype)
    for found in session(tmp_path / "x.onnx").run(None, {"observation": given}):
        assert found.shape == (0, 2)


@pytest.mark.parametrize("optimised", [True, False])
@pytest.mark.parametrize("dtype", TOLERANCES)
def test_observations_that_are_not_finite_are_an_error_of_the_model(
    dtype: str, optimised: bool, tmp_path: Path
) -> None:
    random_policy(TASKS["swing-up"]).export_onnx(tmp_path / "x.onnx", dtype)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    if not optimised:
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    model = onnxruntime.InferenceSession(str(tmp_path / "x.onnx"), options)
    good = [0.5, -1.0]
    for number in (np.nan, np.inf, -np.inf):
        for bad in ([number, 0.0], [0.0, number]):
            given = np.array([good, bad], dtype)
            with pytest.raises(Exception, match="observation_or_action_is_not_finite"):
                model.run(None, {"observation": given})
    for found in model.run(None, {"observation": np.array([good], dtype)}):
        assert np.isfinite(found).all()


def test_actions_that_are_not_finite_are_an_error_of_the_model(tmp_path: Path) -> None:
    task = TASKS["plain"]
    own = random_policy(task).compressed(5).process
    assert isinstance(own, SparseGP)
    huge = np.full((5, 2), [1e38, 0.0])  # the largest number of single precision is 3.4e38
    alike = Kernel(task.state_factors, np.full(4, 1e3))
    policy = SparseGP(task, alike, own.states, huge, own.explained, own.signal, own.noise)
    assert export.write_onnx(policy, tmp_path / "x.onnx", "float32", tolerance=np.inf) == "float32"
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    model = onnxruntime.InferenceSession(str(tmp_path / "x.onnx"), options)
    with pytest.raises(Exception, match="observation_or_action_is_not_finite"):
        model.run(None, {"observation": own.states.astype(np.float32)})


def test_the_error_is_that_of_the_standard_too(tmp_path: Path) -> None:
    """Gather with an index out of bounds is an error by ONNX's specification."""
    reference = pytest.importorskip("onnx.reference")
    random_policy(TASKS["swing-up"]).export_onnx(tmp_path / "x.onnx")
    model = reference.ReferenceEvaluator(str(tmp_path / "x.onnx"))
    with pytest.raises(IndexError):
        model.run(None, {"observation": np.array([[np.nan, 0.0]])})


def test_a_damaged_copy_of_a_model_is_found(tmp_path: Path) -> None:
    path = tmp_path / "x.onnx"
    random_policy(TASKS["swing-up"]).export_onnx(path)
    kreps.check_file(path)
    content = path.read_bytes()
    for place in np.linspace(0, len(content) - 1, 200).astype(int).tolist():
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(StorageError, match="cannot rely on"):
            kreps.check_file(path)


# ---- metadata ---------------------------------------------------------------------------------


def test_names_and_shapes_are_those_of_the_documentation(tmp_path: Path) -> None:
    random_policy(TASKS["two images"]).export_onnx(str(tmp_path / "x.onnx"))
    model = session(tmp_path / "x.onnx")
    assert [(i.name, i.shape, i.type) for i in model.get_inputs()] == [
        ("observation", ["batch", 108], "tensor(double)")
    ]
    assert [(o.name, o.shape, o.type) for o in model.get_outputs()] == [
        ("action", ["batch", 2], "tensor(double)"),
        ("standard_deviation", ["batch", 2], "tensor(double)"),
    ]


def test_a_model_names_its_version_and_no_path(tmp_path: Path) -> None:
    random_policy(TASKS["swing-up"]).export_onnx(tmp_path / "x.onnx")
    model = onnx.load(str(tmp_path / "x.onnx"))
    assert (model.producer_name, model.producer_version) == ("kreps", kreps.__version__)
    assert [(o.domain, o.version) for o in model.opset_import] == [("", 17)]
    assert model.ir_version == 8
    known = note(tmp_path / "x.onnx")
    assert known["version"] == kreps.__version__
    assert known["periodic"] == [0] and known["action_high"] == [30.0]
    content = (tmp_path / "x.onnx").read_bytes()
    assert str(tmp_path).encode() not in content
    assert not re.search(rb"/(home|work|tmp|usr)/", content)


def test_the_same_policy_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        random_policy(TASKS["joints"]).export_onnx(tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_loaded_policy_gives_the_same_model(tmp_path: Path) -> None:
    policy = random_policy(TASKS["joints"]).compressed(10)
    policy.save(tmp_path / "policy.safetensors")
    policy.export_onnx(tmp_path / "a")
    kreps.load_policy(tmp_path / "policy.safetensors").export_onnx(tmp_path / "b")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


# ---- errors -----------------------------------------------------------------------------------


def lipschitz() -> kreps.Policy:
    task = TASKS["swing-up"]
    kernel = Kernel(task.state_factors, np.ones(2))
    states = np.zeros((1, 2))
    return kreps.Policy(
        LipschitzPolicy(task, kernel, states, np.zeros((1, 1)), np.zeros(1), 1.0, 0.3, 0.3)
    )


def test_a_policy_that_is_not_a_gaussian_process_is_rejected_with_a_remedy(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"LipschitzPolicy.*kreps\.KREPS"):
        lipschitz().export_onnx(tmp_path / "x.onnx")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("dtype", ["float16", "", "double", None, np.float32, ["float32"]])
def test_an_unknown_dtype_is_rejected(dtype: Any, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="float64, float32"):
        random_policy(TASKS["plain"]).export_onnx(tmp_path / "x.onnx", dtype)
    assert not [*tmp_path.iterdir()]


def test_without_onnx_the_remedy_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.split(".")[0] == "onnx":
            raise ImportError(name)
        return real(name, *rest, **more)

    policy = random_policy(TASKS["plain"])
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ConfigurationError, match=r"pip install 'kreps\[onnx\]'"):
        policy.export_onnx(tmp_path / "x.onnx")
    assert not [*tmp_path.iterdir()]


def test_numbers_beyond_single_precision_are_rejected(tmp_path: Path) -> None:
    task = TaskSpec(1, [-1e60], [1e60])
    process = CostSensitiveGP(
        task,
        Kernel(task.state_factors, np.ones(1)),
        np.zeros((1, 1)),
        np.ones((1, 1)),
        np.ones(1),
        1.0,
        0.1,
    )
    with pytest.raises(ConfigurationError, match=r"float32 is 3\.4e\+38.*float64"):
        kreps.Policy(process).export_onnx(tmp_path / "x.onnx", "float32")
    assert not [*tmp_path.iterdir()]
    kreps.Policy(process).export_onnx(tmp_path / "x.onnx")


def test_a_model_replaces_a_file_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    policy = random_policy(TASKS["plain"])
    (tmp_path / "x.onnx").write_bytes(b"old")
    policy.export_onnx(tmp_path / "x.onnx")
    session(tmp_path / "x.onnx")
    (tmp_path / "folder").mkdir()
    for name in ("folder", "missing/x.onnx"):
        with pytest.raises(StorageError, match="cannot write"):
            policy.export_onnx(tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "x.onnx"]
