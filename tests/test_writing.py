"""Writing files: as a whole, by several at once, through links, and only where files can be."""

from __future__ import annotations

import os
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import kreps
from kreps.errors import StorageError
from kreps.learning.storage import write_atomically

PATHS = [None, 5, 1.5, b"bytes", ["a"], object(), True]


def rollouts(count: int) -> list[kreps.Rollout]:
    return [kreps.Rollout(np.zeros((3, 1)), np.zeros((2, 1)), np.zeros(2))] * count


@pytest.fixture
def learner() -> kreps.KREPS:
    learner = kreps.KREPS(kreps.TaskSpec(1, [-1.0], [1.0]), preset="single_step")
    rng = np.random.default_rng(0)
    learner.update(
        kreps.Rollout(rng.normal(size=(9, 1)), rng.normal(size=(8, 1)), rng.normal(size=8))
        for _ in range(3)
    )
    return learner


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# ---- several writers and readers --------------------------------------------------------------


def test_of_several_writers_at_once_each_leaves_a_whole_file(tmp_path: Path) -> None:
    path, errors = tmp_path / "x", []
    contents = [bytes([number]) * 20_000 for number in range(4)]
    write_atomically(path, contents[0])

    def work(act: Callable[[], Any]) -> None:
        try:
            for _ in range(40):
                act()
        except Exception as error:  # for the assertion below
            errors.append(error)

    def read() -> None:
        assert path.read_bytes() in contents

    acts = [*(lambda c=c: write_atomically(path, c) for c in contents), read, read]
    threads = [threading.Thread(target=work, args=[act]) for act in acts]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert names(tmp_path) == ["x"]


def test_an_interrupted_write_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_atomically(tmp_path / "x", b"old")

    def interrupt(_: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", interrupt)
        with pytest.raises(KeyboardInterrupt):
            write_atomically(tmp_path / "x", b"new")
    assert (tmp_path / "x").read_bytes() == b"old"
    assert names(tmp_path) == ["x"]


def test_the_longest_possible_name_can_be_written(tmp_path: Path) -> None:
    for name in ("n" * 255, "ü" * 127):
        write_atomically(tmp_path / name, b"content")
        assert (tmp_path / name).read_bytes() == b"content"


# ---- links and modes --------------------------------------------------------------------------


def test_saving_to_a_link_replaces_what_it_points_to(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    real, link = tmp_path / "store" / "real", tmp_path / "latest"
    kreps.save_rollouts(rollouts(1), real)
    link.symlink_to("store/real")
    kreps.save_rollouts(rollouts(2), link)
    assert link.is_symlink() and link.readlink() == Path("store/real")
    assert len(kreps.load_rollouts(real)) == 2
    assert names(tmp_path) == ["latest", "store"] and names(tmp_path / "store") == ["real"]


def test_saving_to_a_link_that_points_nowhere_makes_the_file(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "new")
    kreps.save_rollouts(rollouts(1), tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert len(kreps.load_rollouts(tmp_path / "new")) == 1


def test_saving_to_a_link_in_a_circle_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(StorageError, match="cannot write"):
        kreps.save_rollouts(rollouts(1), tmp_path / "a")
    assert names(tmp_path) == ["a", "b"]


@pytest.mark.parametrize("mode", [0o600, 0o664, 0o640])
def test_a_file_keeps_its_mode(mode: int, tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"old")
    path.chmod(mode)
    kreps.save_rollouts(rollouts(1), path)
    assert stat.S_IMODE(path.stat().st_mode) == mode


def test_a_new_file_has_the_mode_of_any_other_new_file(tmp_path: Path) -> None:
    kreps.save_rollouts(rollouts(1), tmp_path / "x")
    (tmp_path / "other").write_bytes(b"")
    assert (tmp_path / "x").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_a_read_only_file_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "x"
    path.write_bytes(b"old")
    path.chmod(0o444)
    with pytest.raises(StorageError, match="read-only; make it writable, or choose another name"):
        kreps.save_rollouts(rollouts(1), path)
    assert path.read_bytes() == b"old" and names(tmp_path) == ["x"]


# ---- what is no regular file ------------------------------------------------------------------


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(path))


@pytest.mark.parametrize(
    ("make", "kind"),
    [(os.mkfifo, "a pipe"), (make_socket, "a socket"), (os.mkdir, "a folder")],
)
@pytest.mark.parametrize("linked", [False, True])
def test_what_is_no_regular_file_is_refused_and_stays(
    make: Callable[[Path], None],
    kind: str,
    linked: bool,
    learner: kreps.KREPS,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)  # the path of a socket must be short
    path = Path("special")
    make(path)
    before = path.stat()
    if linked:
        path = Path("link")
        path.symlink_to("special")
    for save in (
        lambda: kreps.save_rollouts(rollouts(1), path),
        lambda: learner.policy.save(path),
        lambda: learner.policy.export_onnx(path),
        lambda: learner.save(path),
    ):
        with pytest.raises(StorageError, match=f"it is {kind}; give the name of a file"):
            save()
    after = Path("special").stat()
    assert (after.st_ino, after.st_mode) == (before.st_ino, before.st_mode)


# ---- paths ------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", [*PATHS, "", ".", "/", "nul\0byte", "p" * 300])
def test_what_names_no_file_is_an_error_of_the_library(path: Any, learner: kreps.KREPS) -> None:
    for call in (
        learner.policy.save,
        learner.policy.export_onnx,
        learner.save,
        kreps.load_policy,
        kreps.load_rollouts,
        kreps.KREPS.resume,
        lambda path: kreps.save_rollouts(rollouts(1), path),
    ):
        with pytest.raises(StorageError):
            call(path)


@pytest.mark.parametrize("path", [*PATHS, "", "nul\0byte", "p" * 300])
def test_what_names_no_folder_is_an_error_of_the_library(path: Any) -> None:
    with pytest.raises(StorageError):
        kreps.rollout_folder(path)


def test_a_folder_in_a_circle_of_links_is_an_error_of_the_library(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(StorageError, match="is not a folder"):
        kreps.rollout_folder(tmp_path / "loop")


def test_hidden_files_are_no_part_of_a_folder(tmp_path: Path) -> None:
    kreps.save_rollouts(rollouts(5), tmp_path / "a.safetensors")
    (tmp_path / "._a.safetensors").write_bytes(
        b"\x00\x05\x16\x07\x00\x02\x00\x00Mac OS X" + bytes(60)
    )
    (tmp_path / ".safetensors").write_bytes(b"")
    assert len(kreps.rollout_folder(tmp_path)) == 10
    (tmp_path / "a.safetensors").unlink()
    with pytest.raises(StorageError, match=r"holds no \*\.safetensors"):
        kreps.rollout_folder(tmp_path)


# ---- after a kill -----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_killed_writer_leaves_the_old_file_or_the_new_one(tmp_path: Path) -> None:
    path = tmp_path / "x"
    code = (
        "import sys; from kreps.learning.storage import write_atomically\n"
        "for i in range(10**9):\n"
        "    write_atomically(sys.argv[1], bytes([i % 2 + 1]) * 300_000)\n"
        "    print(i, flush=True)\n"
    )
    writer = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE)
    assert writer.stdout is not None
    for _ in range(5):
        writer.stdout.readline()
    writer.kill()
    writer.wait()
    content = path.read_bytes()
    assert len(content) == 300_000 and set(content) in ({1}, {2})
    write_atomically(path, b"again")
    assert path.read_bytes() == b"again"
