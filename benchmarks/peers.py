"""SAC and PPO of Stable-Baselines3 on the tasks of kreps, with the same evaluation.

    python benchmarks/peers.py --tasks swing-up reaching --learners sac ppo --seeds 400-409

A trial is one learner on one task with one seed.  Finished trials are kept in
``results/trials/peers`` and not run again, so that a stopped benchmark can be continued.  At the
end, all trials of that folder are written to ``results/peers.json``, one row per mark.  Settings
are the published ones of rl-baselines3-zoo (https://github.com/DLR-RM/rl-baselines3-zoo,
``hyperparams/sac.yml`` and ``ppo.yml``).  Tasks that the zoo does not contain have the settings of
Pendulum-v1, the most similar task.

Protocol, the same for all learners:

- Training environments restart with probability 0.02 per step (`kreps.envs.RandomRestart`), as in
  the process whose average reward is evaluated.  Restarts are truncations, and both learners
  bootstrap there, as at any time limit.  Discount factors are those of the zoo.
- The input of the networks has cosine and sine in place of each angle, which the environment's
  ``metadata["periodic_coordinates"]`` lists.  Other coordinates are not changed, as in the zoo.
- Actions are rescaled to [-1, 1].
- Images are not changed: pixels are in [0, 1] and their differences in [-1, 1].  The networks have
  the two hidden layers that the zoo has for Pendulum-v1.  20 x 20 pixels are too few for its
  convolutional network, which needs 36 x 36.
- A policy is evaluated at each mark: the latest one learnt from at most that many environment
  steps, counted over all parallel environments.  PPO with 4 environments x 1024 steps makes its
  first update at 4096 steps; before, the initial policy is evaluated (``updates`` is 0).
- Policies are evaluated by `kreps.learning.evaluate.evaluate` on the environment without restarts.
  Noise of state-dependent exploration (gSDE) is redrawn as often as in training.  The evaluation
  does not change the random numbers of learning, so the rows of a trial do not depend on its other
  marks.
- Seconds are of learning and of its environments, on one thread, without evaluation.

The learners need a virtual environment of their own:

    python -m venv .venv-peers
    .venv-peers/bin/pip install -r benchmarks/peers_requirements.txt
    .venv-peers/bin/pip install -e .
    .venv-peers/bin/python benchmarks/peers.py --help
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from peers_trials import LEARNERS, MARKS, TASKS, Trial, run_trial

from kreps.experiments.executors import executor
from kreps.experiments.provenance import commit
from kreps.learning.storage import write_atomically

MISSING = """stable_baselines3 is not installed; it needs a virtual environment of its own:
    python -m venv .venv-peers
    .venv-peers/bin/pip install -r benchmarks/peers_requirements.txt
    .venv-peers/bin/pip install -e .
