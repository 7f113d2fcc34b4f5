"""Files: exact round trips, and everything that can be wrong with them."""

from __future__ import annotations

import itertools
import json
import os
import pickle
import struct
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import safetensors
import safetensors.numpy

import kreps
from kreps.algorithms.state import LearnerState
from kreps.data.task import TaskSpec
from kreps.errors import StorageError
from kreps.kernels.kernel import Kernel
from kreps.learning.learner import Learner
from kreps.learning.methods import LEARNERS
from kreps.learning.storage import POLICIES_OF_METHOD, save_policy
from kreps.learning.storage.checksum import sealed
from kreps.policies.cost_sensitive_gp import MAX_SUPPORT
from kreps.policies.sparse_gp import SparseGP
from kreps.policies.value_based import LipschitzPolicy

TINY: dict[str, Any] = {"initial_rollouts": 6, "rollouts_per_iteration": 3, "window": 6}
SETTINGS: dict[str, dict[str, Any]] = {
    method: {"restart_probability": 0.1, **TINY} for method in LEARNERS
} | {
    # a gradient step leaves a policy of few centres, which is a variant of its own
    "reps": {
        "restart_probability": 0.1,
        **TINY,
        "model_based.random_policies": 0,
        "model_based.regulators": 0,
        "model_based.gradient_steps": 0,
    },
    "grid-value-iteration": {
        "ranges": ((-3.0, 3.0), (-8.0, 8.0)),
        "grid_states": 4,
        "grid_actions": 3,
    },
}
VARIANTS = [*LEARNERS, "reps, compressed"]
"""What files are made of: every method, and REPS with a policy of few centres."""
KIND_OF_VARIANT = {
    "reps": "cost-sensitive-gp",
    "reps, compressed": "sparse-gp",
    "value-iteration": "softmax",
    "grid-value-iteration": "softmax",
    "npalp": "lipschitz",
}
STATES = np.random.default_rng(0).normal(size=(20, 2))
NOISE = np.random.default_rng(1).normal(size=(20, 1))
KINDS = ["policy", "checkpoint"]


def load(kind: str, path: Path, method: str = "reps") -> Any:
    return kreps.load_policy(path) if kind == "policy" else LEARNERS[method].resume(path)


def rejected(kind: str, path: Path, method: str = "reps") -> str:
    """The message with which a file is refused: quickly, and naming the file."""
    started = time.process_time()
    with pytest.raises(StorageError) as caught:
        load(kind, path, method)
    assert time.process_time() - started < 1.0
    assert str(path) in str(caught.value)
    return str(caught.value)


