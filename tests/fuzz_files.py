"""Damaged and forged files: how they are made, and what becomes of them when they are loaded.

``python tests/fuzz_files.py 1000`` does so with 1000 files of each kind and prints the counts;
``tests/test_damage.py`` with fewer.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import safetensors.numpy

import kreps
from kreps.learning.storage.checksum import sealed

KINDS = ("policy", "checkpoint", "rollouts")
OLD = Path(__file__).parent / "data" / "v0.1"
STATES = np.random.default_rng(0).normal(size=(20, 2))

Random = np.random.Generator


def originals() -> dict[str, bytes]:
    """One good file of each kind."""
    rng = np.random.default_rng(0)
    learner = kreps.KREPS(
        gym.make("kreps/SwingUp-v0"),
        seed=4,
        restart_probability=0.1,
        initial_rollouts=6,
        rollouts_per_iteration=3,
        window=6,
    ).learn(2, progress=False)
    rollouts = [
        kreps.Rollout(rng.normal(size=(k + 1, 2)), rng.normal(size=(k, 1)), rng.normal(size=k), end)
        for k, end in ((9, True), (4, False), (13, True))
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x"
        contents = []
        for save in (
            learner.policy.save,
            learner.save,
            lambda path: kreps.save_rollouts(rollouts, path),
        ):
            save(path)
            contents.append(path.read_bytes())
    return dict(zip(KINDS, contents, strict=True))


def old_files() -> dict[str, bytes]:
    """One good file of each kind that version 0.1 wrote, without a checksum."""
    names = ("policy_cost-sensitive-gp", "checkpoint_default", "rollouts")
    return {
        kind: (OLD / f"{name}.safetensors").read_bytes()
        for kind, name in zip(KINDS, names, strict=True)
    }


# ---- damage -----------------------------------------------------------------------------------


def header_length(content: bytes) -> int:
    """Bytes before the numbers."""
    (size,) = struct.unpack("<Q", content[:8])
    return 8 + int(size)


def flip_a_bit(content: bytes, rng: Random) -> bytes:
    changed = bytearray(content)
    changed[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def flip_a_bit_of_the_header(content: bytes, rng: Random) -> bytes:
    changed = bytearray(content)
    changed[rng.integers(header_length(content))] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def change_bytes(content: bytes, rng: Random) -> bytes:
    changed = bytearray(content)
    for _ in range(int(rng.integers(1, 9))):
        changed[rng.integers(len(content))] = int(rng.integers(256))
    return bytes(changed)


def block(content: bytes, rng: Random) -> slice:
    length = int(rng.choice([1, 8, 64, 512, 4096]))
    first = int(rng.integers(len(content)))
    return slice(first, min(first + length, len(content)))


def zero_a_block(content: bytes, rng: Random) -> bytes:
    changed, part = bytearray(content), block(content, rng)
    changed[part] = bytes(part.stop - part.start)
    return bytes(changed)


def copy_a_block(content: bytes, rng: Random) -> bytes:
    part, to = block(content, rng), int(rng.integers(len(content)))
    copied = content[part]
    return (content[:to] + copied + content[to + len(copied) :])[: len(content)]


def insert_a_block(content: bytes, rng: Random) -> bytes:
    part, to = block(content, rng), int(rng.integers(len(content)))
    return content[:to] + content[part] + content[to:]


def leave_out_a_block(content: bytes, rng: Random) -> bytes:
    part = block(content, rng)
    return content[: part.start] + content[part.stop :]


def truncate(content: bytes, rng: Random) -> bytes:
    return content[: int(rng.integers(len(content)))]


def append(content: bytes, rng: Random) -> bytes:
    return content + rng.bytes(int(rng.integers(1, 100)))


def exchange_two_numbers(content: bytes, rng: Random) -> bytes:
    first, count = header_length(content), (len(content) - header_length(content)) // 8
    changed = bytearray(content)
    a, b = (first + 8 * int(i) for i in rng.integers(count, size=2))
    changed[a : a + 8], changed[b : b + 8] = content[b : b + 8], content[a : a + 8]
    return bytes(changed)


def change_a_digit_of_the_header(content: bytes, rng: Random) -> bytes:
    """A number of the header, of the checksum or of a shape."""
    places = [i for i in range(8, header_length(content)) if chr(content[i]).isdigit()]
    changed = bytearray(content)
    changed[places[rng.integers(len(places))]] = int(rng.choice(list(b"0123456789")))
    return bytes(changed)


DAMAGE: tuple[Callable[[bytes, Random], bytes], ...] = (
    flip_a_bit,
    flip_a_bit_of_the_header,
    change_bytes,
    zero_a_block,
    copy_a_block,
    insert_a_block,
    leave_out_a_block,
    truncate,
    append,
    exchange_two_numbers,
    change_a_digit_of_the_header,
)

# ---- forgeries --------------------------------------------------------------------------------

HOSTILE: tuple[Any, ...] = (
    *(0, 1, -1, 2, 10**6, 10**9, 2**63, 10**30, 1e-300, 1e-12, 0.5, 1e97, 1e300, -1e300),
    *(float("nan"), float("inf"), None, True, False, "", "x" * 400, "\x1b[2J\x07\n", [], {}),
    *([0] * 50, [[1]], {"kind": "policy"}, "none", "0"),
)


def forge(content: bytes, rng: Random) -> bytes:
    """A file with another value in its header or its arrays, and a checksum that fits."""
    tensors = safetensors.numpy.load(content)
    stored = json.loads(content[8 : header_length(content)])["__metadata__"]["kreps"]
    header = json.loads(stored)
    if rng.random() < 0.5:
        owner: Any = header
        while True:
            keys = list(owner) if isinstance(owner, dict) else list(range(len(owner)))
            key = keys[rng.integers(len(keys))]
            if not isinstance(owner[key], dict | list) or not owner[key] or rng.random() < 0.1:
                break
            owner = owner[key]
        owner[key] = HOSTILE[rng.integers(len(HOSTILE))]
    else:
        name = sorted(tensors)[rng.integers(len(tensors))]
        values = tensors[name] = tensors[name].copy()
        if values.size and values.dtype == np.float64:
            numbers = (0.0, -1.0, 1e-300, 1e-40, 1e40, 1e99, -1e99, 1e101, np.nan, np.inf, 0.3)
            values.flat[rng.integers(values.size)] = rng.choice(numbers)
        elif values.size:
            raw = values.view(np.uint8).reshape(-1)
            raw[rng.integers(raw.size)] = rng.integers(256)
    if "sha256" in header:
        header["sha256"] = "0" * 64
    content = safetensors.numpy.save(tensors, metadata={"kreps": json.dumps(header)})
    return sealed(content) if "sha256" in header else content


# ---- what becomes of them ---------------------------------------------------------------------


def use(kind: str, path: Path) -> bytes:
    """Load a file and use it; the result depends on all that acts."""
    if kind == "rollouts":
        rollouts = kreps.load_rollouts(path)
        assert len(kreps.rollout_folder(path.parent).chunks) == 1
        parts = (rollouts.points, rollouts.actions, rollouts.rewards, rollouts.offsets)
        return b"".join(values.tobytes() for values in (*parts, rollouts.terminated))
    loaded = kreps.load_policy(path) if kind == "policy" else kreps.KREPS.resume(path)
    actions = [loaded.predict(STATES, deterministic=greedy)[0] for greedy in (True, False)]
    assert np.isfinite(actions).all(), "an action is not finite"
    loaded.save(path.with_name("again"))
    return np.array(actions).tobytes() + path.with_name("again").read_bytes()


def outcome(kind: str, content: bytes, expected: bytes | None, path: Path) -> str:
    """What a damaged file leads to.

    Args:
        kind: of the file.
        content: damaged.
        expected: what `use` gives of the good file; None if the damage has a fitting checksum.
        path: where to write it.

    Returns:
        "refused", "as before", "loaded with a note", "loaded" (only if ``expected`` is None), or
        what must not be: "ACTS DIFFERENTLY" or "CRASH" with the error.
    """
    path.write_bytes(content)
    with warnings.catch_warnings(record=True) as caught, np.errstate(all="ignore"):
        warnings.simplefilter("always")
        try:
            found = use(kind, path)
        except kreps.KrepsError as error:
            return "refused" if str(error).isprintable() else f"CRASH: prints {str(error)!r}"
        except BaseException as error:  # panics of libraries too
            return f"CRASH: {type(error).__name__}: {error}"
    if found == expected:
        return "as before"
    if any("has no checksum" in str(each.message) for each in caught):
        return "loaded with a note"
    return "ACTS DIFFERENTLY" if expected is not None else "loaded"


def damaged_outcomes(kind: str, content: bytes, count: int, seed: int = 0) -> Counter[str]:
    """Of files that are damaged."""
    rng, found = np.random.default_rng(seed), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.safetensors"
        path.write_bytes(content)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            expected = use(kind, path)
        for number in range(count):
            changed = DAMAGE[number % len(DAMAGE)](content, rng)
            if changed == content:  # such as a digit that was the same before
                changed = flip_a_bit(content, rng)
            found[outcome(kind, changed, expected, path)] += 1
    return found


def forged_outcomes(kind: str, content: bytes, count: int, seed: int = 0) -> Counter[str]:
    """Of files that are forged."""
    rng, found = np.random.default_rng(seed), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.safetensors"
        for _ in range(count):
            found[outcome(kind, forge(content, rng), None, path)] += 1
    return found


def main(count: int) -> None:
    for what, files in (("version 4", originals()), ("version 0.1", old_files())):
        for kind, content in files.items():
            for name, outcomes in (("damaged", damaged_outcomes), ("forged", forged_outcomes)):
                found = outcomes(kind, content, count)
                print(f"{what:<12}{kind:<11}{name:<8} {dict(sorted(found.items()))}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
