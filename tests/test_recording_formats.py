"""Each format: written by its own library, read back, and damaged; skipped without the library."""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import assert_same, rollouts
from recorded_files import (
    WRITERS,
    Writer,
    csv,
    hdf5,
    hdf5_of_episodes,
    lerobot,
    lerobot_3,
    minari,
    minari_of_arrow,
    ros2,
)

import kreps
from kreps.data.rollouts import Rollouts
from kreps.errors import ConfigurationError, DataError, KrepsError, StorageError
from kreps.recordings import formats

each_writer = pytest.mark.parametrize("write", WRITERS, ids=lambda write: write.__name__)


# ---- round trips ------------------------------------------------------------------------------


@each_writer
def test_what_was_written_is_read(write: Writer, tmp_path: Path) -> None:
    made = rollouts()
    path, columns = write(tmp_path, made)
    assert formats.format_of(path) == WRITERS[write]
    found = kreps.read_rollouts(path, columns)
    if write is hdf5_of_episodes:
        made = Rollouts.from_list([*made, *made, *made, *made])
        assert_same(found, made, times=False)
        return
    assert_same(found, made, times=write not in (hdf5, minari, minari_of_arrow, lerobot, lerobot_3))
    if WRITERS[write] == "lerobot":  # its time begins anew in each episode
        assert found.times is not None and [r.times[0] for r in found] == [0.0, 0.0, 0.0]


def test_a_dataset_of_lerobot_itself_is_read(tmp_path: Path) -> None:
    datasets = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    made = rollouts()
    kind = {"dtype": "float32", "names": None}
    dataset = datasets.LeRobotDataset.create(
        "kreps/test",
        fps=20,
        root=tmp_path / "set",
        features={
            "observation.state": {**kind, "shape": (2,)},
            "action": {**kind, "shape": (1,)},
            "next.reward": {**kind, "shape": (1,)},
        },
        use_videos=False,
    )
    for r in made:
        for i, o in enumerate(r.observations):
            step = min(i, len(r) - 1)
            dataset.add_frame(
                {
                    "observation.state": o.astype(np.float32),
                    "action": r.actions[step].astype(np.float32),
                    "next.reward": r.rewards[[step]].astype(np.float32),
                    "task": "swing",
                }
            )
        dataset.save_episode()
    getattr(dataset, "finalize", lambda: None)()
    found = kreps.read_rollouts(tmp_path / "set")
    np.testing.assert_array_equal(found.points, made.points.astype(np.float32))
    np.testing.assert_array_equal(found.rewards, made.rewards.astype(np.float32))
    assert found.offsets.tolist() == made.offsets.tolist()


def test_several_files_are_read_in_order_and_do_not_continue_each_other(tmp_path: Path) -> None:
    made = rollouts()
    paths = []
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        path, columns = csv(folder, made[number : number + 1])
        paths.append(path)
    assert columns is not None
    found = kreps.read_rollouts(paths, {**columns, "episode": None})
    assert_same(found, made[:2], times=False)


# ---- what is damaged --------------------------------------------------------------------------


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())


