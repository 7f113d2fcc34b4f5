"""The commands that write a policy for use elsewhere: export and card."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from kreps.app.cli.paths import PATH
from kreps.app.cli.runs import RunArgument
from kreps.app.console import say
from kreps.app.model_card import CARD, write_model_card
from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError
from kreps.learning.policy import Policy, load_policy, mean_difference

EXPORT_EXAMPLES = (
    "kreps export runs/swing-up --out policy.onnx",
    "kreps export runs/swing-up --centres 50 --dtype float32 --out policy.onnx",
    "kreps export runs/swing-up --centres 50 --to c",
    "kreps export runs/swing-up/policy.safetensors --centres 50 --out small.safetensors",
)

CARD_EXAMPLES = ("kreps card runs/swing-up --out swing-up-policy",)

FORMATS = ("onnx", "c", "safetensors")
"""What `export` writes, and the end of its file's name."""

MAX_COMPRESSION_ERROR = 0.02
"""Root-mean-square error of a compressed policy, in units of the action scale, above which there
is a warning.  Compressed policies of the swing-up with a smaller error lost less than half a reward
per step (benchmarks/predict.py)."""


def export(
    source: Annotated[
        Path,
        typer.Argument(
            help="Folder of the run, or a policy's .safetensors file.",
            show_default=False,
            **{**PATH, "metavar": "RUN_OR_POLICY"},
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="File to write; policy.onnx, policy.c or policy.safetensors if not given.", **PATH
        ),
    ] = None,
    to: Annotated[
        str | None,
        typer.Option(help="onnx, c or safetensors; if not given, as the name of --out ends."),
    ] = None,
    centres: Annotated[
        int | None,
        typer.Option(min=1, help="Compress to at most so many support points; all if not given."),
    ] = None,
    dtype: Annotated[
        str, typer.Option(help="float64 or float32, of the input and outputs of ONNX and C.")
    ] = "float64",
) -> None:
    """Write the policy for a controller: as an ONNX model, as C99 source, or compressed.

    A model needs no Python on the robot.  Its input is [bold]observation[/bold] (batch, ds).  Its
    outputs are [bold]action[/bold] (batch, da), without exploration and within the limits, and
    [bold]standard_deviation[/bold] (batch, da).  It needs: pip install 'kreps\\[onnx]'.

    C source has a function [bold]policy_act(observation, action)[/bold], or another name in place
    of "policy" if the file has another name.  It computes the same action without a library, and
    allocates no memory.
    """
    out, to = _target(out, to)
    file = _policy_file(source)
    policy = load_policy(file)
    if centres is not None:
        policy = _compressed(policy, centres)
    if to == "safetensors":
        kind = _write_policy(policy, out, dtype, file)
    else:
        kind = _write_model(policy, out, to, dtype)
    say(f"wrote {out}: {kind}, {out.stat().st_size / 1e3:.0f} kB")


def card(
    run: RunArgument,
    out: Annotated[Path, typer.Option(help="Folder to write.", **PATH)],
) -> None:
    """Write a folder for the Hugging Face Hub: policy, numbers and a model card.

    Nothing is uploaded.  The card has the latest evaluation of the run, its command and how the
    policy is loaded; read it before you publish it, as it has the environment's arguments.
    """
    write_model_card(RunFolder(run), out)
    say(f"wrote {out / CARD}, beside the policy and its numbers")


def _target(out: Path | None, to: str | None) -> tuple[Path, str]:
    """The file to write and its format, of which one may be left out."""
    if out is None and to is None:
        raise ConfigurationError("--out and --to are both missing; write --out policy.onnx")
    if to is None:
        assert out is not None
        to = out.suffix.removeprefix(".")
    if to not in FORMATS:
        raise ConfigurationError(
            f"{to!r:.40} is no format of a policy; choose one of {', '.join(FORMATS)} by --to, "
            "or by the end of the name of --out"
        )
    out = out or Path(f"policy.{to}")
    if out.suffix != f".{to}":
        raise ConfigurationError(f"--out {out} does not end in .{to}; leave --to out, or rename it")
    return out, to


def _policy_file(source: Path) -> Path:
    """The policy of a run folder; any other path is that of a policy."""
    if not os.path.isdir(source):  # noqa: PTH112 (no error of its own where a name is too long)
        return source
    folder = RunFolder(source)
    folder.config()  # an error if this is not a run folder
    if not folder.policy_file.exists():
        raise ConfigurationError(
            f"{source} has no policy yet; make the first update with `kreps resume {source}`"
        )
    return folder.policy_file


def _compressed(policy: Policy, centres: int) -> Policy:
    """The policy with fewer support points; its error is printed."""
    compressed = policy.compressed(centres)
    if compressed is not policy:
        error = mean_difference(policy, compressed)
        say(f"compressed: at its samples the action changes by {error:.2g} of its scale (rms)")
        if error > MAX_COMPRESSION_ERROR:
            say(
                f"this is more than {MAX_COMPRESSION_ERROR:g}: take more centres, or evaluate the "
                "policy before its use"
            )
    return compressed


def _write_model(policy: Policy, out: Path, to: str, dtype: str) -> str:
    write, noun = {
        "onnx": (policy.export_onnx, "a model"),
        "c": (policy.export_c, f"C source, beside its header {out.stem}.h,"),
    }[to]
    arithmetic = write(out, dtype)
    kind = f"{noun} with {arithmetic} arithmetic"
    if dtype == "float32" != arithmetic:
        kind += " (float32 is not accurate enough for this policy; a smaller --centres often helps)"
    return kind


def _write_policy(policy: Policy, out: Path, dtype: str, source: Path) -> str:
    if dtype != "float64":
        raise ConfigurationError(
            f"--dtype {dtype}, but .safetensors files of kreps hold float64 only; leave it "
            "out, or write an .onnx or .c file"
        )
    if os.path.realpath(out) == os.path.realpath(source):
        raise ConfigurationError(
            f"--out {out} is the file that is read; it would overwrite the exact policy, so choose "
            "another name"
        )
    policy.save(out)
    return "a policy for kreps.load_policy"
