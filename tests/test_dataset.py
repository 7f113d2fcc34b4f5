"""Data sets in chunks: the same transitions from memory, from arrays on disk and from files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.data.dataset import ArrayChunk, Dataset
from kreps.data.rollouts import Rollout, Rollouts, Transitions
from kreps.data.task import TaskSpec
from kreps.errors import ConfigurationError, DataError, StorageError
from kreps.kernels.arrays import FloatArray
from kreps.learning.storage import save_policy

TASK = TaskSpec(3, np.array([-1.0, 0.0]), np.array([1.0, 6.0]))
LENGTHS = [4, 1, 7, 2, 2, 9, 1, 5]


def rollout(
    steps: int, seed: int = 0, *, ds: int = 3, da: int = 2, terminated: bool = False
) -> Rollout:
    rng = np.random.default_rng(seed)
    return Rollout(
        rng.normal(size=(steps + 1, ds)),
        rng.normal(size=(steps, da)),
        rng.normal(size=steps),
        terminated,
    )


ROLLOUTS = [rollout(n, seed=i, terminated=i in (1, 3, 5, 7)) for i, n in enumerate(LENGTHS)]


def arrays(rollouts: list[Rollout]) -> dict[str, Any]:
    """The arguments of `Dataset.from_arrays`."""
    return {
        "observations": np.concatenate([r.observations for r in rollouts]),
        "actions": np.concatenate([r.actions for r in rollouts]),
        "rewards": np.concatenate([r.rewards for r in rollouts]),
        "lengths": [len(r) for r in rollouts],
        "terminated": [r.terminated for r in rollouts],
    }


SHORT = 6
"""Samples per chunk, about, which makes three chunks: 4 + 1 + 7, 2 + 2 + 9 and 1 + 5."""


def from_memory(_: Path, chunk_size: int = SHORT) -> Dataset:
    return Dataset.from_rollouts(ROLLOUTS, chunk_size=chunk_size)


def from_arrays(_: Path, chunk_size: int = SHORT) -> Dataset:
    return Dataset.from_arrays(**arrays(ROLLOUTS), chunk_size=chunk_size)


def from_disk(folder: Path) -> Dataset:
    """Memory-mapped arrays."""
    given = arrays(ROLLOUTS)
    for name in ("observations", "actions", "rewards"):
        np.save(folder / f"{name}.npy", given[name])
        given[name] = np.load(folder / f"{name}.npy", mmap_mode="r")
    return Dataset.from_arrays(**given, chunk_size=SHORT)


def from_files(folder: Path) -> Dataset:
    """Three files, ordered by their names and not by when they were written."""
    for name, part in [("2", ROLLOUTS[6:]), ("0", ROLLOUTS[:3]), ("1", ROLLOUTS[3:6])]:
        kreps.save_rollouts(part, folder / f"part{name}.safetensors")
    return kreps.rollout_folder(folder)


FORMS = [from_memory, from_arrays, from_disk, from_files]
Form = Callable[[Path], Dataset]


def assert_same(found: Transitions, wanted: Transitions) -> None:
    for field in fields(Transitions):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(wanted, field.name))


# ---- chunks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_every_form_holds_the_same_transitions(form: Form, tmp_path: Path) -> None:
    found = form(tmp_path)
    assert len(found.chunks) == 3
    assert len(found) == sum(LENGTHS) == 31
    parts = [chunk.load().transitions for chunk in found.chunks]
    assert [len(part) for part in parts] == [chunk.steps for chunk in found.chunks] == [12, 13, 6]
    assert_same(Transitions.concat(parts), Transitions.from_rollouts(ROLLOUTS))


@pytest.mark.parametrize("form", [from_memory, from_arrays])
@pytest.mark.parametrize(
    ("size", "steps"),
    [
        (1, LENGTHS),
        (3, [4, 8, 4, 9, 6]),
        (6, [12, 13, 6]),
        (10, [12, 13, 6]),
        (12, [12, 13, 6]),
        (13, [14, 17]),
        (31, [31]),
        (1000, [31]),
    ],
)
def test_a_chunk_ends_with_the_rollout_that_fills_its_size(
    form: Any, size: int, steps: list[int], tmp_path: Path
) -> None:
    assert [chunk.steps for chunk in form(tmp_path, size).chunks] == steps


def test_a_small_set_is_one_chunk_by_default() -> None:
    assert len(Dataset.from_rollouts(ROLLOUTS).chunks) == 1
    assert len(Dataset.from_arrays(**arrays(ROLLOUTS)).chunks) == 1


def test_a_chunk_has_8192_samples_or_more_by_default() -> None:
    many = [rollout(2048, seed=i) for i in range(9)]
    assert [chunk.steps for chunk in Dataset.from_rollouts(many).chunks] == [8192, 8192, 2048]


@pytest.mark.parametrize("size", [0, -1])
def test_a_chunk_size_below_one_raises(size: int) -> None:
    with pytest.raises(ConfigurationError, match="chunk_size"):
        Dataset.from_rollouts(ROLLOUTS, chunk_size=size)


def test_chunks_in_memory_are_slices_of_one_container() -> None:
    flat = Rollouts.from_list(ROLLOUTS)
    for chunk in Dataset.from_rollouts(flat, chunk_size=SHORT).chunks:
        assert isinstance(chunk, Rollouts)
        assert np.shares_memory(chunk.points, flat.points)


def test_rollouts_may_come_from_a_generator() -> None:
    found = Dataset.from_rollouts(rollout(3, seed=i) for i in range(4))
    assert_same(
        found.chunks[0].load().transitions,
        Transitions.from_rollouts([rollout(3, seed=i) for i in range(4)]),
    )


def test_without_flags_no_rollout_is_terminated() -> None:
    given = arrays(ROLLOUTS) | {"terminated": None}
    assert not Dataset.from_arrays(**given).chunks[0].load().terminated.any()


def test_arrays_of_other_number_types_become_floats() -> None:
    given = arrays(ROLLOUTS)
    given["observations"] = given["observations"].astype(np.float32)
    given["actions"] = np.round(given["actions"]).astype(np.int8)
    found = Dataset.from_arrays(**given).chunks[0].load()
    for values in (found.points, found.actions, found.rewards):
        assert values.dtype == np.float64
    np.testing.assert_array_equal(found.points, given["observations"])
    np.testing.assert_array_equal(found.actions, given["actions"])


def test_memory_maps_are_read_by_load_only_and_not_written(tmp_path: Path) -> None:
    found = from_disk(tmp_path)
    chunk = found.chunks[0]
    assert isinstance(chunk, ArrayChunk)
    assert isinstance(chunk.unread.points, np.memmap)
    data = chunk.load()
    assert not isinstance(data.points, np.memmap)
    with pytest.raises(ValueError, match="read-only"):
        data.points[:] = 0.0
    assert_same(chunk.load().transitions, Transitions.from_rollouts(ROLLOUTS[:3]))


def test_values_are_split_as_the_samples_are() -> None:
    found = Dataset.from_rollouts(ROLLOUTS, chunk_size=SHORT)
    np.testing.assert_array_equal(found.offsets, [0, 12, 25, 31])
    parts = found.split(np.arange(31.0))
    assert [len(part) for part in parts] == [12, 13, 6]
    np.testing.assert_array_equal(np.concatenate(parts), np.arange(31.0))


# ---- subsets of the samples --------------------------------------------------------------------


def rollouts_of(rows: list[int]) -> list[int]:
    """Numbers of the rollouts that contain these samples."""
    return sorted({int(np.searchsorted(np.cumsum(LENGTHS), row, side="right")) for row in rows})


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    "rows",
    [[0], [11, 12], [4, 13, 30], [12], [30], [0, 4, 11, 12, 14, 15, 24, 25, 30], [*range(31)]],
    ids=str,
)
def test_samples_are_taken_from_their_chunks(rows: list[int], form: Form, tmp_path: Path) -> None:
    found = form(tmp_path).take(np.array(rows))
    whole = Transitions.from_rollouts(ROLLOUTS)
    np.testing.assert_array_equal(found.states, whole.states[rows])
    np.testing.assert_array_equal(
        found.points[found.successor], whole.points[whole.successor[rows]]
    )
    np.testing.assert_array_equal(found.actions, whole.actions[rows])
    np.testing.assert_array_equal(found.rewards, whole.rewards[rows])
    np.testing.assert_array_equal(found.terminated, whole.terminated[rows])
    starts = [ROLLOUTS[i].observations[0] for i in rollouts_of(rows)]
    np.testing.assert_array_equal(found.points[found.start], starts)


def test_all_samples_are_taken_unchanged() -> None:
    assert_same(
        Dataset.from_rollouts(ROLLOUTS, chunk_size=SHORT).take(np.arange(31)),
        Transitions.from_rollouts(ROLLOUTS),
    )


# ---- files ------------------------------------------------------------------------------------


def test_rollouts_come_back_from_a_file_exactly(tmp_path: Path) -> None:
    path = tmp_path / "rollouts.safetensors"
    kreps.save_rollouts(ROLLOUTS, path)
    found = kreps.load_rollouts(path)
    assert len(found) == len(ROLLOUTS)
    for mine, theirs in zip(found, ROLLOUTS, strict=True):
        for name in ("observations", "actions", "rewards"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
        assert mine.terminated is theirs.terminated


def test_no_rollout_or_mixed_widths_are_not_written(tmp_path: Path) -> None:
    for rollouts in ([], [rollout(3), rollout(3, ds=2)], [rollout(3), rollout(3, da=1)]):
        with pytest.raises(DataError):
            kreps.save_rollouts(rollouts, tmp_path / "a.safetensors")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("now", [ROLLOUTS[:2], ROLLOUTS])
def test_a_file_that_has_changed_since_the_folder_was_opened_raises(
    now: list[Rollout], tmp_path: Path
) -> None:
    path = tmp_path / "a.safetensors"
    kreps.save_rollouts(ROLLOUTS[:3], path)
    found = kreps.rollout_folder(tmp_path)
    kreps.save_rollouts(now, path)
    with pytest.raises(StorageError, match="open it again"):
        found.chunks[0].load()
    path.unlink()
    with pytest.raises(StorageError):
        found.chunks[0].load()


def test_a_folder_is_opened_without_reading_its_arrays(tmp_path: Path) -> None:
    kreps.save_rollouts(ROLLOUTS, tmp_path / "a.safetensors")
    content = bytearray((tmp_path / "a.safetensors").read_bytes())
    begin = 8 + int.from_bytes(content[:8], "little")  # of the arrays, after the header
    content[begin:] = b"\xff" * (len(content) - begin)  # NaN in every number
    (tmp_path / "a.safetensors").write_bytes(content)
    found = kreps.rollout_folder(tmp_path)
    assert len(found) == 31
    with pytest.raises(StorageError):
        found.chunks[0].load()


@pytest.mark.parametrize("content", [b"", b"not this", "policy"])
def test_a_foreign_file_in_the_folder_raises_at_once(content: bytes | str, tmp_path: Path) -> None:
    kreps.save_rollouts(ROLLOUTS, tmp_path / "a.safetensors")
    if isinstance(content, bytes):
        (tmp_path / "b.safetensors").write_bytes(content)
    else:
        learner = kreps.KREPS(TASK)
        learner.update(ROLLOUTS)
        save_policy(learner.policy.process, tmp_path / "b.safetensors")
    with pytest.raises(StorageError, match=r"b\.safetensors"):
        kreps.rollout_folder(tmp_path)


def test_files_with_other_extensions_are_ignored(tmp_path: Path) -> None:
    kreps.save_rollouts(ROLLOUTS, tmp_path / "a.safetensors")
    (tmp_path / "notes.txt").write_text("of the experiment")
    assert len(kreps.rollout_folder(tmp_path)) == 31


def test_a_folder_without_rollouts_or_no_folder_raises(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "file", tmp_path / "missing"):
        with pytest.raises(StorageError):
            kreps.rollout_folder(path)


# ---- invalid data -----------------------------------------------------------------------------


def test_no_rollout_at_all_raises() -> None:
    with pytest.raises(DataError, match="at least one"):
        Dataset.from_rollouts([])
    with pytest.raises(DataError, match="at least one"):
        Dataset.from_arrays(np.empty((0, 3)), np.empty((0, 2)), np.empty(0), [])


@pytest.mark.parametrize(
    "changes",
    [
        {"lengths": LENGTHS[:-1]},
        {"lengths": [*LENGTHS[:-1], 6]},
        {"lengths": [*LENGTHS, 0]},
        {"lengths": [*LENGTHS[:-2], 7, -1]},
        {"lengths": [*LENGTHS[:-1], 5.5]},
        {"lengths": [*LENGTHS[:-1], np.nan]},
        {"lengths": [*LENGTHS[:-1], 1e18]},
        {"lengths": np.array([LENGTHS])},
        {"terminated": [False] * 7},
        {"observations": np.zeros((38, 3))},
        {"observations": np.zeros((40, 3))},
        {"observations": np.zeros(39)},
        {"actions": np.zeros((30, 2))},
        {"actions": np.zeros(30)},
        {"rewards": np.zeros(32)},
        {"rewards": np.zeros((31, 1))},
    ],
    ids=lambda changes: "-".join(changes),
)
def test_sizes_that_do_not_fit_together_raise(changes: dict[str, Any]) -> None:
    assert len(Dataset.from_arrays(**arrays(ROLLOUTS))) == 31
    with pytest.raises(DataError, match="do not fit together"):
        Dataset.from_arrays(**(arrays(ROLLOUTS) | changes))


def rejected(found: Dataset, reason: str) -> None:
    """A learner raises `DataError` and is left unchanged."""
    learner = kreps.KREPS(TASK)
    with pytest.raises(DataError, match=reason):
        learner.update(found)
    assert learner.state.iteration == 0
    assert learner.state.policy is None


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
@pytest.mark.parametrize("name", ["observations", "actions", "rewards"])
def test_invalid_numbers_raise_and_are_named(name: str, bad: float) -> None:
    given = arrays(ROLLOUTS)
    given[name][-1] = bad
    rejected(Dataset.from_arrays(**given), name)


@pytest.mark.parametrize(("ds", "da"), [(2, 2), (4, 2), (3, 1), (3, 3)])
@pytest.mark.parametrize("form", ["memory", "arrays", "files"])
def test_a_set_of_other_widths_than_the_task_raises(
    form: str, ds: int, da: int, tmp_path: Path
) -> None:
    strangers = [rollout(5, seed=i, ds=ds, da=da) for i in range(3)]
    reason = f"{ds} observation and {da} action coordinates"
    if form == "files":
        kreps.save_rollouts(ROLLOUTS, tmp_path / "a.safetensors")
        kreps.save_rollouts(strangers, tmp_path / "b.safetensors")
        rejected(kreps.rollout_folder(tmp_path), reason)
    elif form == "arrays":
        rejected(Dataset.from_arrays(**arrays(strangers)), reason)
    else:
        rejected(Dataset.from_rollouts(strangers), reason)


@pytest.mark.parametrize(("ds", "da"), [(2, 2), (3, 1)])
def test_rollouts_of_different_widths_raise(ds: int, da: int) -> None:
    with pytest.raises(DataError):
        Dataset.from_rollouts([*ROLLOUTS, rollout(4, ds=ds, da=da)])


def test_an_item_that_is_no_rollout_is_named_by_its_number() -> None:
    with pytest.raises(DataError, match="item 1 is a str"):
        Dataset.from_rollouts([ROLLOUTS[0], "rollout"])  # type: ignore[list-item]


def test_an_exact_update_from_a_set_raises_with_the_remedy() -> None:
    learner = kreps.KREPS(TASK, low_rank=None)
    with pytest.raises(ConfigurationError, match=r"low_rank=kreps\.LowRank\(\)"):
        learner.update(Dataset.from_rollouts(ROLLOUTS))
    assert learner.state.iteration == 0


def test_methods_that_need_all_samples_in_memory_do_not_take_a_set() -> None:
    for learner in (kreps.ValueIteration(TASK), kreps.NPALP(TASK)):
        with pytest.raises(DataError, match="use KREPS for data sets"):
            learner.update(Dataset.from_rollouts(ROLLOUTS))  # type: ignore[arg-type]


def values(found: Dataset) -> FloatArray:
    return np.concatenate([chunk.load().rewards for chunk in found.chunks])


def test_lengths_may_be_of_any_whole_number_type() -> None:
    given = arrays(ROLLOUTS)
    for kind in (np.int32, np.uint8, np.int64):
        found = Dataset.from_arrays(**(given | {"lengths": np.array(LENGTHS, kind)}))
        np.testing.assert_array_equal(values(found), given["rewards"])