@each_writer
def test_a_damaged_file_is_an_error_that_names_it_or_is_read(write: Writer, tmp_path: Path) -> None:
    path, columns = write(tmp_path, rollouts())
    rng, errors, truncated = np.random.default_rng(0), 0, 0
    for file in files_of(path)[:3]:
        whole = file.read_bytes()
        flipped = bytearray(whole)
        for position in rng.integers(len(whole), size=20):
            flipped[position] ^= 0xFF
        for content in (b"", whole[: len(whole) // 2], whole[:-9], bytes(flipped), rng.bytes(99)):
            file.write_bytes(content)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of rows that are left out
                    kreps.read_rollouts(path, columns)
            except KrepsError as error:
                errors += 1
                truncated += content in (b"", whole[: len(whole) // 2])
                assert str(path) in str(error)
        file.write_bytes(whole)
    assert errors >= 2 and truncated >= 1


@pytest.mark.parametrize("write", list(WRITERS)[:-1], ids=lambda write: write.__name__)
def test_a_missing_library_is_an_error_that_says_how_to_get_it(
    write: Writer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, columns = write(tmp_path, rollouts((3,)))
    name = WRITERS[write]
    libraries = {"csv": "pandas", "hdf5": "h5py", "ros2": "rosbags", "minari": "minari"}
    library = libraries.get(name, "pyarrow")
    loaded = [m for m in sys.modules if m.split(".")[0] == library or m.startswith(FORMATS)]
    for module in loaded:
        monkeypatch.delitem(sys.modules, module)
        if module.startswith(FORMATS):
            monkeypatch.delattr(formats, module.removeprefix(FORMATS))
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(
        ConfigurationError, match=rf"needs {library}.*pip install 'kreps\[{name}\]'"
    ):
        kreps.read_rollouts(path, columns)


FORMATS = "kreps.recordings.formats."


def changed(path: Path, columns: dict[str, Any], **changes: Any) -> Rollouts:
    return kreps.read_rollouts(path, {**columns, **changes})


def test_rows_of_text_files_have_as_many_values_as_there_are_columns(tmp_path: Path) -> None:
    path, columns = csv(tmp_path, rollouts())
    lines = path.read_text().splitlines()
    for wrong in (lines[3] + ",1.0", lines[3].replace("0,", "0,n/a", 1)):
        path.write_text("\n".join([*lines[:3], wrong, *lines[4:]]))
        with pytest.raises(KrepsError):
            kreps.read_rollouts(path, columns)
    path.write_text("\n".join([*lines[:5], lines[5].rsplit(",", 4)[0]]))  # cut while writing
    with pytest.warns(kreps.DataWarning, match=r"velocity has no finite number in row 4"):
        found = kreps.read_rollouts(path, columns)
    assert found.lengths.tolist() == [3]
    path.write_text(lines[0])
    with pytest.raises(StorageError, match="has no row"):
        kreps.read_rollouts(path, columns)


def test_lists_and_arrays_of_other_lengths_are_told(tmp_path: Path) -> None:
    pq, pa = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    columns = {"observations": "o", "actions": "a", "reward": "r"}
    table = pa.table({"o": [[1.0, 2.0], [3.0]], "a": [0.0, 0.0], "r": [0.0, 0.0]})
    pq.write_table(table, tmp_path / "r.parquet")
    with pytest.raises(DataError, match="column o, row 1: a list of another length"):
        kreps.read_rollouts(tmp_path / "r.parquet", columns)
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["o"], file["a"], file["r"] = np.zeros((5, 2)), np.zeros((3, 1)), np.zeros(5)
    with pytest.raises(DataError, match=r"column a of r.h5 has 3 rows and another one 5"):
        kreps.read_rollouts(tmp_path / "r.h5", columns)


def test_numbered_groups_that_are_no_episodes_are_named_by_their_whole_paths(
    tmp_path: Path,
) -> None:
    h5py = pytest.importorskip("h5py")
    (made,) = rollouts((5,))
    with h5py.File(tmp_path / "r.h5", "w") as file:
        for number, position in enumerate(made.observations.T):
            file[f"joint{number}/position"] = position
        file["actions"], file["rewards"] = made.actions, made.rewards
    columns = {"observations": ["joint0/position", "joint1/position"]}
    found = kreps.read_rollouts(tmp_path / "r.h5", columns)
    np.testing.assert_array_equal(found.points, made.observations)


def test_a_dataset_of_lerobot_must_be_whole_and_of_a_known_version(tmp_path: Path) -> None:
    path, columns = lerobot(tmp_path, rollouts())
    info = path / "meta/info.json"
    (path / "data/chunk-000/episode_000001.parquet").unlink()
    with pytest.raises(StorageError, match=r"has 17 frames, but meta/info.json says 22"):
        kreps.read_rollouts(path, columns)
    info.write_text(info.read_text().replace("v2.1", "v1.6"))
    with pytest.raises(StorageError, match=r"LeRobot's version v1.6"):
        kreps.read_rollouts(path, columns)


def test_topics_of_a_bag_are_named_where_one_is_missing_or_late(tmp_path: Path) -> None:
    path, columns = ros2(tmp_path, rollouts())
    assert columns is not None
    with pytest.raises(ConfigurationError, match=r"clock = '/tick' has no message; choose one of"):
        changed(path, columns, clock="/tick")
    with pytest.raises(ConfigurationError, match=r"no column '/cmd.data'; there are time, "):
        changed(path, columns, actions="/cmd.data", clock="/command")
    with pytest.raises(ConfigurationError, match="none of its topics is named; they are /command"):
        kreps.read_rollouts(path, {"observations": "joints"})
    # with the joints as the clock a step is 12.5 ms long, and commands and rewards are held
    without_ends = {name: value for name, value in columns.items() if name != "terminated"}
    with pytest.warns(kreps.DataWarning, match="command.data has no finite number in row 3, "):
        held = changed(path, without_ends, clock="/joints")
    assert held.times is not None
    assert np.median(np.diff(held.times)) == pytest.approx(0.0125)


def test_every_format_is_an_extra_of_the_package() -> None:
    import tomllib

    root = Path(__file__).resolve().parents[1]
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for name in set(WRITERS.values()):
        assert name in extras or name == "safetensors"
        assert (root / f"src/kreps/recordings/formats/{name}.py").exists()
    assert import_module("kreps").read_rollouts is kreps.read_rollouts
