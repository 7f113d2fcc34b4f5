"""Each format: written by its own library, read back, and damaged; skipped without the library."""

from __future__ import annotations

import gzip
import json
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from recorded import NAMES, assert_same, columns_of, rollouts

import kreps
from kreps.data.rollouts import Rollouts
from kreps.errors import ConfigurationError, DataError, KrepsError, StorageError
from kreps.recordings import formats

Written = tuple[Path, dict[str, Any] | None]
"""The path of a recording, and its columns; None if they have common names."""


# ---- writers ----------------------------------------------------------------------------------


def csv(folder: Path, made: Rollouts) -> Written:
    pd = pytest.importorskip("pandas")
    pd.DataFrame(columns_of(made)).to_csv(folder / "r.csv", index=False)
    return folder / "r.csv", NAMES


def csv_of_a_spreadsheet(folder: Path, made: Rollouts) -> Written:
    """Semicolons, a mark of the byte order, spaces, dates, and compressed."""
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame(columns_of(made))
    frame["t"] = pd.Timestamp("2026-01-01T10:00") + pd.to_timedelta(frame["t"], unit="s")
    frame = frame.rename(columns={"t": "timestamp"})  # a common name
    text = frame.to_csv(index=False, sep=";").replace(";", " ; ")
    with gzip.open(folder / "r.csv.gz", "wt", encoding="utf-8-sig") as file:
        file.write(text)
    return folder / "r.csv.gz", {n: column for n, column in NAMES.items() if n != "time"}


def parquet(folder: Path, made: Rollouts) -> Written:
    pq, pa = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    columns = columns_of(made)
    state = np.column_stack([columns.pop(name) for name in NAMES["observations"]])
    table = pa.table(
        {**columns, "state": pa.array(state.tolist()), "picture": [b"png"] * len(state)}
    )
    pq.write_table(table, folder / "r.parquet", row_group_size=7)
    return folder / "r.parquet", {**NAMES, "observations": "state"}


def hdf5(folder: Path, made: Rollouts) -> Written:
    """The layout of D4RL: flat arrays, with next observations."""
    h5py = pytest.importorskip("h5py")
    data = made.transitions
    cut = np.zeros(len(data), bool)
    cut[made.offsets[1:] - 1] = ~made.terminated
    with h5py.File(folder / "r.hdf5", "w") as file:
        file["observations"], file["actions"], file["rewards"] = (
            data.states,
            data.actions,
            data.rewards,
        )
        file["terminals"], file["timeouts"] = data.terminated, cut
        file["next_observations"] = data.points[data.successor]
    return folder / "r.hdf5", None


def hdf5_of_episodes(folder: Path, made: Rollouts) -> Written:
    """The layout of robomimic: a numbered group per episode, with parts of the observation."""
    h5py = pytest.importorskip("h5py")
    made = Rollouts.from_list([*made, *made, *made, *made])  # demo_10 comes after demo_9
    with h5py.File(folder / "r.h5", "w") as file:
        file["mask/train"] = np.array([b"demo_0"])
        for number, rollout in enumerate(made):
            group = file.create_group(f"data/demo_{number}")
            group["obs/angle"], group["obs/velocity"] = rollout.observations.T
            group["actions"], group["rewards"] = rollout.actions, rollout.rewards
            group["terminated"] = [False] * (len(rollout) - 1) + [rollout.terminated]
            group["t"] = rollout.times
    return folder / "r.h5", {"observations": ["obs/angle", "obs/velocity"], "time": "t"}


def minari(folder: Path, made: Rollouts, data_format: str = "hdf5") -> Written:
    minari = pytest.importorskip("minari")
    buffer = pytest.importorskip("minari.data_collector").EpisodeBuffer
    box = gym.spaces.Box(-9.0, 9.0, (2,), np.float64), gym.spaces.Box(-9.0, 9.0, (1,), np.float64)
    episodes = []
    for number, r in enumerate(made):
        last = np.arange(len(r)) == len(r) - 1
        flags = {"terminations": last & r.terminated, "truncations": last & (not r.terminated)}
        given = {
            "observations": r.observations,
            "actions": r.actions,
            "rewards": r.rewards,
            **flags,
        }
        episodes.append(buffer(id=number, seed=None, options=None, infos={}, **given))
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an author and a link that are not given
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        minari.create_dataset_from_buffers(
            "swing/test-v0",
            buffer=episodes,
            observation_space=box[0],
            action_space=box[1],
            data_format=data_format,
        )
    return folder / "swing/test-v0", None


def minari_of_arrow(folder: Path, made: Rollouts) -> Written:
    pytest.importorskip("pyarrow")
    return minari(folder, made, "arrow")


