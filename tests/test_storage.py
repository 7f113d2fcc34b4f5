"""Files: exact round trips, and everything that can be wrong with them."""

from __future__ import annotations

import json
import os
import pickle
import struct
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import safetensors
import safetensors.numpy

import kreps
from kreps.algorithms.reps import LearnerState
from kreps.data import TaskSpec
from kreps.errors import StorageError
from kreps.policies import MAX_SUPPORT

TINY: dict[str, Any] = {"initial_rollouts": 6, "rollouts_per_iteration": 3, "window": 6}
STATES = np.random.default_rng(0).normal(size=(20, 2))
KINDS = ["policy", "checkpoint"]


@pytest.fixture(scope="module")
def learnt() -> kreps.KREPS:
    env = gym.make("kreps/SwingUp-v0")
    return kreps.KREPS(env, seed=4, restart_probability=0.1, **TINY).learn(2, progress=False)


@pytest.fixture(scope="module")
def files(learnt: kreps.KREPS, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of a good file of each kind."""
    folder = tmp_path_factory.mktemp("good")
    learnt.policy.save(folder / "policy")
    learnt.save(folder / "checkpoint")
    return {kind: (folder / kind).read_bytes() for kind in KINDS}


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Forged numbers may overflow on the way to being refused."""
    with np.errstate(all="ignore"):
        yield


def load(kind: str, path: Path) -> Any:
    return kreps.load_policy(path) if kind == "policy" else kreps.KREPS.resume(path)


def refused(kind: str, path: Path) -> str:
    """The message with which a file is refused; it names the file."""
    with pytest.raises(StorageError) as caught:
        load(kind, path)
    assert str(path) in str(caught.value)
    return str(caught.value)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def parts(content: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and kreps header of a file."""
    (size,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + size])["__metadata__"]["kreps"]
    return safetensors.numpy.load(content), json.loads(header)


def forge(path: Path, tensors: dict[str, Any], header: Any, key: str = "kreps") -> Path:
    text = header if isinstance(header, str) else json.dumps(header)
    arrays = {name: np.ascontiguousarray(values) for name, values in tensors.items()}
    path.write_bytes(safetensors.numpy.save(arrays, metadata={key: text}))
    return path


def raw(path: Path, header: bytes, declared: int | None = None, body: bytes = b"") -> Path:
    length = len(header) if declared is None else declared
    path.write_bytes(struct.pack("<Q", length) + header + body)
    return path


# ---- round trips ------------------------------------------------------------------------------


def test_a_policy_comes_back_exactly(learnt: kreps.KREPS, tmp_path: Path) -> None:
    policy = learnt.policy
    policy.save(tmp_path / "policy.safetensors")
    again = kreps.load_policy(str(tmp_path / "policy.safetensors"))
    np.testing.assert_array_equal(again.process.mean(STATES), policy.process.mean(STATES))
    np.testing.assert_array_equal(
        again.process.standard_deviation(STATES), policy.process.standard_deviation(STATES)
    )
    assert again.process.task.periodic == (0,)
    np.testing.assert_array_equal(again.process.task.action_high, [30.0])
    again.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (
        tmp_path / "policy.safetensors"
    ).read_bytes()


def test_the_seed_of_a_loaded_policy_decides_its_noise(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "policy"
    path.write_bytes(files["policy"])
    draws = [kreps.load_policy(path, seed=s).predict(STATES)[0] for s in (1, 1, 2)]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert not np.array_equal(draws[0], draws[2])


def assert_same_state(a: LearnerState, b: LearnerState) -> None:
    assert (a.iteration, a.rollouts, a.steps) == (b.iteration, b.rollouts, b.steps)
    assert a.window.capacity == b.window.capacity
    assert len(a.window.rollouts) == len(b.window.rollouts)
    for mine, theirs in zip(a.window.rollouts, b.window.rollouts, strict=True):
        for name in ("observations", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        assert mine.terminated == theirs.terminated
    for name in ("policy_start", "embedding_start"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    if a.policy is not None:
        assert b.policy is not None and a.value is not None and b.value is not None
        np.testing.assert_array_equal(a.policy.mean(STATES), b.policy.mean(STATES))
        np.testing.assert_array_equal(a.value(STATES), b.value(STATES))


def test_a_checkpoint_comes_back_exactly(learnt: kreps.KREPS, tmp_path: Path) -> None:
    learnt.save(tmp_path / "one")
    again = kreps.KREPS.resume(tmp_path / "one")
    assert again.seed == 4
    assert astuple(again.settings) == astuple(learnt.settings)
    assert again.task.periodic == (0,)
    assert_same_state(learnt.state, again.state)
    again.save(tmp_path / "two")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_a_checkpoint_leaves_out_nothing_of_the_state(learnt: kreps.KREPS) -> None:
    # a new field of the state must be written, and compared above
    assert {f.name for f in fields(learnt.state)} == {
        "window",
        "iteration",
        "rollouts",
        "steps",
        "policy",
        "value",
        "embedding_start",
        "policy_start",
    }


def test_a_learner_that_has_learnt_nothing_can_be_saved(tmp_path: Path) -> None:
    learner = kreps.KREPS(TaskSpec(3, [-1.0, 0.0], [1.0, 5.0], (2,)), seed=9, kl_bound=0.3)
    learner.save(tmp_path / "fresh")
    again = kreps.KREPS.resume(tmp_path / "fresh")
    assert again.seed == 9 and again.settings.kl_bound == 0.3
    assert again.task.observation_size == 3 and again.task.periodic == (2,)
    assert_same_state(learner.state, again.state)


@pytest.mark.parametrize("settings", [{"model": "sample"}, {"features": "grid"}])
def test_checkpoints_of_the_other_variants_come_back_exactly(
    settings: dict[str, Any], tmp_path: Path
) -> None:
    env = gym.make("kreps/SwingUp-v0")
    learner = kreps.KREPS(env, restart_probability=0.1, **TINY, **settings)
    learner.learn(1, progress=False).save(tmp_path / "x")
    again = kreps.KREPS.resume(tmp_path / "x", env)
    assert_same_state(learner.state, again.state)
    again.learn(1, progress=False)
    assert again.state.iteration == 2


def test_real_ends_survive_a_checkpoint(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]))
    learner.update(
        kreps.Rollout(rng.normal(size=(k + 1, 2)), rng.normal(size=(k, 1)), rng.normal(size=k), end)
        for k, end in ((4, True), (1, False), (7, True))
    )
    learner.save(tmp_path / "x")
    again = kreps.KREPS.resume(tmp_path / "x")
    assert [r.terminated for r in again.state.window.rollouts] == [True, False, True]
    assert [len(r) for r in again.state.window.rollouts] == [4, 1, 7]


def test_files_hold_no_code(files: dict[str, bytes]) -> None:
    for content in files.values():
        tensors, header = parts(content)
        assert all(values.dtype == np.float64 for values in tensors.values())
        assert set(header) >= {"kind", "version", "task"}


# ---- writing ----------------------------------------------------------------------------------


def test_saving_leaves_only_the_file(learnt: kreps.KREPS, tmp_path: Path) -> None:
    for _ in range(2):  # anew and over an old one
        learnt.policy.save(tmp_path / "policy")
        learnt.save(tmp_path / "checkpoint")
        assert names(tmp_path) == ["checkpoint", "policy"]


def test_saving_where_a_folder_stands_is_an_error_that_leaves_nothing_behind(
    learnt: kreps.KREPS, tmp_path: Path
) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(StorageError, match="there"):
        learnt.policy.save(tmp_path / "there")
    assert names(tmp_path) == ["there"]


@pytest.mark.parametrize("where", ["missing/policy", "file/policy", "x" * 300, "", "nul\0byte"])
def test_saving_where_nothing_can_be_written_is_an_error_of_the_library(
    learnt: kreps.KREPS, tmp_path: Path, where: str
) -> None:
    (tmp_path / "file").write_text("not a folder")
    path = str(tmp_path / where) if where else where
    for save in (learnt.policy.save, learnt.save):
        with pytest.raises(StorageError):
            save(path)
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(
    learnt: kreps.KREPS, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    path = tmp_path / "policy"
    path.write_bytes(b"the old content")

    def no_space(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, failing, no_space)
        with pytest.raises(StorageError, match="No space left"):
            learnt.policy.save(path)
    assert path.read_bytes() == b"the old content"
    assert names(tmp_path) == ["policy"]


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_without_permission_keeps_the_old_file(
    learnt: kreps.KREPS, tmp_path: Path
) -> None:
    path = tmp_path / "policy"
    path.write_bytes(b"the old content")
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(StorageError, match="Permission denied"):
            learnt.policy.save(path)
    finally:
        tmp_path.chmod(0o700)
    assert path.read_bytes() == b"the old content"


# ---- damaged files ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_file_is_refused_at_every_length(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    content, path = files[kind], tmp_path / "cut"
    lengths = {*range(17), *np.linspace(17, len(content) - 1, 60).astype(int).tolist()}
    for length in sorted(lengths):
        path.write_bytes(content[:length])
        refused(kind, path)


@pytest.mark.parametrize("kind", KINDS)
def test_an_overlong_file_is_refused(kind: str, files: dict[str, bytes], tmp_path: Path) -> None:
    path = tmp_path / "long"
    path.write_bytes(files[kind] + b"\0" * 8)
    refused(kind, path)


@pytest.mark.parametrize("kind", KINDS)
def test_flipped_bytes_are_refused_or_harmless(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    content, path = files[kind], tmp_path / "flipped"
    (size,) = struct.unpack("<Q", content[:8])
    rng = np.random.default_rng(7)
    outcomes = {"refused": 0, "loaded": 0}
    for trial in range(240):
        # a third each in the header, in any byte of a number, and in its exponent
        body = rng.integers(8 + size, len(content))
        exponent = 8 + size + 8 * ((body - 8 - size) // 8) + rng.choice([6, 7])
        where = int((rng.integers(0, 8 + size), body, exponent)[trial % 3])
        damaged = bytearray(content)
        damaged[where] ^= int(rng.integers(1, 256))
        path.write_bytes(damaged)
        try:
            loaded = load(kind, path)
        except StorageError:
            outcomes["refused"] += 1
            continue
        outcomes["loaded"] += 1
        policy = loaded if kind == "policy" else loaded.policy
        for deterministic in (True, False):
            actions, _ = policy.predict(STATES, deterministic=deterministic)
            assert np.isfinite(actions).all(), f"byte {where}"
    assert min(outcomes.values()) > 20  # both happen, or this would show nothing


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\0" * 8,
        b"\0" * 4096,
        b"observation,action\n1.0,2.0\n" * 40,
        pickle.dumps({"policy.states": [1.0, 2.0], "kind": "policy"}),
        b"PK\x03\x04" + bytes(range(256)) * 4,
        b'{"kind": "policy", "version": 2}',
        "säuberlich, aber kein Array".encode("utf-16"),
        b"\xff" * 1024,
    ],
    ids=["empty", "short", "zeros", "text", "pickle", "zip", "json", "utf-16", "ones"],
)
def test_foreign_files_are_refused(kind: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "foreign"
    path.write_bytes(content)
    refused(kind, path)


def test_a_pickle_is_not_executed(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return (os.mkdir, (str(tmp_path / "exploded"),))

    path = tmp_path / "bomb"
    path.write_bytes(pickle.dumps(Bomb()))
    for kind in KINDS:
        refused(kind, path)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_paths_that_are_no_files_are_refused(kind: str, tmp_path: Path) -> None:
    refused(kind, tmp_path)
    refused(kind, tmp_path / "missing")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    refused(kind, tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")  # opening it would wait for a writer for ever
    refused(kind, tmp_path / "pipe")
    refused(kind, tmp_path / ("x" * 300))


def test_other_safetensors_files_are_refused(files: dict[str, bytes], tmp_path: Path) -> None:
    tensors, header = parts(files["policy"])
    path = tmp_path / "foreign"
    path.write_bytes(safetensors.numpy.save(tensors))
    assert "another program" in refused("policy", path)
    forge(path, tensors, header, key="other")
    assert "another program" in refused("policy", path)


def test_a_checkpoint_is_no_policy_and_the_other_way_round(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "x"
    path.write_bytes(files["checkpoint"])
    assert "it is a kreps checkpoint" in refused("policy", path)
    path.write_bytes(files["policy"])
    assert "it is a kreps policy" in refused("checkpoint", path)


@pytest.mark.parametrize("version", [0, 1, 3, -1, "2", None, 1e300, [2]])
def test_another_version_is_refused_with_its_remedy(
    version: Any, files: dict[str, bytes], tmp_path: Path
) -> None:
    for kind in KINDS:
        tensors, header = parts(files[kind])
        path = forge(tmp_path / kind, tensors, {**header, "version": version})
        assert "version" in refused(kind, path)


def test_a_missing_version_is_refused(files: dict[str, bytes], tmp_path: Path) -> None:
    tensors, header = parts(files["policy"])
    del header["version"]
    refused("policy", forge(tmp_path / "x", tensors, header))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_nan_or_infinity_in_any_array_is_refused(
    kind: str, value: float, files: dict[str, bytes], tmp_path: Path
) -> None:
    tensors, header = parts(files[kind])
    for name in tensors:
        spoilt = {**tensors, name: tensors[name].copy()}
        spoilt[name].flat[-1] = value
        assert name in refused(kind, forge(tmp_path / "x", spoilt, header))


@pytest.mark.parametrize("kind", KINDS)
def test_every_array_is_needed_in_its_shape(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    tensors, header = parts(files[kind])
    path = tmp_path / "x"
    for name, values in tensors.items():
        others = {n: v for n, v in tensors.items() if n != name}
        assert name in refused(kind, forge(path, others, header))
        for wrong in (values[:-1], values[None], values.ravel()[:0], np.float64(1.0)):
            assert "shape" in (
                m := refused(kind, forge(path, {**others, name: wrong}, header))
            ) or ("do not fit" in m or "no support point" in m)


@pytest.mark.parametrize("kind", KINDS)
def test_other_number_types_are_refused(kind: str, files: dict[str, bytes], tmp_path: Path) -> None:
    tensors, header = parts(files[kind])
    for dtype in (np.float32, np.int64, np.float16, np.bool_):
        narrow = {name: values.astype(dtype) for name, values in tensors.items()}
        assert "64-bit" in refused(kind, forge(tmp_path / "x", narrow, header))
    one = next(iter(tensors))
    mixed = {**tensors, one: tensors[one].astype(np.float32)}
    assert one in refused(kind, forge(tmp_path / "x", mixed, header))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("policy.lengthscales", lambda v: -v),
        ("policy.lengthscales", lambda v: 0 * v),
        ("policy.lengthscales", lambda v: 1e-320 * v),
        ("policy.weights", lambda v: -v),
        ("policy.weights", lambda v: 0 * v),
        ("policy.signal_and_noise", lambda v: -v),
        ("policy.signal_and_noise", lambda v: v * [1, 0]),
        ("policy.signal_and_noise", lambda v: v * [0, 1]),
    ],
)
def test_impossible_parameters_are_refused(
    name: str, change: Callable[[Any], Any], files: dict[str, bytes], tmp_path: Path
) -> None:
    for kind in KINDS:
        tensors, header = parts(files[kind])
        assert name in tensors
        path = forge(tmp_path / kind, {**tensors, name: change(tensors[name])}, header)
        refused(kind, path)


def test_a_policy_that_would_answer_nan_is_refused(tmp_path: Path) -> None:
    # finite numbers all, but the distances of the states overflow
    header = {"kind": "policy", "version": 2, "task": _task(2)}
    tensors = {
        "policy.lengthscales": np.array([1e-200, 1e-200]),
        "policy.states": np.array([[1e150, -1e150]]),
        "policy.targets": np.array([[1e308]]),
        "policy.weights": np.array([1.0]),
        "policy.signal_and_noise": np.array([1.0, 1e-300]),
    }
    path = forge(tmp_path / "x", tensors, header)
    try:
        policy = kreps.load_policy(path)
    except StorageError:
        return
    actions, _ = policy.predict(STATES, deterministic=True)
    assert np.isfinite(actions).all()


@pytest.mark.parametrize(
    "lengths",
    [[0.0], [-1.0], [0.5], [1e99], [1e18]],
    ids=["zero", "negative", "half", "1e99", "1e18"],
)
def test_impossible_lengths_of_rollouts_are_refused(
    lengths: list[float], files: dict[str, bytes], tmp_path: Path
) -> None:
    tensors, header = parts(files["checkpoint"])
    changed = tensors["window.lengths"].copy()
    changed[0] += changed[1] - lengths[0]  # the sum stays right
    changed[1] = lengths[0]
    path = forge(tmp_path / "x", {**tensors, "window.lengths": changed}, header)
    assert "lengths of its roll-outs" in refused("checkpoint", path)


# ---- hostile headers --------------------------------------------------------------------------


def _task(observation_size: Any = 2, **changes: Any) -> dict[str, Any]:
    task = {
        "observation_size": observation_size,
        "action_low": [-1.0],
        "action_high": [1.0],
        "periodic": [],
        "groups": [],
        "image_shape": None,
    }
    return {**task, **changes}


@pytest.mark.parametrize(
    "task",
    [
        None,
        [],
        "task",
        {},
        _task(0),
        _task(-2),
        _task(3),
        _task(10**9),
        _task(1e999),
        _task("two"),
        _task(None),
        _task(action_low="low"),
        _task(action_low=[1.0]),
        _task(action_low=[float("nan")]),
        _task(action_low=[]),
        _task(action_low=[[-1.0]]),
        _task(action_low=[-1.0, [2.0]]),
        _task(action_low={"a": 1}),
        _task(action_high=[1.0, 2.0]),
        _task(periodic=[5]),
        _task(periodic=[-1]),
        _task(periodic=0),
        _task(periodic=["x"]),
        _task(periodic=[1e999]),
    ],
)
def test_forged_tasks_are_refused(task: Any, files: dict[str, bytes], tmp_path: Path) -> None:
    for kind in KINDS:
        tensors, header = parts(files[kind])
        refused(kind, forge(tmp_path / kind, tensors, {**header, "task": task}))


@pytest.mark.parametrize(
    "changes",
    [
        {"settings": None},
        {"settings": []},
        {"settings": {"kl_bound": 0}},
        {"settings": {"colour": "red"}},
        {"settings": {"model": ["embedding"]}},
        {"settings": {"restart_probability": float("nan")}},
        {"seed": -1},
        {"seed": "0"},
        {"seed": 0.5},
        {"seed": None},
        {"iteration": -1},
        {"iteration": 1.0},
        {"rollouts": [1]},
        {"steps": float("inf")},
    ],
)
def test_forged_checkpoints_are_refused(
    changes: dict[str, Any], files: dict[str, bytes], tmp_path: Path
) -> None:
    tensors, header = parts(files["checkpoint"])
    refused("checkpoint", forge(tmp_path / "x", tensors, {**header, **changes}))


@pytest.mark.parametrize(
    "text",
    ["", "null", "7", "[]", '"policy"', "{}", '{"kind": []}', "{" * 10, "nan", "[" * 100_000],
)
def test_forged_headers_are_refused(text: str, files: dict[str, bytes], tmp_path: Path) -> None:
    tensors, _ = parts(files["policy"])
    refused("policy", forge(tmp_path / "x", tensors, text))


def test_deeply_nested_json_is_refused(files: dict[str, bytes], tmp_path: Path) -> None:
    tensors, _ = parts(files["policy"])
    nested = '{"kind": "policy", "version": 2, "task": ' + '{"a":' * 40_000 + "1" + "}" * 40_001
    refused("policy", forge(tmp_path / "x", tensors, nested))
    refused("policy", raw(tmp_path / "y", b'{"a":' * 30_000 + b"1" + b"}" * 30_000))


@pytest.mark.parametrize("declared", [0, 1, 2**18, 2**31, 2**40, 2**63 - 1, 2**63, 2**64 - 1])
def test_a_wrong_header_length_is_refused_without_an_allocation(
    declared: int, tmp_path: Path
) -> None:
    path = raw(tmp_path / "x", b'{"__metadata__":{}}', declared)
    tracemalloc.start()
    try:
        refused("policy", path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2**20


@pytest.mark.parametrize(
    "entry",
    [
        {"dtype": "F64", "shape": [2**40], "data_offsets": [0, 2**43]},
        {"dtype": "F64", "shape": [2**62, 2**62], "data_offsets": [0, 8]},
        {"dtype": "F64", "shape": [1], "data_offsets": [8, 0]},
        {"dtype": "F64", "shape": [-1], "data_offsets": [0, 8]},
        {"dtype": "F64", "shape": [1], "data_offsets": [0, 2**64 - 1]},
        {"dtype": "O", "shape": [1], "data_offsets": [0, 8]},
    ],
)
def test_arrays_that_lie_about_their_place_are_refused(
    entry: dict[str, Any], tmp_path: Path
) -> None:
    metadata = {"kreps": json.dumps({"kind": "policy", "version": 2, "task": _task()})}
    header = json.dumps({"__metadata__": metadata, "policy.weights": entry}).encode()
    refused("policy", raw(tmp_path / "x", header, body=b"\0" * 8))


def test_a_file_of_three_gibibytes_is_refused_at_once(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "sparse"
    path.write_bytes(files["policy"])
    os.truncate(path, 3 * 2**30)
    started = time.process_time()
    assert "limit" in refused("policy", path)
    assert time.process_time() - started < 0.5


def test_too_many_support_points_are_refused_at_once(tmp_path: Path) -> None:
    rng, m = np.random.default_rng(0), MAX_SUPPORT + 1
    path = _policy_of_size(tmp_path / "x", rng.normal(size=(m, 2)), 1.0)
    tracemalloc.start()
    started = time.process_time()
    try:
        assert str(MAX_SUPPORT) in refused("policy", path).replace(",", "").replace("_", "")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert time.process_time() - started < 1.0
    assert peak < 20 * 2**20


def _policy_of_size(path: Path, states: Any, lengthscale: float) -> Path:
    m, ds = states.shape
    tensors = {
        "policy.lengthscales": np.full(ds, lengthscale),
        "policy.states": states,
        "policy.targets": np.zeros((m, 1)),
        "policy.weights": np.ones(m),
        "policy.signal_and_noise": np.array([1.0, 0.1]),
    }
    header = {"kind": "policy", "version": 2, "policy": "cost-sensitive-gp", "task": _task(ds)}
    return forge(path, tensors, {**header, "arrays": sorted(tensors)})


def _sparse_policy(path: Path) -> Path:
    """One array of 1 GiB of zeros that takes no room on disk, and that no policy has."""
    size = 2**30
    metadata = {"kreps": json.dumps({"kind": "policy", "version": 2, "task": _task()})}
    entry = {"dtype": "F64", "shape": [size // 8], "data_offsets": [0, size]}
    header = json.dumps({"__metadata__": metadata, "x": entry}).encode()
    raw(path, header)
    os.truncate(path, 8 + len(header) + size)
    return path


def _in_a_process(code: str, path: Path) -> str:
    done = subprocess.run(
        [sys.executable, "-c", "import resource, sys, kreps, kreps.storage\n" + code, str(path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-500:]
    return done.stdout


def test_a_file_larger_than_the_memory_is_an_error_of_the_library(tmp_path: Path) -> None:
    code = """
resource.setrlimit(resource.RLIMIT_AS, (3 * 2**28, 3 * 2**28))
try:
    kreps.load_policy(sys.argv[1])
except kreps.StorageError:
    print("refused")
"""
    assert _in_a_process(code, _sparse_policy(tmp_path / "hostile")).strip() == "refused"


def test_an_array_that_no_policy_has_is_not_read(tmp_path: Path) -> None:
    code = """
try:
    kreps.load_policy(sys.argv[1])
except kreps.StorageError:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    kilobytes = int(_in_a_process(code, _sparse_policy(tmp_path / "hostile")))
    assert kilobytes < 400 * 1024  # about 80 MB without the array


# ---- resuming in another environment ----------------------------------------------------------


def test_resuming_in_another_environment_is_refused(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(files["checkpoint"])
    with pytest.raises(kreps.ConfigurationError, match="learnt in"):
        kreps.KREPS.resume(path, gym.make("Pendulum-v1"))
