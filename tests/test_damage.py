"""Damage to files is found by their checksum, and no action that is not finite is handed out."""

from __future__ import annotations

import hashlib
import json
import re
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import safetensors.numpy
from fuzz_files import (
    DAMAGE,
    KINDS,
    damaged_outcomes,
    forged_outcomes,
    header_length,
    old_files,
    originals,
    use,
)

import kreps
from kreps.data.task import TaskSpec
from kreps.errors import KrepsError, NumericalError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.learning.collect import collect
from kreps.learning.storage import write_atomically
from kreps.learning.storage.checksum import sealed

NO_CHECKSUM = "has no checksum, so damage to it would go unnoticed; save it again"


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    return originals()


def load(kind: str, path: Path) -> Any:
    loads = {
        "policy": kreps.load_policy,
        "checkpoint": kreps.KREPS.resume,
        "rollouts": kreps.load_rollouts,
    }
    return loads[kind](path)


def stored_header(content: bytes) -> dict[str, Any]:
    header: dict[str, Any] = json.loads(
        json.loads(content[8 : header_length(content)])["__metadata__"]["kreps"]
    )
    return header


def unsealed(content: bytes, version: int = 3) -> bytes:
    """The file as if of a version without checksums."""
    header = {**stored_header(content), "version": version}
    del header["sha256"]
    tensors = safetensors.numpy.load(content)
    return safetensors.numpy.save(tensors, metadata={"kreps": json.dumps(header)})


# ---- the checksum -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_checksum_is_the_sha256_of_the_file_with_zeros_in_its_place(
    kind: str, files: dict[str, bytes]
) -> None:
    content = files[kind]
    digits = stored_header(content)["sha256"].encode()
    assert len(digits) == 64 and content.count(digits) == 1
    assert hashlib.sha256(content.replace(digits, b"0" * 64)).hexdigest().encode() == digits