def parts(content: bytes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and kreps header of a file."""
    (size,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + size])["__metadata__"]["kreps"]
    return safetensors.numpy.load(content), json.loads(header)


def forge(path: Path, tensors: dict[str, Any], header: Any, key: str = "kreps") -> Path:
    """A file with a checksum that fits, if the header has one, so that all else is checked."""
    has_checksum = isinstance(header, dict) and "sha256" in header
    if has_checksum:
        header = {**header, "sha256": "0" * 64}
    text = header if isinstance(header, str) else json.dumps(header)
    arrays = {name: np.array(values, order="C") for name, values in tensors.items()}
    content = safetensors.numpy.save(arrays, metadata={key: text})
    path.write_bytes(sealed(content) if has_checksum else content)
    return path


def raw(path: Path, header: bytes, declared: int | None = None, body: bytes = b"") -> Path:
    length = len(header) if declared is None else declared
    path.write_bytes(struct.pack("<Q", length) + header + body)
    return path


@dataclass(frozen=True)
class Good:
    """A good file, and how files like it are read."""

    method: str
    kind: str
    content: bytes

    @property
    def tensors(self) -> dict[str, Any]:
        return parts(self.content)[0]

    @property
    def header(self) -> dict[str, Any]:
        return parts(self.content)[1]

    @property
    def policy(self) -> dict[str, Any]:
        """What the header has of the policy."""
        return self.policy_of(self.header)

    def policy_of(self, header: dict[str, Any]) -> dict[str, Any]:
        return header["policy"] if self.kind == "policy" else header["state"]["policy"]

    def load(self, path: Path) -> Any:
        return load(self.kind, path, self.method)

    def rejected(self, path: Path) -> str:
        return rejected(self.kind, path, self.method)

    def refused_with(
        self, path: Path, tensors: dict[str, Any] | None = None, header: Any = None
    ) -> str:
        """As `rejected`, with other arrays or another header."""
        arrays, known = parts(self.content)
        forge(path, arrays if tensors is None else tensors, known if header is None else header)
        return self.rejected(path)


def compressed(learner: Learner[Any], centres: int) -> Learner[Any]:
    """The learner as if its latest policy had few centres."""
    other = type(learner)(learner.task, seed=learner.seed)
    other.settings = learner.settings
    other.state = replace(learner.state, policy=learner.policy.compressed(centres).process)
    return other


def good_files(learners: Mapping[str, Learner[Any]], folder: Path) -> dict[str, Good]:
    """What learners write, by variant and kind."""
    files = {}
    for variant, learner in learners.items():
        for kind, save in zip(KINDS, (learner.policy.save, learner.save), strict=True):
            save(folder / kind)
            content = (folder / kind).read_bytes()
            files[f"{variant} {kind}"] = Good(learner.method, kind, content)
    return files


@pytest.fixture(scope="module")
def learners() -> dict[str, Learner[Any]]:
    """One of each variant, after two updates."""
    learnt: dict[str, Learner[Any]] = {
        method: LEARNERS[method](gym.make("kreps/SwingUp-v0"), seed=4, **settings).learn(
            2, progress=False
        )
        for method, settings in SETTINGS.items()
    }
    return {**learnt, "reps, compressed": compressed(learnt["reps"], 12)}


@pytest.fixture(params=VARIANTS)
def learnt(request: pytest.FixtureRequest, learners: dict[str, Learner[Any]]) -> Learner[Any]:
    return learners[request.param]


@pytest.fixture
def one(learners: dict[str, Learner[Any]]) -> Learner[Any]:
    """Where the method does not matter."""
    return learners["npalp"]


@pytest.fixture(scope="module")
def files(
    learners: dict[str, Learner[Any]], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Good]:
    return good_files(learners, tmp_path_factory.mktemp("good"))


@pytest.fixture(params=[f"{variant} {kind}" for variant in VARIANTS for kind in KINDS])
def good(request: pytest.FixtureRequest, files: dict[str, Good]) -> Good:
    return files[request.param]


@pytest.fixture(params=[f"{variant} checkpoint" for variant in VARIANTS])
def checkpoint(request: pytest.FixtureRequest, files: dict[str, Good]) -> Good:
    return files[request.param]


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Forged numbers may overflow on the way to being refused."""
    with np.errstate(all="ignore"):
        yield


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# ---- round trips ------------------------------------------------------------------------------


def test_a_policy_comes_back_exactly(learnt: Learner[Any], tmp_path: Path) -> None:
    learnt.policy.save(tmp_path / "policy.safetensors")
    again = kreps.load_policy(str(tmp_path / "policy.safetensors"))
    assert_same_policy(again.process, learnt.policy.process)
    assert again.process.task.periodic == (0,)
    np.testing.assert_array_equal(again.process.task.action_high, [30.0])
    again.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (
        tmp_path / "policy.safetensors"
    ).read_bytes()


def test_the_seed_of_a_loaded_policy_decides_its_noise(
    learnt: Learner[Any], tmp_path: Path
) -> None:
    learnt.policy.save(tmp_path / "policy")
    draws = [kreps.load_policy(tmp_path / "policy", seed=s).predict(STATES)[0] for s in (1, 1, 2)]
    np.testing.assert_array_equal(draws[0], draws[1])
    explores = learnt.method != "grid-value-iteration"
    assert np.array_equal(draws[0], draws[2]) != explores


def assert_same_policy(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    np.testing.assert_array_equal(a.greedy(STATES), b.greedy(STATES))
    np.testing.assert_array_equal(a.act(STATES, NOISE), b.act(STATES, NOISE))


def assert_same_state(a: LearnerState, b: LearnerState) -> None:
    assert (a.iteration, a.rollouts, a.steps) == (b.iteration, b.rollouts, b.steps)
    assert a.terminated is b.terminated
    assert a.window.capacity == b.window.capacity
    assert len(a.window.rollouts) == len(b.window.rollouts)
    for mine, theirs in zip(a.window.rollouts, b.window.rollouts, strict=True):
        for name in ("observations", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        assert mine.terminated == theirs.terminated
    for name in ("policy_start", "embedding_start", "reward_start"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.policy is None) == (b.policy is None)
    if a.policy is not None:
        assert_same_policy(a.policy, b.policy)
    assert (a.value is None) == (b.value is None)
    if a.value is not None and b.value is not None:
        np.testing.assert_array_equal(a.value(STATES), b.value(STATES))


def test_a_checkpoint_comes_back_exactly(learnt: Learner[Any], tmp_path: Path) -> None:
    learnt.save(tmp_path / "one")
    again = type(learnt).resume(tmp_path / "one")
    assert type(again) is type(learnt) and again.seed == 4
    assert again.settings == learnt.settings
    assert again.task.periodic == (0,)
    assert_same_state(learnt.state, again.state)
    again.save(tmp_path / "two")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_a_checkpoint_leaves_out_nothing_of_the_state() -> None:
    # a new field of the state must be written, and compared above
    assert {f.name for f in fields(LearnerState)} == {
        "window",
        "iteration",
        "rollouts",
        "steps",
        "terminated",
        "policy",
        "explorer",
        "value",
        "embedding_start",
        "reward_start",
        "policy_start",
    }


@pytest.mark.parametrize("method", LEARNERS)
def test_a_learner_that_has_learnt_nothing_can_be_saved(method: str, tmp_path: Path) -> None:
    learner = LEARNERS[method](TaskSpec(3, [-1.0, 0.0], [1.0, 5.0], (2,)), seed=9, window=7)
    learner.save(tmp_path / "fresh")
    again = LEARNERS[method].resume(tmp_path / "fresh")
    assert again.seed == 9 and again.settings.window == 7
    assert again.task.observation_size == 3 and again.task.periodic == (2,)
    assert_same_state(learner.state, again.state)


def test_a_window_without_end_survives_a_checkpoint(tmp_path: Path) -> None:
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]), window=None)
    learner.save(tmp_path / "x")
    assert kreps.KREPS.resume(tmp_path / "x").settings.window is None