then use .venv-peers/bin/python instead of python"""


# ---- files ------------------------------------------------------------------------------------


def read(path: Path) -> dict[str, Any]:
    """The result of a finished trial."""
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        if not {"trial", "rows", "commit", "command", "versions"} <= found.keys():
            raise ValueError("parts are missing")
        return found
    except (ValueError, AttributeError) as error:
        raise SystemExit(
            f"{path} is damaged ({error}); remove it to run the trial again"
        ) from error


def remaining(trial: Trial, folder: Path) -> Trial | None:
    """The trial that has to be run; None if its result is in the folder.

    A trial whose result has other marks is run again with those and the new ones.
    """
    path = trial.path(folder)
    if not path.exists():
        return trial
    found = read(path)
    if found["trial"] != trial.description():
        return trial
    have = {row["mark"] for row in found["rows"]}
    return (
        None
        if have >= {*trial.marks}
        else replace(trial, marks=tuple(sorted({*have, *trial.marks})))
    )


def write(path: Path, content: Mapping[str, Any], indent: int | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(content, indent=indent) + "\n").encode())


def gather(folder: Path, path: Path) -> int:
    """Write all finished trials of a folder to one file, and return their number.

    The file has the settings of each learner on each task, and one row per trial and mark.
    """
    found = [read(file) for file in sorted(folder.glob("*/*.json"))]
    found.sort(key=lambda r: (r["trial"]["task"], r["trial"]["learner"], r["trial"]["seed"]))
    settings = {
        f"{r['trial']['task']}: {r['trial']['learner']}": {
            name: value for name, value in r["trial"].items() if name != "seed"
        }
        for r in found
    }
    rows = [
        {**row, **{name: r[name] for name in ("commit", "command", "versions")}}
        for r in found
        for row in r["rows"]
    ]
    write(path, {"settings": settings, "rows": rows}, indent=1)
    return len(found)


# ---- the command line -------------------------------------------------------------------------


def run_trials(trials: Sequence[Trial], workers: int, folder: Path) -> dict[str, BaseException]:
    """Run the trials without a result in the folder; errors of failed trials, by name."""
    left = [todo for trial in trials if (todo := remaining(trial, folder)) is not None]
    count = len(trials) - len(left)
    print(f"{count} of {len(trials)} trials have a result", flush=True)
    failures: dict[str, BaseException] = {}
    if not left:
        return failures
    if find_spec("stable_baselines3") is None:
        raise SystemExit(MISSING)
    source = commit()  # now: the source tree may change while the trials run
    with executor(workers, None) as pool:
        running = {pool.submit(run_trial, trial): trial for trial in left}
        try:
            for future in as_completed(running):
                trial = running[future]
                name = f"{trial.task}, {trial.learner}, seed {trial.seed}"
                if (error := future.exception()) is not None:
                    failures[name] = error
                    print(f"FAILED: {name}: {type(error).__name__}: {error}", flush=True)
                    continue
                result = {"commit": source, **future.result()}
                write(trial.path(folder), result)
                count += 1
                last = result["rows"][-1]
                print(
                    f"{count}/{len(trials)} trials: {name}: after {last['mark']} steps "
                    f"{last['stochastic']:.2f} stochastic, {last['greedy']:.2f} greedy, "
                    f"{last['cpu_seconds']:.0f} CPU s",
                    flush=True,
                )
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return failures


def seeds_of(text: str) -> range:
    """``400-409`` or ``400``."""
    first, _, last = text.partition("-")
    try:
        return range(int(first), int(last or first) + 1)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is neither a seed nor a range such as 400-409"
        ) from None


def positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive integer")
    return int(text)


def add_tasks(parser: argparse.ArgumentParser, default: list[str]) -> None:
    parser.add_argument(
        "--tasks",
        nargs="+",
        choices=TASKS,
        default=default,
        metavar="TASK",
        help=f"of {', '.join(TASKS)} (default: {' '.join(default)})",
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_tasks(parser, default=["swing-up"])
    parser.add_argument(
        "--learners", nargs="+", choices=LEARNERS, default=LEARNERS, help="default: both"
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=seeds_of,
        default=[range(400, 410)],
        metavar="SEEDS",
        help="such as 3 or 400-409, the default",
    )
    parser.add_argument(
        "--marks",
        nargs="+",
        type=positive,
        default=MARKS,
        metavar="STEPS",
        help="environment steps at which policies are evaluated; learning ends with "
        f"the last (default: {' '.join(map(str, MARKS))})",
    )
    parser.add_argument(
        "--workers",
        type=positive,
        default=1,
        help="trials that run at the same time, each on one thread (default: 1)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("results"),
        help="trials go to OUT/trials/peers, rows to OUT/peers.json (default: results)",
    )
    options = parser.parse_args()
    seeds = dict.fromkeys(seed for part in options.seeds for seed in part)
    marks = tuple(sorted(set(options.marks)))
    trials = [
        Trial(task, learner, seed, marks)
        for seed in seeds  # partial results can be compared
        for task in dict.fromkeys(options.tasks)
        for learner in dict.fromkeys(options.learners)
    ]
    folder = options.out / "trials" / "peers"
    failures = run_trials(trials, options.workers, folder)
    count = gather(folder, options.out / "peers.json")
    print(f"{options.out / 'peers.json'} has {count} trials")
    if failures:
        raise SystemExit(f"{len(failures)} trials failed; the others are kept, so call it again")


if __name__ == "__main__":
    main()