@pytest.mark.parametrize("kind", KINDS)
def test_no_bit_of_a_file_can_change_unnoticed(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    content, path = files[kind], tmp_path / "x"
    first = header_length(content)
    places = np.linspace(0, len(content) - 1, 150).astype(int).tolist()
    for place in [*range(8), *places, *range(first - 3, first + 9)]:
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(StorageError):
            load(kind, path)


@pytest.mark.parametrize("kind", KINDS)
def test_damage_to_numbers_is_named_as_what_it_is(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    damaged = bytearray(files[kind])
    damaged[-9] ^= 1
    (tmp_path / "x").write_bytes(damaged)
    with pytest.raises(StorageError, match="do not fit its checksum: it is damaged; take another"):
        load(kind, tmp_path / "x")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("checksum", [None, "", 7, "0" * 64, "f" * 64, "F" * 64, [], "0" * 63])
def test_a_present_file_needs_its_checksum(
    kind: str, checksum: Any, files: dict[str, bytes], tmp_path: Path
) -> None:
    header = {**stored_header(files[kind]), "sha256": checksum}
    tensors = safetensors.numpy.load(files[kind])
    (tmp_path / "x").write_bytes(
        safetensors.numpy.save(tensors, metadata={"kreps": json.dumps(header)})
    )
    with pytest.raises(StorageError, match="checksum"):
        load(kind, tmp_path / "x")


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_without_a_checksum_loads_with_a_note(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    for name, content in (("old", old_files()[kind]), ("unsealed", unsealed(files[kind]))):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.warns(UserWarning, match=f"{name}.*{NO_CHECKSUM}") as caught:
            load(kind, path)
        assert len(caught) == 1
        assert Path(caught[0].filename) == Path(__file__)  # where the user's code calls
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (tmp_path / "new").write_bytes(files[kind])
        load(kind, tmp_path / "new")


def test_a_file_cannot_claim_to_be_older_than_its_checksum(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "x"
    for version in (1, 2, 3):
        claimed = files["policy"].replace(rb"\"version\": 4", rb"\"version\": %d" % version)
        path.write_bytes(claimed)
        with pytest.raises(StorageError, match="do not fit its checksum"):
            kreps.load_policy(path)
        (digits,) = re.findall(rb"[0-9a-f]{64}", claimed)
        path.write_bytes(sealed(claimed.replace(digits, b"0" * 64)))
        with pytest.raises(StorageError, match=f"in format {version}: it is damaged"):
            kreps.load_policy(path)


# ---- folders of rollouts ----------------------------------------------------------------------


def test_a_damaged_file_of_a_folder_is_found_when_it_is_read(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    damaged = bytearray(files["rollouts"])
    damaged[-9] ^= 1
    (tmp_path / "a.safetensors").write_bytes(damaged)
    data = kreps.rollout_folder(tmp_path)
    learner = kreps.KREPS(TaskSpec(2, [-1.0], [1.0]))
    with pytest.raises(StorageError, match="checksum"):
        learner.update(data)
    assert learner.state.iteration == 0


def test_the_size_of_a_data_set_is_that_of_its_arrays(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    forged = files["rollouts"].replace(rb"{\"kind\"", rb"{\"steps\": %d, \"kind\"" % 10**30)
    assert forged != files["rollouts"]
    size = header_length(files["rollouts"]) - 8 + len(forged) - len(files["rollouts"])
    (tmp_path / "a.safetensors").write_bytes(size.to_bytes(8, "little") + forged[8:])
    assert len(kreps.rollout_folder(tmp_path)) == 9 + 4 + 13


def test_old_files_of_a_folder_are_noted_once(files: dict[str, bytes], tmp_path: Path) -> None:
    for name in "abc":
        (tmp_path / f"{name}.safetensors").write_bytes(unsealed(files["rollouts"]))
    (tmp_path / "d.safetensors").write_bytes(files["rollouts"])
    with pytest.warns(UserWarning, match="3 of its 4 files have no checksum") as caught:
        data = kreps.rollout_folder(tmp_path)
        for chunk in data.chunks:
            chunk.load()
    assert len(caught) == 1


@pytest.mark.parametrize("flag", [2, 3, 128, 255])
def test_flags_other_than_0_and_1_are_refused(
    flag: int, files: dict[str, bytes], tmp_path: Path
) -> None:
    content = files["rollouts"]
    entry = json.loads(content[8 : header_length(content)])["rollouts.terminated"]
    first, _ = entry["data_offsets"]
    forged = bytearray(content)
    assert forged[header_length(content) + first] == 1  # the first rollout ended
    forged[header_length(content) + first] = flag
    path = tmp_path / "a.safetensors"
    digits = stored_header(content)["sha256"].encode()
    path.write_bytes(sealed(bytes(forged).replace(digits, b"0" * 64)))
    for read in (
        kreps.load_rollouts,
        lambda path: kreps.rollout_folder(path.parent).chunks[0].load(),
    ):
        with pytest.raises(StorageError, match=r"'rollouts\.terminated' holds flags other than 0"):
            read(path)


# ---- files that are replaced while they are read ----------------------------------------------


def test_a_file_that_is_replaced_meanwhile_is_read_as_old_or_new(
    files: dict[str, bytes], tmp_path: Path
) -> None:
    path, done = tmp_path / "x", threading.Event()
    rollouts = [kreps.Rollout(np.full((3, 1), i), np.zeros((2, 1)), np.zeros(2)) for i in range(2)]
    kreps.save_rollouts(rollouts[0], path)
    contents = [path.read_bytes()]
    kreps.save_rollouts(rollouts[1], path)
    contents.append(path.read_bytes())

    def replace_it() -> None:
        while not done.is_set():
            for content in contents:
                write_atomically(path, content)

    writer = threading.Thread(target=replace_it)
    writer.start()
    try:
        found = {float(kreps.load_rollouts(path)[0].observations[0, 0]) for _ in range(200)}
    finally:
        done.set()
        writer.join()
    assert found <= {0.0, 1.0}


# ---- many damaged files -----------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_no_damaged_file_acts_differently_in_silence_and_none_crashes(
    kind: str, files: dict[str, bytes]
) -> None:
    count = 30 * len(DAMAGE)
    assert damaged_outcomes(kind, files[kind], count) == {"refused": count}


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_without_a_checksum_are_refused_or_noted(kind: str) -> None:
    found = damaged_outcomes(kind, old_files()[kind], 10 * len(DAMAGE))
    assert found.keys() <= {"refused", "as before", "loaded with a note"}
    assert found["refused"] > 30


@pytest.mark.parametrize("kind", KINDS)
def test_forged_files_are_refused_or_act_with_finite_numbers(
    kind: str, files: dict[str, bytes]
) -> None:
    found = forged_outcomes(kind, files[kind], 200)
    assert found.keys() <= {"refused", "loaded"}
    assert min(found.values()) > 20  # both happen, or this would show nothing


@pytest.mark.parametrize("kind", KINDS)
def test_a_good_file_is_used_as_these_tests_use_it(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "x.safetensors"
    path.write_bytes(files[kind])
    assert use(kind, path) == use(kind, path)


# ---- checking a copy --------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_copy_can_be_checked_without_loading_it(
    kind: str, files: dict[str, bytes], tmp_path: Path
) -> None:
    path = tmp_path / "x"
    path.write_bytes(files[kind])
    kreps.check_file(path)
    for damaged in (files[kind][:-1], files[kind] + b"0", files[kind][:100] + files[kind][101:]):
        path.write_bytes(damaged)
        with pytest.raises(StorageError, match=r"cannot rely on .*x: "):
            kreps.check_file(path)


@pytest.mark.parametrize("content", [b"", b"text", b"sha256: unknown", bytes(1000)])
def test_a_file_without_a_checksum_cannot_be_relied_on(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(content)
    with pytest.raises(StorageError, match=r"has no checksum.*save it again"):
        kreps.check_file(tmp_path / "x")


def test_what_is_no_file_cannot_be_relied_on(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "missing", None, "", tmp_path / ("x" * 300)):
        with pytest.raises(StorageError):
            kreps.check_file(path)  # type: ignore[arg-type]


# ---- messages ---------------------------------------------------------------------------------


@pytest.mark.parametrize("field", ["kind", "version"])
def test_escape_sequences_of_a_file_do_not_reach_the_terminal(field: str, tmp_path: Path) -> None:
    header = {"kind": "policy", "version": 4, field: "\x1b[2J\x1b]0;title\x07\n\x9b\u202e"}
    safetensors.numpy.save_file({}, tmp_path / "x", metadata={"kreps": json.dumps(header)})
    with pytest.raises(StorageError) as caught:
        kreps.load_policy(tmp_path / "x")
    assert str(caught.value).isprintable()
    assert r"\x1b[2J" in str(caught.value)


def test_every_error_of_the_library_is_one_line_that_can_be_printed() -> None:
    for error in (KrepsError, StorageError, kreps.DataError, kreps.EnvironmentFailure):
        assert str(error("a\x1b[0m\r\nb\udc80 ± ü")) == r"a\x1b[0m\r\nb\udc80 ± ü"


def test_escape_sequences_of_an_environment_do_not_reach_the_terminal() -> None:
    class Rude(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            raise RuntimeError("\x1b[2Jbroken\n")

    learner = kreps.KREPS(Rude(gym.make("MountainCarContinuous-v0")), initial_rollouts=2)
    with pytest.raises(kreps.EnvironmentFailure) as caught:
        learner.learn(1, progress=False)
    assert str(caught.value).isprintable() and r"\x1b[2Jbroken\n" in str(caught.value)


# ---- actions that are not finite --------------------------------------------------------------


@dataclass(frozen=True)
class Broken:
    """A policy whose numbers are out of range."""

    task: TaskSpec
    value: float

    def greedy(self, states: FloatArray) -> FloatArray:
        return np.full((len(states), self.task.action_size), self.value)

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        return self.greedy(states)


NOT_FINITE = [float("nan"), float("inf"), -float("inf")]


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("deterministic", [True, False])
def test_an_action_that_is_not_finite_is_not_handed_out(value: float, deterministic: bool) -> None:
    policy = kreps.Policy(Broken(TaskSpec(2, [-1.0], [1.0]), value))  # type: ignore[arg-type]
    for observation in (np.zeros(2), np.zeros((3, 2))):
        with pytest.raises(NumericalError, match="is NaN or infinite, so it is not applied"):
            policy.predict(observation, deterministic=deterministic)


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("name", ["kreps/SwingUp-v0", "MountainCarContinuous-v0"])
def test_an_action_that_is_not_finite_does_not_reach_the_environment(
    name: str, value: float
) -> None:
    applied = []

    class Watched(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            applied.append(action)
            return self.env.step(action)

    env = gym.make(name)
    task = kreps.KREPS(env).task
    env = Watched(env) if name.startswith("Mountain") else env  # the other one steps in batches
    with pytest.raises(NumericalError, match="is NaN or infinite, so it is not applied"):
        collect(env, task, Broken(task, value), 2, seed=0, iteration=1, restart_probability=0.1)
    assert applied == []