@pytest.mark.parametrize(
    "settings", [{"preset": "single_step", "model": "sample"}, {"value": "grid"}]
)
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


def test_files_hold_no_code(good: Good) -> None:
    assert {str(values.dtype) for values in good.tensors.values()} <= {"float64", "int64", "bool"}
    assert set(good.header) == {"kind", "version", "sha256", "task"} | (
        {"policy"} if good.kind == "policy" else {"method", "settings", "seed", "state"}
    )


def test_every_kind_of_policy_is_among_the_files(files: dict[str, Good]) -> None:
    found = {name: file.policy["kind"] for name, file in files.items()}
    assert found == {f"{v} {kind}": of for v, of in KIND_OF_VARIANT.items() for kind in KINDS}
    learnt: dict[str, set[str]] = {method: set() for method in LEARNERS}
    for name, file in files.items():
        learnt[file.method].add(found[name])
    elsewhere = {"relative-softmax"}  # in test_hard_value_iteration.py
    assert learnt == {name: kinds - elsewhere for name, kinds in POLICIES_OF_METHOD.items()}


def test_a_policy_of_few_centres_is_what_was_saved(
    learners: dict[str, Learner[Any]], tmp_path: Path
) -> None:
    few = learners["reps, compressed"].policy
    few.save(tmp_path / "few")
    process = kreps.load_policy(tmp_path / "few").process
    assert isinstance(process, SparseGP)
    for field in fields(SparseGP):
        if field.name in ("task", "kernel"):
            continue
        np.testing.assert_array_equal(
            getattr(process, field.name), getattr(few.process, field.name)
        )
    assert len(process.states) == 12


def test_learning_goes_on_from_a_policy_of_few_centres(
    learners: dict[str, Learner[Any]], tmp_path: Path
) -> None:
    learners["reps, compressed"].save(tmp_path / "x")
    again = kreps.KREPS.resume(tmp_path / "x", gym.make("kreps/SwingUp-v0"))
    assert isinstance(again.policy.process, SparseGP)
    again.learn(1, progress=False)
    assert again.state.iteration == 3 and again.state.policy is not None


# ---- images -----------------------------------------------------------------------------------


def image_task(height: int, width: int) -> TaskSpec:
    pixels = height * width
    return TaskSpec(pixels, [-1.0], [1.0], (), (tuple(range(pixels)),), (height, width))


@pytest.fixture(scope="module")
def watching() -> dict[str, Learner[Any]]:
    """One of each method, which has seen a few images of 100 x 100."""
    rng, task = np.random.default_rng(6), image_task(100, 100)
    rollouts = [
        kreps.Rollout(rng.random((4, 10_000)), rng.normal(size=(3, 1)), rng.normal(size=3))
        for _ in range(2)
    ]
    learners = {method: learner(task) for method, learner in LEARNERS.items()}
    for learner in learners.values():
        learner.update(rollouts)
    return {**learners, "reps, compressed": compressed(learners["reps"], 3)}


@pytest.fixture(scope="module")
def pictures(
    watching: dict[str, Learner[Any]], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Good]:
    return good_files(watching, tmp_path_factory.mktemp("pictures"))


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_task_of_large_images_comes_back_exactly(
    variant: str, watching: dict[str, Learner[Any]], tmp_path: Path
) -> None:
    learner, images = watching[variant], np.random.default_rng(7).random((3, 10_000))
    for file in good_files({variant: learner}, tmp_path).values():
        again = file.load(tmp_path / file.kind)
        process = again.process if file.kind == "policy" else again.state.policy
        assert process.task.image_shape == (100, 100)
        assert process.task.groups == learner.task.groups
        np.testing.assert_array_equal(
            process.act(images, NOISE[:3]), learner.policy.process.act(images, NOISE[:3])
        )
        again.save(tmp_path / "again")
        assert (tmp_path / "again").read_bytes() == file.content


SHAPES: list[Any] = [
    [1, 100_000],
    [100_000, 1],
    [1, 1_000],
    [-100, -100],
    [-1, -10_000],
    [0, 0],
    ["100", "100"],
    [100.0, 100.0],
    [100, None],
    [1e999, 100],
    [[100], [100]],
    [100, 100, 1],
    [10_000],
    [2**70, 2**70],
    [1] * 10_000,
    "ab",
    100,
    {},
    True,
]


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: f"{shape!r:.16}")
def test_forged_shapes_of_images_are_refused(
    shape: Any, pictures: dict[str, Good], tmp_path: Path
) -> None:
    for file in pictures.values():
        header = file.header
        header["task"]["image_shape"] = shape
        message = file.refused_with(tmp_path / "x", header=header)
        assert "image_shape" in message


# ---- writing ----------------------------------------------------------------------------------


def test_saving_leaves_only_the_file(one: Learner[Any], tmp_path: Path) -> None:
    for _ in range(2):  # anew and over an old one
        one.policy.save(tmp_path / "policy")
        one.save(tmp_path / "checkpoint")
        assert names(tmp_path) == ["checkpoint", "policy"]


def test_saving_where_a_folder_stands_is_an_error_that_leaves_nothing_behind(
    one: Learner[Any], tmp_path: Path
) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(StorageError, match="there"):
        one.policy.save(tmp_path / "there")
    assert names(tmp_path) == ["there"]


