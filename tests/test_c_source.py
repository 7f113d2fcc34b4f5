"""C source of policies, compiled by gcc, against the policies that it was made from."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import kreps
from kreps.data.history import first_lags, next_lags, states_of
from kreps.data.spaces import Spaces
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.kernels.kernel import Kernel
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP

GCC = shutil.which("gcc")
pytestmark = pytest.mark.skipif(GCC is None, reason="needs gcc")

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1")

TOLERANCES = {"float64": 1e-12, "float32": 1e-5}
"""Of the action, in units of its scale."""

TWO = [-1.0, 10.0], [1.0, 30.0]
IMAGES = (tuple(range(1, 40, 2)), tuple(range(0, 40, 2)))  # pixels of two images in turns

TASKS = {
    "swing-up": TaskSpec(2, [-30.0], [30.0], (0,)),
    "joints": TaskSpec(5, *TWO, (1, 3), ((0, 2), (1, 3))),
    "images": TaskSpec(40, *TWO, (), IMAGES, (4, 5)),
    "delay": TaskSpec(3, *TWO, (1,), delay=2),
    "history": TaskSpec(3, *TWO, (1,), delay=1, history=2),
    "whole": TaskSpec(2, [-3.0], [4.0], spaces=Spaces((2,), (1,), "int64")),
}


def observations_of(task: TaskSpec, n: int, seed: int) -> FloatArray:
    return np.random.default_rng(seed).normal(size=(n, task.observation_size))


def smooth_policy(task: TaskSpec, centres: int = 30) -> kreps.Policy:
    """A policy whose weights are small, so that rounding errors stay near their size."""
    rng = np.random.default_rng(1)
    lengthscales = rng.uniform(0.7, 1.4, len(task.state_factors)) * (4 if task.image_shape else 1)
    n = 3 * centres
    process = CostSensitiveGP(
        task,
        Kernel(task.state_factors, lengthscales),
        rng.normal(size=(n, task.state_size)),
        rng.normal(size=(n, task.action_size)),
        rng.uniform(0.1, 1.0, n),
        0.7,
        0.5,
    )
    return kreps.Policy(process).compressed(centres)


class Compiled:
    """The functions of the source of a policy, as Python calls them."""

    def __init__(self, policy: kreps.Policy, folder: Path, dtype: str = "float64") -> None:
        self.task, self.dtype = policy.process.task, dtype
        self.arithmetic = policy.export_c(folder / "arm.c", dtype)
        library = folder / "arm.so"
        subprocess.run(
            [str(GCC), *STRICT, "-shared", "-fPIC", "-o", library, folder / "arm.c", "-lm"],
            check=True,
        )
        self.functions: Any = ctypes.CDLL(str(library))

    def array(self, values: Any) -> Any:
        return np.array(values, self.dtype)

    def call(self, name: str, *arrays: Any) -> int:
        status: int = getattr(self.functions, name)(
            *(ctypes.c_void_p(a.ctypes.data) for a in arrays)
        )
        return status

    def actions(self, observations: FloatArray) -> FloatArray:
        """The action (n, da) at each observation, without lags."""
        found = []
        for each in self.array(observations):
            action = self.array(np.full(self.task.action_size, np.nan))
            assert self.call("arm_act", each, action) == 0
            found.append(action)
        return np.array(found, np.float64)


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("name", ["swing-up", "joints", "images", "whole"])
def test_the_source_computes_what_the_policy_computes(
    name: str, dtype: str, tmp_path: Path
) -> None:
    task = TASKS[name]
    policy = smooth_policy(task)
    model = Compiled(policy, tmp_path, dtype)
    assert model.arithmetic == dtype
    at = np.concatenate([observations_of(task, 300, 3), 50.0 + observations_of(task, 5, 4)])
    at = at.astype(dtype).astype(np.float64)
    wanted, _ = policy.predict(at, deterministic=True)
    assert np.ptp(wanted, axis=0).min() > 0.1
    error = np.abs((model.actions(at) - wanted) / task.action_scale).max()
    assert error < TOLERANCES[dtype]


@pytest.mark.parametrize("dtype", TOLERANCES)
@pytest.mark.parametrize("name", ["delay", "history"])
def test_lags_are_kept_as_the_policy_keeps_them(name: str, dtype: str, tmp_path: Path) -> None:
    task = TASKS[name]
    policy = smooth_policy(task)
    model = Compiled(policy, tmp_path, dtype)
    at = np.cumsum(observations_of(task, 30, 3), axis=0)  # angles that pass several turns
    at = at.astype(dtype).astype(np.float64)
    lags, action = (model.array(np.full(n, np.nan)) for n in (task.state_size - 3, 2))
    model.call("arm_start", model.array(at[0]), lags)
    known = first_lags(at[:1], task)
    np.testing.assert_array_equal(lags, known[0].astype(dtype))
    for each in at:
        states = states_of(each[None], known, task)
        wanted = task.clip(policy.process.greedy(states))
        assert model.call("arm_act", model.array(each), lags, action) == 0
        assert np.abs((action - wanted) / task.action_scale).max() < TOLERANCES[dtype]
        known = next_lags(each[None], known, task.scaled_applied(wanted), task)
        np.testing.assert_allclose(lags, known[0], rtol=0, atol=10 * TOLERANCES[dtype])
        known[0] = lags  # so that errors do not add up


def test_a_learnt_policy_is_computed_as_exactly(tmp_path: Path) -> None:
    env = gym.make("kreps/SwingUp-v0")
    exact = kreps.KREPS(env, seed=100, preset="single_step").learn(4, progress=False).policy
    rng = np.random.default_rng(4)
    for policy, dtype in ((exact, "float64"), (exact.compressed(50), "float32")):
        (tmp_path / dtype).mkdir()  # a library is loaded once for each path
        model = Compiled(policy, tmp_path / dtype, dtype)
        assert model.arithmetic == dtype
        at = np.stack([rng.uniform(-9.0, 9.0, 500), rng.uniform(-15.0, 15.0, 500)], axis=1)
        at = at.astype(dtype).astype(np.float64)
        error = model.actions(at) - policy.predict(at, deterministic=True)[0]
        assert np.abs(error / 30.0).max() < TOLERANCES[dtype]


def test_actions_are_never_beyond_the_limits(tmp_path: Path) -> None:
    low, high = np.array([-0.1, 0.1]), np.array([0.7, 0.3])  # none has a float of its own
    task = TaskSpec(1, low, high)
    states = np.linspace(-2.0, 2.0, 40)[:, None]
    targets, kernel = 3.0 * np.sign(states) * [1.0, -1.0], Kernel(task.state_factors, np.ones(1))
    process = CostSensitiveGP(task, kernel, states, targets, np.full(40, 100.0), 1.0, 0.1)
    action = Compiled(kreps.Policy(process), tmp_path, "float32").actions(states)
    assert (action >= low).all() and (action <= high).all()
    np.testing.assert_allclose(action.min(axis=0), low, atol=1e-7)
    np.testing.assert_allclose(action.max(axis=0), high, atol=1e-7)


@pytest.mark.parametrize("name", ["joints", "history"])
def test_numbers_that_are_not_finite_give_no_action(name: str, tmp_path: Path) -> None:
    task = TASKS[name]
    model = Compiled(smooth_policy(task), tmp_path)
    lags = [model.array(np.zeros(task.state_size - task.observation_size))] * (name == "history")
    for number in (np.nan, np.inf, -np.inf):
        for place in range(task.observation_size):
            at, action = model.array(np.zeros(task.observation_size)), model.array([5.0, 6.0])
            at[place] = number
            assert model.call("arm_act", at, *lags, action) == 1
            np.testing.assert_array_equal(action, [5.0, 6.0])
            assert not any(each.any() for each in lags)


def test_the_time_of_a_call_is_printed(tmp_path: Path) -> None:
    for name, task in TASKS.items():
        smooth_policy(task).export_c(tmp_path / "arm.c", "float32")
        if name not in ("swing-up", "history"):
            continue
        program = tmp_path / "time"
        command = [str(GCC), *STRICT, "-DKREPS_BENCHMARK", "-o", program, tmp_path / "arm.c", "-lm"]
        subprocess.run(command, check=True)
        done = subprocess.run([program], check=True, capture_output=True, text=True)
        found = re.fullmatch(r"100000 calls: mean ([\d.]+) us, longest ([\d.]+) us\n", done.stdout)
        assert found and 0.0 < float(found[1]) < float(found[2])


def test_weights_beyond_single_precision_are_computed_in_double(tmp_path: Path) -> None:
    own = smooth_policy(TASKS["joints"]).process
    assert isinstance(own, SparseGP)
    huge = own.mean_weights.copy()
    huge[:2] = [[1e4, 0.0], [-1e4, 0.0]]
    policy = kreps.Policy(
        SparseGP(own.task, own.kernel, own.states, huge, own.explained, own.signal, own.noise)
    )
    assert policy.export_c(tmp_path / "arm.c", "float32") == "float64"
    assert "typedef double real;" in (tmp_path / "arm.c").read_text()
    assert "typedef float arm_number;" in (tmp_path / "arm.h").read_text()


def test_the_same_policy_gives_the_same_source_without_a_path(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        smooth_policy(TASKS["history"]).export_c(tmp_path / name / "arm.c")
    for file in ("arm.c", "arm.h"):
        content = (tmp_path / "a" / file).read_text()
        assert content == (tmp_path / "b" / file).read_text()
        assert str(tmp_path) not in content


@pytest.mark.parametrize("name", ["policy.h", "2arm.c", "my-arm.c", "ärm.c", ".c", "policy"])
def test_a_name_that_is_none_in_c_is_rejected(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"such as arm_policy\.c"):
        smooth_policy(TASKS["joints"]).export_c(tmp_path / name)
    with pytest.raises(StorageError, match="cannot write"):
        smooth_policy(TASKS["joints"]).export_c(tmp_path / "missing" / "arm.c")
    assert not [*tmp_path.iterdir()]
