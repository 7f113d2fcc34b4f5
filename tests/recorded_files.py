"""Writers of recordings, each by the format's own library; without it the test is skipped."""

from __future__ import annotations

import gzip
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from recorded import NAMES, columns_of

import kreps
from kreps.data.rollouts import Rollouts

Written = tuple[Path, dict[str, Any] | None]
"""The path of a recording, and its columns; None if they have common names."""


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