@pytest.mark.parametrize("where", ["missing/policy", "file/policy", "x" * 300, "", "nul\0byte"])
def test_saving_where_nothing_can_be_written_is_an_error_of_the_library(
    one: Learner[Any], tmp_path: Path, where: str
) -> None:
    (tmp_path / "file").write_text("not a folder")
    path = str(tmp_path / where) if where else where
    for save in (one.policy.save, one.save):
        with pytest.raises(StorageError):
            save(path)
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(
    one: Learner[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    path = tmp_path / "policy"
    path.write_bytes(b"the old content")

    def no_space(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, failing, no_space)
        with pytest.raises(StorageError, match="No space left"):
            one.policy.save(path)
    assert path.read_bytes() == b"the old content"
    assert names(tmp_path) == ["policy"]


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_without_permission_keeps_the_old_file(one: Learner[Any], tmp_path: Path) -> None:
    path = tmp_path / "policy"
    path.write_bytes(b"the old content")
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(StorageError, match="Permission denied"):
            one.policy.save(path)
    finally:
        tmp_path.chmod(0o700)
    assert path.read_bytes() == b"the old content"


def test_a_header_too_large_to_be_read_back_is_refused_when_it_is_written(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"the old content")
    for save in (_policy_of_images(600, 500).save, kreps.KREPS(image_task(600, 500)).save):
        with pytest.raises(StorageError, match="header") as caught:
            save(path)
        assert str(path) in str(caught.value)
        assert path.read_bytes() == b"the old content"
        assert names(tmp_path) == ["x"]


def test_a_header_that_is_just_small_enough_is_read_back(tmp_path: Path) -> None:
    policy = _policy_of_images(512, 512)
    policy.save(tmp_path / "one")
    assert len(json.dumps(parts((tmp_path / "one").read_bytes())[1])) > 0.9 * 2**21
    again = kreps.load_policy(tmp_path / "one")
    assert again.process.task.image_shape == (512, 512)
    again.save(tmp_path / "two")
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def _policy_of_images(height: int, width: int) -> kreps.Policy:
    task = image_task(height, width)
    states, kernel = np.zeros((1, height * width)), Kernel(task.state_factors, np.ones(1))
    actions, bounds = np.zeros((1, 1)), np.zeros(1)
    return kreps.Policy(LipschitzPolicy(task, kernel, states, actions, bounds, 1.0, 0.3, 0.3))


# ---- damaged files ----------------------------------------------------------------------------


def test_a_truncated_file_is_refused_at_every_length(good: Good, tmp_path: Path) -> None:
    content, path = good.content, tmp_path / "cut"
    lengths = {*range(0, 17, 4), *np.linspace(17, len(content) - 1, 30).astype(int).tolist()}
    for length in sorted(lengths):
        path.write_bytes(content[:length])
        good.rejected(path)


def test_an_overlong_file_is_refused(good: Good, tmp_path: Path) -> None:
    path = tmp_path / "long"
    path.write_bytes(good.content + b"\0" * 8)
    good.rejected(path)


def assert_finite(loaded: Any, what: str) -> None:
    for deterministic in (True, False):
        actions, _ = loaded.predict(STATES, deterministic=deterministic)
        assert np.isfinite(actions).all(), what


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
        b'{"kind": "policy", "version": 3}',
        "säuberlich, aber kein Array".encode("utf-16"),
        b"\xff" * 1024,
    ],
    ids=["empty", "short", "zeros", "text", "pickle", "zip", "json", "utf-16", "ones"],
)
def test_foreign_files_are_refused(kind: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "foreign"
    path.write_bytes(content)
    rejected(kind, path)


def test_a_pickle_is_not_executed(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return (os.mkdir, (str(tmp_path / "exploded"),))

    path = tmp_path / "bomb"
    path.write_bytes(pickle.dumps(Bomb()))
    for kind in KINDS:
        rejected(kind, path)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_paths_that_are_no_files_are_refused(kind: str, tmp_path: Path) -> None:
    rejected(kind, tmp_path)
    rejected(kind, tmp_path / "missing")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    rejected(kind, tmp_path / "loop")
    os.mkfifo(tmp_path / "pipe")  # opening it would wait for a writer for ever
    rejected(kind, tmp_path / "pipe")
    rejected(kind, tmp_path / ("x" * 300))


def test_other_safetensors_files_are_refused(good: Good, tmp_path: Path) -> None:
    path = tmp_path / "foreign"
    path.write_bytes(safetensors.numpy.save(good.tensors))
    assert "another program" in good.rejected(path)
    forge(path, good.tensors, good.header, key="other")
    assert "another program" in good.rejected(path)


def test_a_checkpoint_is_no_policy_and_the_other_way_round(good: Good, tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(good.content)
    (other,) = {*KINDS} - {good.kind}
    assert f"it is a kreps {good.kind}" in rejected(other, path, good.method)


def test_a_checkpoint_is_only_for_its_method(checkpoint: Good, tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(checkpoint.content)
    for method in LEARNERS.keys() - {checkpoint.method}:
        assert f"method {checkpoint.method}" in rejected("checkpoint", path, method)
    for method in (None, [], {}, 7, "", checkpoint.method.upper()):
        header = {**checkpoint.header, "method": method}
        assert "method" in checkpoint.refused_with(path, header=header)


@pytest.mark.parametrize("version", [0, 5, -1, "4", None, True, 4.0, 1e300, [4]])
def test_another_version_is_refused_with_its_remedy(
    version: Any, files: dict[str, Good], tmp_path: Path
) -> None:
    for name, file in files.items():
        header = {**file.header, "version": version}
        message = file.refused_with(tmp_path / name, header=header)
        assert "this release reads 1 to 4; read it with the release that wrote it" in message


@pytest.mark.parametrize("version", [1, 2, 3])
def test_a_present_file_that_claims_to_be_old_is_refused(
    version: int, good: Good, tmp_path: Path
) -> None:
    good.refused_with(tmp_path / "x", header={**good.header, "version": version})


def test_one_nan_or_infinity_in_any_array_is_refused(good: Good, tmp_path: Path) -> None:
    tensors = good.tensors
    floats = [name for name, values in tensors.items() if values.dtype == np.float64]
    data = ("points", "actions", "rewards")  # of the window
    for name, value in itertools.product(floats, (np.nan, np.inf, -np.inf, 1.1e100, 1.1e200)):
        if value == 1.1e100 and name not in [f"window.{part}" for part in data]:
            continue
        if tensors[name].size:
            spoilt = {**tensors, name: tensors[name].copy()}
            spoilt[name].flat[-1] = value
            assert name in good.refused_with(tmp_path / "x", spoilt)


def test_every_array_is_needed(good: Good, tmp_path: Path) -> None:
    tensors = good.tensors
    for name in tensors:
        others = {n: v for n, v in tensors.items() if n != name}
        assert f"array {name!r} is missing" in good.refused_with(tmp_path / "x", others)


def test_no_other_array_is_accepted(good: Good, tmp_path: Path) -> None:
    for name in ("x", "policy", "policy.x", "policy.kernel.x", "state", ""):
        message = good.refused_with(tmp_path / "x", {**good.tensors, name: np.zeros(1)})
        assert f"array {name!r} that is of no use" in message


def test_every_array_is_needed_in_its_shape(good: Good, tmp_path: Path) -> None:
    tensors = good.tensors
    for name, values in tensors.items():
        if values.ndim == 0:
            shapes = [np.zeros(1), np.zeros((1, 1)), np.zeros(0)]
        else:
            wide = np.concatenate([values, values], axis=-1)
            shapes = [wide, values[:-1], values[None], values.ravel()[:0], np.zeros(())]
        for wrong in shapes:
            if wrong.shape == values.shape:
                continue
            message = good.refused_with(
                tmp_path / "x", {**tensors, name: wrong.astype(values.dtype)}
            )
            assert any(said in message for said in ("has shape", "are possible", "has wraps"))


def test_every_part_of_the_header_is_needed(good: Good, tmp_path: Path) -> None:
    for path, value in leaves(good.header):
        without = good.header
        owner = without
        for name in path[:-1]:
            owner = owner[name]
        if path[0] in ("task", "settings"):
            continue  # see below
        if path == ("sha256",):
            continue  # `forge` makes it; see tests/test_damage.py
        del owner[path[-1]]
        if path not in {("state", "explorer"), ("state", "terminated")}:  # files of before lack it
            good.refused_with(tmp_path / "x", header=without)
        for wrong in ("x", [], -1, {"x": True}):
            owner[path[-1]] = wrong
            message = good.refused_with(tmp_path / "x", header=without)
            assert message and value is not wrong


def leaves(header: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Everything in a header that is no dictionary, with the names that lead to it."""
    if isinstance(header, dict):
        for name, value in header.items():
            yield from leaves(value, (*path, name))
    else:
        yield path, header


def test_other_number_types_are_refused(good: Good, tmp_path: Path) -> None:
    tensors = good.tensors
    for name, values in tensors.items():
        for dtype in {np.float64, np.float32, np.int64, np.int32, np.bool_} - {values.dtype.type}:
            mixed = {**tensors, name: values.astype(dtype)}
            message = good.refused_with(tmp_path / "x", mixed)
            assert name in message and "is needed" in message


def put(where: int, value: float) -> Callable[[Any], Any]:
    """A change of one number of a vector."""
    return lambda v: np.where(np.arange(len(v)) == where, value, v)


def none_of(*changed: str) -> dict[str, Callable[[Any], Any]]:
    return {f"policy.{name}": lambda v: v[:0] for name in changed}


def to(value: float) -> Callable[[Any], Any]:
    """A change of a single number."""
    return lambda v: np.float64(value)


IMPOSSIBLE: dict[str, dict[str, Callable[[Any], Any]]] = {
    "negative lengthscales": {"policy.kernel.lengthscales": lambda v: -v},
    "no lengthscales": {"policy.kernel.lengthscales": lambda v: 0 * v},
    "tiny lengthscales": {"policy.kernel.lengthscales": lambda v: 1e-320 * v},
    "huge lengthscales": {"policy.kernel.lengthscales": put(0, 1e101)},
    "negative lengthscales of V": {"value.kernel.lengthscales": lambda v: -v},
    "tiny lengthscales of V": {"value.kernel.lengthscales": put(1, 1e-101)},
    "no samples of a process": none_of("states", "targets", "weights"),
    "no centres of a process": none_of("states", "mean_weights", "explained"),
    "explained variance of other centres": {"policy.explained": lambda v: v[:-1, :-1]},
    "a rank of the explained variance": {"policy.explained": lambda v: v[:-1]},
    "no samples of a softmax": none_of("states", "table"),
    "no samples of slopes": none_of("states", "actions", "bounds"),
    "negative weights": {"policy.weights": lambda v: -v},
    "one weight of zero": {"policy.weights": put(0, 0.0)},
    "negative signal": {"policy.signal": lambda v: -v},
    "negative noise of a process": {"policy.noise": lambda v: -v},
    "no noise": {"policy.noise": to(0.0)},
    "no signal": {"policy.signal": to(0.0)},
    "no candidates": {**none_of("candidates"), "policy.table": lambda v: v[:, :0]},
    **{
        f"temperature {t}": {"policy.temperature": to(t)}
        for t in (-1.0, -1e-300, 1e-300, 5e-324, np.nan, np.inf)
    },
    "offset of NaN": {"policy.offset": to(np.nan)},
    "negative slope": {"policy.slope": to(-1e-300)},
    **{
        f"noise fraction {f}": {"policy.noise_fraction": to(f)}
        for f in (-0.1, -1e-300, np.nextafter(1.0, 2.0), 2.0, 1e99, np.nan)
    },
    "negative noise": {"policy.noise_scale": to(-1.0)},
    "no noise scale": {"policy.noise_scale": to(np.nan)},
}


@pytest.mark.parametrize("changes", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_impossible_parameters_are_refused(
    changes: dict[str, Callable[[Any], Any]], files: dict[str, Good], tmp_path: Path
) -> None:
    concerned = {name: file for name, file in files.items() if changes.keys() <= {*file.tensors}}
    assert concerned
    for name, file in concerned.items():
        tensors = file.tensors
        changed = {array: change(tensors[array]) for array, change in changes.items()}
        file.refused_with(tmp_path / name, {**tensors, **changed})


def test_extreme_numbers_are_refused_or_harmless(good: Good, tmp_path: Path) -> None:
    tensors = good.tensors
    arrays = [name for name in tensors if name.startswith("policy.")]
    for name, value in itertools.product(arrays, (1e100, -1e100, 1e-300, -1e-300, 0.0)):
        changed = {**tensors, name: np.full_like(tensors[name], value)}
        try:
            loaded = good.load(forge(tmp_path / "x", changed, good.header))
        except StorageError:
            continue
        assert_finite(loaded, f"{name} = {value}")


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v + 1,
        lambda v: v - 1,
        lambda v: v[::-1],
        lambda v: 0 * v,
        lambda v: np.where(np.arange(len(v)) == 1, 0, v),
        lambda v: np.where(np.arange(len(v)) == 1, v[2], v),
        lambda v: np.where(np.arange(len(v)) == 1, 2**62, v),
        lambda v: np.where(np.arange(len(v)) == 1, -(2**63), v),
        lambda v: np.where(np.arange(len(v)) == len(v) - 1, v[-1] + 1, v),
    ],
)
def test_impossible_offsets_of_rollouts_are_refused(
    change: Callable[[Any], Any], checkpoint: Good, tmp_path: Path
) -> None:
    tensors = checkpoint.tensors
    changed = {**tensors, "window.offsets": change(tensors["window.offsets"]).astype(np.int64)}
    assert "do not increase from 0" in checkpoint.refused_with(tmp_path / "x", changed)


def test_a_window_without_rollouts_but_with_their_arrays_is_refused(
    checkpoint: Good, tmp_path: Path
) -> None:
    tensors = checkpoint.tensors
    tensors["window.offsets"] = np.zeros(1, np.int64)
    tensors["window.terminated"] = np.zeros(0, np.bool_)
    for name in ("points", "actions", "rewards"):
        tensors[f"window.{name}"] = tensors[f"window.{name}"][:0]
    assert "do not increase from 0" in checkpoint.refused_with(tmp_path / "x", tensors)


def test_wraps_of_more_angles_than_the_task_has_are_refused(
    files: dict[str, Good], tmp_path: Path
) -> None:
    file = files["reps checkpoint"]
    tensors = file.tensors
    for name in ("value.kernel.wraps", "value.kernel.lengthscales", "reward_start"):
        tensors[name] = np.append(tensors[name], 1.0)
    assert "wraps of 2 angles" in file.refused_with(tmp_path / "x", tensors)


# ---- hostile headers --------------------------------------------------------------------------


def _task(observation_size: Any = 2, **changes: Any) -> dict[str, Any]:
    task = {
        "observation_size": observation_size,
        "action_low": [-1.0],
        "action_high": [1.0],
        "periodic": [0],
        "groups": [],
        "image_shape": None,
    }
    return {**task, **changes}


def test_the_forgeries_below_start_from_what_can_be_read(good: Good, tmp_path: Path) -> None:
    path = forge(tmp_path / "x", good.tensors, {**good.header, "task": _task()})
    assert_finite(good.load(path), good.kind)


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
        _task(groups=0),
        _task(groups=[0, 1]),
        _task(groups=["ab"]),
        _task(groups=[[0, 1]]),
        _task(groups=[[0], [0]]),
        _task(groups=[[-1]]),
        _task(groups=[[2]]),
        _task(groups=[[0.0]]),
        _task(groups=[[1e999]]),
        _task(groups=[list(range(100_000))]),
        _task(image_shape=[1, 2]),
        _task(image_shape=[1, 1], groups=[[0]]),
        _task(image_shape=[1, 2], groups=[[0, 1]]),
        _task(image_shape=[1, 100_000], groups=[list(range(100_000))]),
    ],
    ids=lambda task: f"{task!r:.120}",
)
def test_forged_tasks_are_refused(task: Any, files: dict[str, Good], tmp_path: Path) -> None:
    for name, file in files.items():
        file.refused_with(tmp_path / name, header={**file.header, "task": task})


ABSENT = object()


@pytest.mark.parametrize(
    ("field", "values", "said"),
    [
        ("kind", [ABSENT], "another program"),
        ("kind", ["", "Policy", None, 7, ["policy"], {}], "it is a kreps"),
        ("version", [ABSENT], "version"),
        ("task", [ABSENT], "task"),
    ],
)
def test_forged_fields_are_refused(
    field: str, values: list[Any], said: str, files: dict[str, Good], tmp_path: Path
) -> None:
    for (name, file), value in itertools.product(files.items(), values):
        header = {**file.header, field: value}
        if value is ABSENT:
            del header[field]
        assert said in file.refused_with(tmp_path / name, header=header)


@pytest.mark.parametrize("kind", [ABSENT, None, 7, [], {}, "", "Softmax", "gp", "x" * 1000])
def test_an_unknown_kind_of_policy_is_refused(
    kind: Any, files: dict[str, Good], tmp_path: Path
) -> None:
    for name, file in files.items():
        header = file.header
        file.policy_of(header)["kind"] = kind
        if kind is ABSENT:
            del file.policy_of(header)["kind"]
        assert "policy" in file.refused_with(tmp_path / name, header=header)


def test_a_policy_of_another_kind_is_refused(good: Good, tmp_path: Path) -> None:
    for kind in {*KIND_OF_VARIANT.values()} - {good.policy["kind"]}:
        header = good.header
        good.policy_of(header)["kind"] = kind
        good.refused_with(tmp_path / "x", header=header)


def test_a_checkpoint_with_a_policy_that_its_method_does_not_learn_is_refused(
    checkpoint: Good, files: dict[str, Good], tmp_path: Path
) -> None:
    own = {n: v for n, v in checkpoint.tensors.items() if not n.startswith("policy.")}
    learnt = POLICIES_OF_METHOD[checkpoint.method]
    others = [v for v in VARIANTS if KIND_OF_VARIANT[v] not in learnt]
    assert len(others) >= 3
    for variant in others:
        lent = files[f"{variant} policy"]
        header = checkpoint.header
        header["state"]["policy"] = lent.policy
        message = checkpoint.refused_with(tmp_path / "x", {**own, **lent.tensors}, header)
        assert "does not learn" in message


@pytest.mark.parametrize(
    "changes",
    [
        {"policy": None},
        {"iteration": 0},
        {"window": None},
        {"value": None},
        {"embedding_start": None},
        {"value": {}},
        {"value": True},
        {"policy": True},
        {"window": True},
        {"window": {}},
        {"iteration": -1},
        {"iteration": 1.0},
        {"iteration": True},
        {"rollouts": [1]},
        {"steps": float("inf")},
    ],
)
def test_forged_states_are_refused(
    changes: dict[str, Any], files: dict[str, Good], tmp_path: Path
) -> None:
    for method in LEARNERS:
        file = files[f"{method} checkpoint"]
        header = file.header
        if header["state"] != {**header["state"], **changes}:
            header["state"] |= changes
            file.refused_with(tmp_path / method, header=header)


def test_arrays_that_the_header_leaves_out_are_refused(checkpoint: Good, tmp_path: Path) -> None:
    header = checkpoint.header
    for name in ("embedding_start", "reward_start", "policy_start", "value", "window"):
        if header["state"][name] is not None:
            changed = {**header, "state": {**header["state"], name: None}}
            checkpoint.refused_with(tmp_path / "x", header=changed)


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
        {"state": None},
        {"state": {}},
        {"state": []},
    ],
)
def test_forged_checkpoints_are_refused(
    changes: dict[str, Any], files: dict[str, Good], tmp_path: Path
) -> None:
    for method in LEARNERS:
        file = files[f"{method} checkpoint"]
        file.refused_with(tmp_path / method, header={**file.header, **changes})


@pytest.mark.parametrize(
    ("method", "name", "values"),
    [
        ("reps", "kl_bound", [0, -1, np.nan, np.inf, "1", None, True]),
        ("reps", "model", ["", None, ["sample"]]),
        ("reps", "value", ["", ["grid"], {"kind": "grid"}]),
        ("reps", "value.max_rank", [0, None, "1", 2.5]),
        ("reps", "model_based.acceptance_rollouts", [1, None, "1", 2.5]),
        ("reps", "low_rank", ["low", 1, {}]),
        ("reps", "imagined", [0, 4]),  # of version 0.1
        ("value-iteration", "temperature", [0, -1, np.nan, "1"]),
        ("value-iteration", "actions", [0, -1, 2.5]),
        ("grid-value-iteration", "temperature", [-1.0, np.nan, "1"]),
        ("grid-value-iteration", "ranges", ["ab", 7, [[1, 0]], [[0, 1, 2]], [[np.nan, 1]]]),
        ("npalp", "noise_fraction", [-0.1, 1.1, np.nan, None]),
        ("npalp", "lipschitz", [0, -1, np.inf]),
        *((method, "window", [0, -1, 1.5, "all", True]) for method in LEARNERS),
    ],
)
def test_forged_settings_are_refused(
    method: str, name: str, values: list[Any], files: dict[str, Good], tmp_path: Path
) -> None:
    file = files[f"{method} checkpoint"]
    for value in values:
        settings = {**file.header["settings"], name: value}
        message = file.refused_with(tmp_path / "x", header={**file.header, "settings": settings})
        assert name in message


@pytest.mark.parametrize(
    "text",
    ["", "null", "7", "[]", '"policy"', "{}", '{"kind": []}', "{" * 10, "nan", "[" * 100_000],
)
def test_forged_headers_are_refused(text: str, files: dict[str, Good], tmp_path: Path) -> None:
    for name, file in files.items():
        file.refused_with(tmp_path / name, header=text)


def test_deeply_nested_json_is_refused(files: dict[str, Good], tmp_path: Path) -> None:
    nested = '{"kind": "policy", "version": 3, "task": ' + '{"a":' * 40_000 + "1" + "}" * 40_001
    files["reps policy"].refused_with(tmp_path / "x", header=nested)
    rejected("policy", raw(tmp_path / "y", b'{"a":' * 30_000 + b"1" + b"}" * 30_000))


@pytest.mark.parametrize("declared", [0, 1, 2**18, 2**31, 2**40, 2**63 - 1, 2**63, 2**64 - 1])
def test_a_wrong_header_length_is_refused_without_an_allocation(
    declared: int, tmp_path: Path
) -> None:
    path = raw(tmp_path / "x", b'{"__metadata__":{}}', declared)
    tracemalloc.start()
    try:
        rejected("policy", path)
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
    metadata = {"kreps": json.dumps({"kind": "policy", "version": 3, "task": _task()})}
    header = json.dumps({"__metadata__": metadata, "policy.weights": entry}).encode()
    rejected("policy", raw(tmp_path / "x", header, body=b"\0" * 8))


def test_a_file_of_three_gibibytes_is_refused_at_once(good: Good, tmp_path: Path) -> None:
    path = tmp_path / "sparse"
    path.write_bytes(good.content)
    os.truncate(path, 3 * 2**30)
    assert "limit" in good.rejected(path)


def test_too_many_support_points_are_refused_at_once(tmp_path: Path) -> None:
    rng, m = np.random.default_rng(0), MAX_SUPPORT + 1
    path = _policy_of_size(tmp_path / "x", rng.normal(size=(m, 2)), 1.0)
    tracemalloc.start()
    started = time.process_time()
    try:
        assert str(MAX_SUPPORT) in rejected("policy", path).replace(",", "").replace("_", "")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert time.process_time() - started < 1.0
    assert peak < 20 * 2**20


def _policy_of_size(path: Path, states: Any, lengthscale: float) -> Path:
    m, ds = states.shape
    tensors = {
        "policy.kernel.lengthscales": np.full(ds, lengthscale),
        "policy.kernel.wraps": np.zeros(0),
        "policy.states": states,
        "policy.targets": np.zeros((m, 1)),
        "policy.weights": np.ones(m),
        "policy.signal": np.array(1.0),
        "policy.noise": np.array(0.1),
    }
    policy = {
        "kind": "cost-sensitive-gp",
        "kernel": {"lengthscales": True, "wraps": True},
        **dict.fromkeys(("states", "targets", "weights", "signal", "noise"), True),
    }
    header = {"kind": "policy", "version": 4, "policy": policy, "task": _task(ds), "sha256": ""}
    return forge(path, tensors, header)


def _sparse_policy(path: Path) -> Path:
    """One array of 1 GiB of zeros that takes no room on disk, and that no policy has."""
    size = 2**30
    metadata = {"kreps": json.dumps({"kind": "policy", "version": 3, "task": _task()})}
    entry = {"dtype": "F64", "shape": [size // 8], "data_offsets": [0, size]}
    header = json.dumps({"__metadata__": metadata, "x": entry}).encode()
    raw(path, header)
    os.truncate(path, 8 + len(header) + size)
    return path


def _in_a_process(code: str, path: Path) -> str:
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "import resource, sys, kreps, kreps.learning.storage\n" + code,
            str(path),
        ],
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
    # ru_maxrss would be that of the process that started this one
    print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""
    if not Path("/proc/self/status").exists():
        pytest.skip("this system does not show the peak of one process")
    kilobytes = int(_in_a_process(code, _sparse_policy(tmp_path / "hostile")))
    assert kilobytes < 400 * 1024  # about 80 MB without the array


# ---- resuming in another environment ----------------------------------------------------------


def test_resuming_in_another_environment_is_refused(checkpoint: Good, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint"
    path.write_bytes(checkpoint.content)
    with pytest.raises(kreps.ConfigurationError, match="give the environment of the checkpoint"):
        LEARNERS[checkpoint.method].resume(path, gym.make("Pendulum-v1"))


def test_what_could_not_be_read_back_is_not_written(learnt: Learner[Any], tmp_path: Path) -> None:
    path = tmp_path / "policy"
    learnt.policy.save(path)
    before = path.read_bytes()
    with pytest.raises(StorageError, match="smaller window"):
        save_policy(learnt.policy.process, path, max_bytes=len(before) - 1)
    assert path.read_bytes() == before
    save_policy(learnt.policy.process, path, max_bytes=len(before))
    assert path.read_bytes() == before