def lerobot(folder: Path, made: Rollouts, version: str = "v2.1") -> Written:
    """The documented layout; the last frame of an episode repeats the action."""
    pq, pa = pytest.importorskip("pyarrow.parquet"), pytest.importorskip("pyarrow")
    frames = []
    for number, r in enumerate(made):
        assert r.times is not None
        frames.append(
            {
                "observation.state": r.observations.tolist(),
                "action": [*r.actions.tolist(), r.actions[-1].tolist()],
                "next.reward": [*r.rewards, 0.0],
                "next.done": [False] * (len(r) - 1) + [r.terminated] * 2,
                "timestamp": r.times - r.times[0],
                "frame_index": np.arange(len(r) + 1),
                "episode_index": np.full(len(r) + 1, number),
            }
        )
    info = {"codebase_version": version, "total_frames": len(made.points), "fps": 20}
    for name in ("meta", "data/chunk-000"):
        (folder / name).mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps(info))
    tables = [pa.table(frame) for frame in frames]
    if version == "v3.0":
        pq.write_table(pa.concat_tables(tables), folder / "data/chunk-000/file-000.parquet")
    else:
        for number, table in enumerate(tables):
            pq.write_table(table, folder / f"data/chunk-000/episode_{number:06d}.parquet")
    return folder, {"terminated": "next.done"}


def lerobot_3(folder: Path, made: Rollouts) -> Written:
    return lerobot(folder, made, "v3.0")


def ros2(folder: Path, made: Rollouts, plugin: str = "MCAP") -> Written:
    """Joint states at 4 times the rate of the commands, in another order of the joints."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    kinds = {
        "/joints": "sensor_msgs/msg/JointState",
        "/command": "std_msgs/msg/Float64MultiArray",
        "/reward": "std_msgs/msg/Float64",
        "/fell": "std_msgs/msg/Bool",
        "/trial": "std_msgs/msg/Int32",
    }
    make = {name: store.types[kind] for name, kind in kinds.items()}
    time = store.types["builtin_interfaces/msg/Time"]
    header = store.types["std_msgs/msg/Header"](time(7, 5), "base")
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    none = np.zeros(0)
    with rosbag2.Writer(
        folder / "bag", version=9, storage_plugin=rosbag2.StoragePlugin[plugin]
    ) as bag:
        open_ = {n: bag.add_connection(n, k, typestore=store) for n, k in kinds.items()}

        def send(name: str, at: float, *fields: Any) -> None:
            message = store.serialize_cdr(make[name](*fields), kinds[name])
            bag.write(open_[name], 10**18 + round(1e9 * at), message)

        for number, r in enumerate(made):
            assert r.times is not None
            for i, t in enumerate(r.times):
                angle, velocity = r.observations[i]
                send("/trial", t - 0.002, number)
                for early in (0.0, 0.0125, 0.025, 0.0375):  # only the newest is seen at the command
                    seen = np.array([velocity, angle]) + early
                    names = ["wheel", "pole"]
                    send("/joints", t - 0.001 - early, header, names, seen, none, none)
                last = i == len(r)
                send("/command", t, layout, np.array([np.nan if last else r.actions[i, 0]]))
                if not last:
                    send("/reward", t + 0.003, r.rewards[i])
                    send("/fell", t + 0.003, bool(r.terminated and i == len(r) - 1))
    return folder / "bag", {
        "observations": ["/joints.position[1]", "/joints.position[0]"],
        "actions": "/command.data",
        "reward": "/reward.data",
        "terminated": "/fell.data",
        "episode": "/trial.data",
    }


def ros2_of_sqlite3(folder: Path, made: Rollouts) -> Written:
    return ros2(folder, made, "SQLITE3")


def safetensors(folder: Path, made: Rollouts) -> Written:
    kreps.save_rollouts(made, folder / "r.safetensors")
    return folder / "r.safetensors", None


Writer = Callable[[Path, Rollouts], Written]
WRITERS: dict[Writer, str] = {
    csv: "csv",
    csv_of_a_spreadsheet: "csv",
    parquet: "parquet",
    hdf5: "hdf5",
    hdf5_of_episodes: "hdf5",
    minari: "minari",
    minari_of_arrow: "minari",
    lerobot: "lerobot",
    lerobot_3: "lerobot",
    ros2: "ros2",
    ros2_of_sqlite3: "ros2",
    safetensors: "safetensors",
}
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
                kreps.read_rollouts(path, columns)
            except KrepsError as error:
                errors += 1
                truncated += content in (b"", whole[: len(whole) // 2])
                assert str(path) in str(error)
            except kreps.DataWarning:
                pass
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
