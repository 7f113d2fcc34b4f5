"""Output into any encoding, closed pipes and full disks, and control characters in foreign text."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from kreps.app import console
from kreps.terminal import Output, printable


def encoded(text: str, encoding: str) -> str:
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding=encoding)
    output = Output(stream)
    assert output.write(text) == len(text)
    output.flush()
    assert output.error is None
    return raw.getvalue().decode(encoding)


@pytest.mark.parametrize(
    ("text", "encoding", "seen"),
    [
        ("-1 ± 2 …", "ascii", "-1 +/- 2 ..."),
        ("-1 ± 2 …", "utf-8", "-1 ± 2 …"),
        ("-1 ± 2 …", "latin-1", "-1 ± 2 ..."),
        ("┏━┳━┓\n┃a┃b┃\n└─┴─┘", "ascii", "+-+-+\n|a|b|\n+-+-+"),
        ("Größe 漢", "ascii", "Gr??e ?"),
        ("Größe 漢", "cp1252", "Größe ?"),
        ("\udcff", "utf-8", "?"),
    ],
)
def test_what_an_encoding_lacks_is_spelled(text: str, encoding: str, seen: str) -> None:
    assert encoded(text, encoding) == seen


@pytest.mark.parametrize(
    ("text", "seen"),
    [
        ("a\x1b[2Jb", r"a\x1b[2Jb"),
        ("\x1b]0;title\x07", r"\x1b]0;title\x07"),
        ("over\rwritten\x08", r"over\rwritten\x08"),
        ("\x9b31m", r"\x9b31m"),
        ("tx‮t.exe", r"tx\u202et.exe"),
        ("\udcff", r"\udcff"),
        ("two\nlines\tand a tab", "two\nlines\tand a tab"),
        ("Größe ± 漢 [bold]", "Größe ± 漢 [bold]"),
    ],
)
def test_control_characters_are_made_visible(text: str, seen: str) -> None:
    assert printable(text) == seen


def test_nothing_is_written_after_a_failure() -> None:
    class Broken(io.StringIO):
        writes = 0

        def write(self, text: str) -> int:
            self.writes += 1
            raise BrokenPipeError(32, "Broken pipe")

    broken = Broken()
    output = Output(broken)
    for _ in range(3):
        output.write("a")
        output.flush()
    assert broken.writes == 1 and isinstance(output.error, BrokenPipeError)


def test_lines_are_broken_between_words_in_a_terminal_only(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sentence = "The reward does not rise (--set rollouts_per_iteration=20), \x1b[31mnot at all."
    console.say(sentence, indent=4)
    assert capsys.readouterr().out == sentence.replace("\x1b", r"\x1b") + "\n"
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "32")
    console.say(sentence, indent=4)
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "The reward does not rise (--set",
        "    rollouts_per_iteration=20),",
        r"    \x1b[31mnot at all.",
    ]
    console.say_command("Continue: ", "kreps resume a/long/path/of/a/run --iterations 40")
    assert len(capsys.readouterr().out.splitlines()) == 1
    monkeypatch.setenv("COLUMNS", "0")
    console.say("no width at all")
    assert "no" in capsys.readouterr().out


# ---- the command line ---------------------------------------------------------------------------

KREPS = [sys.executable, "-m", "kreps"]
needs_full_device = pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="the system has no device that is always full"
)


@needs_full_device
@pytest.mark.parametrize("command", [["settings"], ["--help"], ["train", "--help"]])
def test_a_full_disk_is_a_message_and_an_exit_status(command: list[str]) -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run([*KREPS, *command], stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("error: standard output was lost: No space left on device")
    assert len(done.stderr.splitlines()) == 1


@needs_full_device
def test_an_error_is_an_error_also_where_it_cannot_be_printed() -> None:
    with open("/dev/full", "w") as full:
        for command in (["plot", "nowhere"], ["plot", "--colour"]):
            assert subprocess.run([*KREPS, *command], stdout=full, stderr=full).returncode == 2


def test_a_reader_that_leaves_early_is_no_error() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([*KREPS, "settings"], stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert done.returncode == 0 and done.stderr == ""


def test_help_in_ascii() -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [*KREPS, "export", "--help"], capture_output=True, env=environment, check=True
    )
    text = done.stdout.decode("ascii")
    assert "+-" in text and "?" not in text


LONGEST = "--model-based.model-rollout-fraction"


@pytest.mark.parametrize("columns", [40, 80, 110])
def test_help_shows_every_option_in_full_at_any_width(columns: int) -> None:
    environment = {**os.environ, "COLUMNS": str(columns)}
    for command, options in {
        "train": (
            "--iterations",
            "--no-report",
            "--env-arg",
            "NAME=VALUE",
            "[default: 0",
            LONGEST,
        ),
        "export": ("--centres", "RUN_OR_POLICY"),
        "reproduce": ("--scheduler", "ADDRESS", "kreps reproduce all"),
    }.items():
        done = subprocess.run(
            [*KREPS, command, "--help"], capture_output=True, env=environment, check=True
        )
        text = done.stdout.decode()
        assert "…" not in text
        assert all(option in text for option in options), text


def test_control_characters_of_an_unknown_environment_are_made_visible() -> None:
    command = [*KREPS, "train", "\x1b[2Jevil\x1b]0;owned\x07-v0", "--out", "run"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert r"\x1b[2Jevil" in done.stderr
    assert not set("\x1b\x07") & set(done.stdout + done.stderr)
