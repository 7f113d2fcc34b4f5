"""From rows of a table to rollouts: where they are cut, and what is said of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import NAMES, assert_same, columns_of, rollouts, table_of

import kreps
from kreps.errors import ConfigurationError, DataError, StorageError
from kreps.recordings.columns import Columns
from kreps.recordings.columns import columns_of as as_columns
from kreps.recordings.reading import losses
from kreps.recordings.recording import Recording, recording_of
from kreps.recordings.spec import column_flags, spec_of


def recorded(columns: dict[str, Any], **changes: Any) -> Recording:
    """The recording of columns, with some names changed or left out (None)."""
    names = {name: value for name, value in {**NAMES, **changes}.items() if value is not None}
    return recording_of(table_of(columns), as_columns(names))


def test_rows_become_the_rollouts_that_they_were_written_from() -> None:
    made = rollouts()
    found = recorded(columns_of(made))
    assert_same(found.rollouts, made)
    assert list(losses(found)) == []
    # each point and each step knows its row
    rows = columns_of(made)
    np.testing.assert_array_equal(rows["angle"][found.rows], found.rollouts.points[:, 0])
    np.testing.assert_array_equal(rows["gain"][found.step_rows], found.rollouts.rewards)


def test_without_numbers_of_episodes_they_end_by_flags_and_by_rows_without_an_action() -> None:
    made = rollouts()
    found = recorded(columns_of(made), episode=None)
    assert_same(found.rollouts, made)


def naive(columns: dict[str, Any], numbered: bool) -> list[tuple[list[int], bool]]:
    """Rows of the points of each rollout and its end, row by row."""
    found: list[tuple[list[int], bool]] = []
    count, current = len(columns["t"]), []
    o = np.column_stack([columns["angle"], columns["velocity"], columns["t"]])
    acts = np.isfinite(columns["torque"])

    def same(i: int) -> bool:
        return i + 1 < count and (not numbered or columns["trial"][i] == columns["trial"][i + 1])

    gaps = [columns["t"][i + 1] - columns["t"][i] for i in range(count - 1) if same(i)]
    longest = 1.5 * np.median([gap for gap in gaps if gap > 0.0])
    for i in range(count):
        done, after = bool(columns["fell"][i]), i + 1
        step = same(i) and np.isfinite([*o[i], columns["torque"][i], columns["gain"][i]]).all()
        if step:
            gap = columns["t"][after] - columns["t"][i]
            step = bool(np.isfinite(o[after]).all()) and 0.0 < gap <= longest
        if step and done:
            step = not acts[after] or (numbered and not same(after))
        if step:
            current = current or [i]
            current.append(after)
        following = step and not done
        if current and (not following):
            last = current[-1]
            ended = bool(columns["fell"][last - 1]) or bool(
                columns["fell"][last] and not acts[last]
            )
            found.append((current, ended))
            current = []
    return [(rows, ended) for rows, ended in found if len(rows) > 1]


@pytest.mark.parametrize("numbered", [True, False])
def test_rollouts_of_spoilt_recordings_are_those_of_a_row_by_row_reader(numbered: bool) -> None:
    rng, spoilt = np.random.default_rng(0), 0
    for seed in range(100):
        made = rollouts(tuple(rng.integers(1, 9, 4)), seed)
        columns = columns_of(made)
        for name in ("angle", "torque", "gain"):
            columns[name][rng.random(len(columns[name])) < 0.05] = np.nan
        columns["t"][rng.integers(len(columns["t"])) :] += rng.choice([0.0, 0.06, -0.2])
        if not numbered:  # flags inside an episode contradict its number
            columns["fell"] |= rng.random(len(columns["fell"])) < 0.1
        wanted = naive(columns, numbered)
        spoilt += len(wanted) != len(made)
        found = recorded(columns, episode="trial" if numbered else None).rollouts
        assert [len(r) + 1 for r in found] == [len(rows) for rows, _ in wanted]
        assert found.terminated.tolist() == [ended for _, ended in wanted]
        points = np.concatenate([rows for rows, _ in wanted])
        np.testing.assert_array_equal(found.points[:, 1], columns["velocity"][points])
    assert spoilt > 50


def test_missing_values_gaps_and_time_that_goes_back_are_told_with_their_rows() -> None:
    columns = columns_of(rollouts((30,)))
    columns["velocity"][7] = np.inf
    columns["t"][12:] += 0.05
    columns["t"][20] = columns["t"][19]
    columns["torque"][25] = np.nan
    found = recorded(columns)
    assert list(losses(found)) == [
        "velocity has no finite number in row 7.",
        "torque has no finite number in row 25.",
        "Rows are missing after row 11, row 20, by their time stamps.",
        "Time does not increase after row 19.",
    ]
    assert found.rollouts.lengths.tolist() == [6, 3, 7, 4, 4]


def test_next_observations_make_every_row_a_step() -> None:
    made = rollouts()
    columns = columns_of(made)
    steps = np.flatnonzero(np.isfinite(columns["torque"]))
    rows = {name: values[steps] for name, values in columns.items()}
    rows["next_angle"], rows["next_velocity"] = (
        columns[n][steps + 1] for n in NAMES["observations"]
    )
    following = ["next_angle", "next_velocity"]
    found = recorded(rows, episode=None, next_observations=following, time=None)
    # the truncated rollout is found where the next observation is not that of the next row
    assert_same(found.rollouts, made, times=False)
    # without them the last step of each episode is lost, and of those that terminated that is said
    lost = recorded(rows)
    assert lost.rollouts.lengths.tolist() == [n - 1 for n in made.lengths]
    assert not lost.rollouts.terminated.any()
    (sentence,) = losses(lost)
    assert sentence.startswith("The task terminated in row 5, row 18, but the terminal observation")


def test_a_flag_inside_an_episode_contradicts_its_number() -> None:
    columns = columns_of(rollouts())
    columns["fell"][2] = True
    with pytest.raises(DataError, match=r"row 2: the episode ends by fell, but goes on"):
        recorded(columns)


def test_rewards_may_be_computed_and_columns_be_named_by_their_elements() -> None:
    made = rollouts()
    columns = columns_of(made)
    columns["state"] = np.column_stack([columns["velocity"], columns["angle"]])

    def reward(o: Any, a: Any, after: Any) -> Any:
        return -(after[:, 0] ** 2) - a[:, 0]

    changes = {"observations": ["state[1]", "state[0]"], "reward": None, "reward_function": reward}
    found = recorded(columns, **changes)
    np.testing.assert_array_equal(found.rollouts.points, made.points)
    after = np.concatenate([r.observations[1:, 0] for r in made])
    np.testing.assert_array_equal(found.rollouts.rewards, -(after**2) - made.actions[:, 0])
    assert found.values.labels == ("state[1]", "state[0]")
    with pytest.raises(DataError, match=r"returned an array of shape \(1,\), but 19 finite"):
        recorded(columns, reward=None, reward_function=lambda *_: np.zeros(1))


def test_time_stamps_keep_their_differences_in_every_unit() -> None:
    columns = columns_of(rollouts((9,)))
    exact = columns["t"]
    start = 1_700_000_000_123_456_789  # ns, of which a float64 keeps 256
    columns["t"] = start + np.rint(1e9 * exact).astype(np.int64)
    times = recorded(columns, time_unit="ns").rollouts.times
    np.testing.assert_allclose(times, exact, atol=1e-12)
    columns["t"] = columns["t"].astype("datetime64[ns]")
    times = recorded(columns).rollouts.times
    np.testing.assert_allclose(times, exact, atol=1e-12)


def test_what_is_wrong_with_names_and_values_is_said() -> None:
    columns = columns_of(rollouts())
    with pytest.raises(ConfigurationError, match="no column 'speed'; there are trial, t, angle"):
        recorded(columns, observations=["angle", "speed"])
    with pytest.raises(ConfigurationError, match="no column is named for reward or a reward_func"):
        recorded(columns, reward=None)
    with pytest.raises(ConfigurationError, match="no field 'observation'; choose among observ"):
        as_columns({"observation": ["angle"]})
    with pytest.raises(ConfigurationError, match="time_unit = 'h' is unknown"):
        Columns(time_unit="h")  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match="cannot be imported"):
        as_columns({"reward_function": "no_such_module:reward"})
    columns["angle"] = columns["angle"].astype(object)
    columns["angle"][3] = "n/a"
    with pytest.raises(DataError, match="column angle, row 3: 'n/a' is no number"):
        recorded(columns)
    columns["angle"][3] = None
    assert list(losses(recorded(columns))) == ["angle has no finite number in row 3."]
    columns["fell"] = 2 * columns["fell"].astype(int)
    with pytest.raises(DataError, match="column fell, row 5: 2, but a flag is needed"):
        recorded(columns)
    with pytest.raises(DataError, match="none of the 22 rows is a complete step"):
        recorded({**columns_of(rollouts()), "torque": np.full(22, np.nan)})


def test_a_spec_is_read_from_a_file_and_changed_by_flags(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(
        '[columns]\nobservations = ["angle", "velocity"]\nactions = "torque"\nreward = "gain"\n'
        '[task]\naction_low = [-2.0]\naction_high = [2.0]\nperiodic = ["angle"]\n'
    )
    flags = column_flags([("episode", "trial"), ("observations", "velocity,angle"), ("time", "t")])
    spec = spec_of(path, flags, {"delay": 1})
    recording = recording_of(table_of(columns_of(rollouts())), spec.columns)
    task = spec.task_of(recording)
    assert (task.periodic, task.dt, task.delay, task.observation_size) == ((1,), 0.05, 1, 2)
    with pytest.raises(ConfigurationError, match=r"recorded actions go from \[-2\.\d+\] to \[1"):
        spec_of(None, flags).task_of(recording)
    with pytest.raises(ConfigurationError, match="'height' is no observation coordinate"):
        spec_of(path, task={"periodic": "height"}).task_of(recording)
    with pytest.raises(ConfigurationError, match="no field 'groups'"):
        spec_of(path, task={"groups": []})
    path.write_text("[columns\n")
    with pytest.raises(StorageError, match="as TOML"):
        spec_of(path)


def test_only_a_path_of_a_known_format_is_read(tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="there is no"):
        kreps.read_rollouts(tmp_path / "none.csv")
    (tmp_path / "notes.txt").write_text("a")
    for path in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(StorageError, match="is no recording that can be read: a file"):
            kreps.read_rollouts(path)
    with pytest.raises(ConfigurationError, match="at least one path is needed"):
        kreps.read_rollouts([])
