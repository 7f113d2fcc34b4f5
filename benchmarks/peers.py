"""SAC and PPO of Stable-Baselines3 on our tasks, judged as kreps judges its own policies.

    python benchmarks/peers.py --tasks swing-up reaching --learners sac ppo --seeds 400-409

A cell is one learner on one task with one seed.  Finished cells are kept in ``results/cells/peers``
and not run again, so a stopped benchmark goes on where it was; when all are there, every cell of
that folder is written to ``results/peers.json``, a row for each mark.  Settings are the published
ones of rl-baselines3-zoo (https://github.com/DLR-RM/rl-baselines3-zoo, ``hyperparams/sac.yml`` and
``ppo.yml``); tasks that the zoo does not know take those of Pendulum-v1, its nearest task.

What is the same for all learners, and what is done so that the comparison is fair:

- Training environments restart with probability 0.02 per step (`kreps.envs.RandomRestart`), which
  is the process that policies are judged on.  Restarts come as truncations, and both learners
  bootstrap there, as they do at any time limit.  Discount factors stay those of the zoo.
- Angles, named by the environment's ``metadata["periodic_coordinates"]``, are given to the networks
  as cosine and sine.  Other coordinates are given as they are, as the zoo does.
- Actions are rescaled to [-1, 1].
- Pixels already lie in [0, 1] and their differences in [-1, 1], so images are given as they are,
  to the networks of two hidden layers that the zoo takes for Pendulum-v1: 20 x 20 pixels are too
  few for its convolutional network, which needs 36 x 36.
- A policy is judged at each mark, as what was learnt from at most that many environment steps, all
  parallel environments counted.  PPO with 4 environments x 1024 steps first learns at 4096 steps:
  before, it is judged as it began (``updates`` is 0).
- Judging is `kreps.evaluation.evaluate` on the environment without restarts; with exploration that
  depends on the state (gSDE) its noise is redrawn as often as in training.  Judging leaves
  learning as it would have been without: a cell's numbers do not depend on its other marks.
- Seconds are those of learning and of its environments, on one thread; judging is not counted.

The learners need an environment of their own:

    python -m venv .venv-peers
    .venv-peers/bin/pip install -r benchmarks/peers_requirements.txt
    .venv-peers/bin/pip install -e .
    .venv-peers/bin/python benchmarks/peers.py --help
"""

from __future__ import annotations

import argparse
import io
import json
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.data.task import TaskSpec
from kreps.envs import RandomRestart
from kreps.experiments.executors import executor
from kreps.experiments.provenance import commit
from kreps.experiments.specs import TASKS as OURS
from kreps.kernels.arrays import FloatArray
from kreps.kernels.threads import blas_threads
from kreps.learning.environment import Environment, task_of
from kreps.learning.evaluate import EPISODES, STEPS, evaluate
from kreps.learning.storage import write_atomically
from kreps.seeding import Purpose, integer_seed
from kreps.versions import versions

RESTART = 0.02
MARKS = (3000, 5000, 8000)
LEARNERS = ("sac", "ppo")
MISSING = """stable_baselines3 is not installed here; it needs an environment of its own:
    python -m venv .venv-peers
    .venv-peers/bin/pip install -r benchmarks/peers_requirements.txt
    .venv-peers/bin/pip install -e .
and then .venv-peers/bin/python in place of python"""


@dataclass(frozen=True)
class Task:
    """One task and how policies are judged on it.

    Attributes:
        environment: Gymnasium name.
        zoo: the task of the zoo whose settings are taken.
        episodes, steps: roll-outs of an evaluation, and their length at most; fewer where the
            environment steps one by one or observes images.
    """

    environment: str
    zoo: str = "Pendulum-v1"
    episodes: int = EPISODES
    steps: int = STEPS


TASKS: dict[str, Task] = {
    "swing-up": Task(OURS["swing-up"].environment),
    "reaching": Task(OURS["reaching"].environment),
    "images": Task(OURS["images"].environment, episodes=20),
    "pendulum": Task("Pendulum-v1", episodes=20, steps=200),
    "mountain-car": Task(
        "MountainCarContinuous-v0", "MountainCarContinuous-v0", episodes=20, steps=999
    ),
}

SETTINGS: dict[tuple[str, str], dict[str, Any]] = {
    ("sac", "Pendulum-v1"): {"learning_rate": 1e-3},
    ("ppo", "Pendulum-v1"): {
        "n_envs": 4,
        "n_steps": 1024,
        "gae_lambda": 0.95,
        "gamma": 0.9,
        "n_epochs": 10,
        "ent_coef": 0.0,
        "learning_rate": 1e-3,
        "clip_range": 0.2,
        "use_sde": True,
        "sde_sample_freq": 4,
    },
    ("sac", "MountainCarContinuous-v0"): {
        "learning_rate": 3e-4,
        "buffer_size": 50_000,
        "batch_size": 512,
        "ent_coef": 0.1,
        "train_freq": 32,
        "gradient_steps": 32,
        "gamma": 0.9999,
        "tau": 0.01,
        "learning_starts": 0,
        "use_sde": True,
        "policy_kwargs": {"log_std_init": -3.67, "net_arch": [64, 64]},
    },
    ("ppo", "MountainCarContinuous-v0"): {
        "normalize": True,
        "n_envs": 1,
        "n_steps": 8,
        "batch_size": 256,
        "gamma": 0.9999,
        "learning_rate": 7.77e-5,
        "ent_coef": 0.00429,
        "clip_range": 0.1,
        "n_epochs": 10,
        "gae_lambda": 0.9,
        "max_grad_norm": 5,
        "vf_coef": 0.19,
        "use_sde": True,
        "policy_kwargs": {"log_std_init": -3.29, "ortho_init": False},
    },
}
"""By learner and task of the zoo; what is not named has Stable-Baselines3's default."""


@dataclass(frozen=True)
class Trial:
    """What one worker is asked to do.

    Attributes:
        task: a name of `TASKS`.
        learner: one of `LEARNERS`.
        seed: of learning and of the evaluations.
        marks: environment steps at which the policy is judged, ascending.
    """

    task: str
    learner: str
    seed: int
    marks: tuple[int, ...]

    @property
    def settings(self) -> dict[str, Any]:
        return SETTINGS[self.learner, TASKS[self.task].zoo]

    def description(self) -> dict[str, Any]:
        """All that its numbers depend on, as it is read back from a file; marks do not matter."""
        about = {
            "task": self.task,
            "learner": self.learner,
            "seed": self.seed,
            "settings": self.settings,
            "restart_probability": RESTART,
            **vars(TASKS[self.task]),
        }
        plain: dict[str, Any] = json.loads(json.dumps(about))
        return plain

    def command(self) -> str:
        return (
            f"python benchmarks/peers.py --tasks {self.task} --learners {self.learner} "
            f"--seeds {self.seed} --marks {' '.join(map(str, self.marks))}"
        )

    def path(self, folder: Path) -> Path:
        return folder / self.task / f"{self.learner}-seed-{self.seed}.json"


# ---- learning ---------------------------------------------------------------------------------


def network_input(states: FloatArray, periodic: Sequence[int]) -> NDArray[np.float32]:
    """What the networks see of observations (m, ds): their angles (rad) as cosine and sine.

    Returns:
        (m, ds + number of angles): the other coordinates in order, then cosines, then sines.
    """
    angles = states[:, list(periodic)]
    others = np.delete(states, list(periodic), axis=1)
    return np.concatenate([others, np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)


def training_environment(name: str) -> Environment:
    """The environment as the learners see it: restarts, cosines and sines, actions in [-1, 1]."""
    env: Environment = RandomRestart(gym.make(name), RESTART)
    task = task_of(env)
    size = task.observation_size + len(task.periodic)
    env = gym.wrappers.TransformObservation(
        env,
        lambda observation: network_input(np.reshape(observation, (1, -1)), task.periodic)[0],
        gym.spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32),
    )
    assert isinstance(env.action_space, gym.spaces.Box)
    one = np.ones_like(env.action_space.high)
    return gym.wrappers.RescaleAction(env, -one, one)


def model_of(cell: Trial) -> Any:
    """The untrained learner of a cell, with its environments."""
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

    # the zoo's mini-batch on the mountain car is larger than what PPO collects there
    warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
    settings = dict(cell.settings)
    make = partial(training_environment, TASKS[cell.task].environment)
    envs: VecEnv = DummyVecEnv([make] * settings.pop("n_envs", 1))
    if settings.pop("normalize", False):
        envs = VecNormalize(envs, gamma=settings["gamma"])
    kind = {"sac": SAC, "ppo": PPO}[cell.learner]
    seed = integer_seed(cell.seed, Purpose.ENVIRONMENT)  # the environments have it and the next
    return kind("MlpPolicy", envs, seed=seed, device="cpu", **settings)


def noise_period(settings: Mapping[str, Any]) -> int | None:
    """Steps for which training keeps the noise of gSDE; None without gSDE."""
    if not settings.get("use_sde"):
        return None
    steps: int = next(
        settings[name] for name in ("sde_sample_freq", "n_steps", "train_freq") if name in settings
    )
    return steps


class NetworkPolicy:
    """A copy of a learnt policy, as `kreps.evaluation` asks for one.

    Args:
        model: the learner that has it.
        task: of the environment that it is judged on.
        period: steps between draws of the noise of gSDE; None: each action has noise of its own.
        greedy: without exploration.
    """

    def __init__(self, model: Any, task: TaskSpec, period: int | None, greedy: bool) -> None:
        file = io.BytesIO()
        model.policy.save(file)
        file.seek(0)
        self.policy = type(model.policy).load(file, device="cpu")
        self.normaliser = model.get_vec_normalize_env()
        self.task, self.period, self.greedy = task, period, greedy
        self.calls = 0

    def act(self, states: FloatArray, noise: FloatArray) -> FloatArray:
        """Actions (m, da) in the task's units for observations (m, ds); torch draws the noise."""
        if self.period is not None and self.calls % self.period == 0:
            self.policy.reset_noise(len(states))
        self.calls += 1
        seen = network_input(states, self.task.periodic)
        if self.normaliser is not None:
            seen = self.normaliser.normalize_obs(seen)
        actions, _ = self.policy.predict(seen, deterministic=self.greedy)
        return self.task.unscaled(np.asarray(actions, dtype=np.float64))


class Stopwatch:
    """CPU and wall seconds since it was made, without those in which it was paused."""

    def __init__(self) -> None:
        self._since = self._now()

    @staticmethod
    def _now() -> FloatArray:
        return np.array([time.process_time(), time.perf_counter()])

    @contextmanager
    def paused(self) -> Iterator[tuple[float, float]]:
        """Stops while the block runs, and gives it the CPU and wall seconds so far."""
        at = self._now()
        cpu, wall = (at - self._since).tolist()
        try:
            yield cpu, wall
        finally:
            self._since += self._now() - at


class Judge:
    """Stable-Baselines3's callback: called after each step, before what is learnt from it.

    So at the first step beyond a mark the policy is what was learnt from at most that many.
    Learning ends after the last mark.
    """

    def __init__(self, cell: Trial, model: Any) -> None:
        self.cell, self.model = cell, model
        self.env = gym.make(TASKS[cell.task].environment)
        self.task = task_of(self.env)
        self.left = list(cell.marks)
        self.rows: list[dict[str, Any]] = []
        self.watch = Stopwatch()

    def __call__(self, local: dict[str, Any], global_: dict[str, Any]) -> bool:
        """Whether to go on."""
        while self.left and self.model.num_timesteps > self.left[0]:
            with self.watch.paused() as (cpu, wall):
                scores = self.scores()
            self.rows.append(
                {
                    "task": self.cell.task,
                    "learner": self.cell.learner,
                    "seed": self.cell.seed,
                    "mark": self.left.pop(0),
                    **scores,
                    "updates": self.model._n_updates,
                    "cpu_seconds": cpu,
                    "wall_seconds": wall,
                }
            )
        return bool(self.left)

    def scores(self) -> dict[str, float]:
        """Average rewards per step and their standard errors, with and without exploration."""
        import torch

        found: dict[str, float] = {}
        about = TASKS[self.cell.task]
        for name in ("stochastic", "greedy"):
            with torch.random.fork_rng(devices=[]):  # learning draws as if nothing had been
                torch.manual_seed(integer_seed(self.cell.seed, Purpose.EVALUATION_POLICY))
                score = evaluate(
                    self.env,
                    self.task,
                    NetworkPolicy(
                        self.model, self.task, noise_period(self.cell.settings), name == "greedy"
                    ),
                    restart_probability=RESTART,
                    episodes=about.episodes,
                    steps=about.steps,
                    seed=self.cell.seed,
                )
            found[name], found[f"{name}_standard_error"] = score.mean, score.standard_error
        return found


def run_cell(cell: Trial) -> dict[str, Any]:
    """Learn and judge: the cell's description, one row per mark, and the versions used."""
    import torch

    torch.set_num_threads(1)
    with blas_threads(1):
        model = model_of(cell)
        judge = Judge(cell, model)
        # one round of steps beyond the last mark, at which the judge stops it
        model.learn(cell.marks[-1] + model.n_envs, callback=judge)
    names = ("gymnasium", "stable-baselines3", "torch")
    return {
        "cell": cell.description(),
        "command": cell.command(),
        "versions": {**versions(), **{name: version(name) for name in names}},
        "rows": judge.rows,
    }


# ---- files ------------------------------------------------------------------------------------


def read(path: Path) -> dict[str, Any]:
    """A finished cell."""
    try:
        found: dict[str, Any] = json.loads(path.read_text())
        if not {"cell", "rows", "commit", "command", "versions"} <= found.keys():
            raise ValueError("parts are missing")
        return found
    except (ValueError, AttributeError) as error:
        raise SystemExit(f"{path} is damaged ({error}); remove it to run the cell again") from error


def left_of(cell: Trial, folder: Path) -> Trial | None:
    """What is to be run; None if it is there.

    A cell that is there with other marks is run again with those and the new ones.
    """
    path = cell.path(folder)
    if not path.exists():
        return cell
    found = read(path)
    if found["cell"] != cell.description():
        return cell
    have = {row["mark"] for row in found["rows"]}
    return (
        None if have >= {*cell.marks} else replace(cell, marks=tuple(sorted({*have, *cell.marks})))
    )


def write(path: Path, content: Mapping[str, Any], indent: int | None = None) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, (json.dumps(content, indent=indent) + "\n").encode())


def gather(folder: Path, path: Path) -> int:
    """All finished cells of a folder in one file; how many they are.

    It has the learners' settings by task, and a row for each cell and mark.
    """
    found = [read(file) for file in sorted(folder.glob("*/*.json"))]
    found.sort(key=lambda r: (r["cell"]["task"], r["cell"]["learner"], r["cell"]["seed"]))
    settings = {
        f"{r['cell']['task']}: {r['cell']['learner']}": {
            name: value for name, value in r["cell"].items() if name != "seed"
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


def run_trials(cells: Sequence[Trial], workers: int, folder: Path) -> dict[str, BaseException]:
    """Run what is not in the folder yet; the errors of the cells that failed, by name."""
    left = [todo for cell in cells if (todo := left_of(cell, folder)) is not None]
    count = len(cells) - len(left)
    print(f"{count} of {len(cells)} cells are there", flush=True)
    failures: dict[str, BaseException] = {}
    if not left:
        return failures
    if find_spec("stable_baselines3") is None:
        raise SystemExit(MISSING)
    source = commit()  # of the code that is about to run, whatever happens to the tree meanwhile
    with executor(workers, None) as pool:
        running = {pool.submit(run_cell, cell): cell for cell in left}
        try:
            for future in as_completed(running):
                cell = running[future]
                name = f"{cell.task}, {cell.learner}, seed {cell.seed}"
                if (error := future.exception()) is not None:
                    failures[name] = error
                    print(f"FAILED: {name}: {type(error).__name__}: {error}", flush=True)
                    continue
                result = {"commit": source, **future.result()}
                write(cell.path(folder), result)
                count += 1
                last = result["rows"][-1]
                print(
                    f"{count}/{len(cells)} cells: {name}: after {last['mark']} steps "
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
        help="environment steps at which policies are judged; learning ends with "
        f"the last (default: {' '.join(map(str, MARKS))})",
    )
    parser.add_argument(
        "--workers",
        type=positive,
        default=1,
        help="cells that run at a time, each on one thread (default: 1)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("results"),
        help="cells go to OUT/cells/peers, the rows to OUT/peers.json (default: results)",
    )
    options = parser.parse_args()
    seeds = dict.fromkeys(seed for part in options.seeds for seed in part)
    marks = tuple(sorted(set(options.marks)))
    cells = [
        Trial(task, learner, seed, marks)
        for seed in seeds  # seed by seed, so that partial results compare
        for task in dict.fromkeys(options.tasks)
        for learner in dict.fromkeys(options.learners)
    ]
    folder = options.out / "cells" / "peers"
    failures = run_trials(cells, options.workers, folder)
    count = gather(folder, options.out / "peers.json")
    print(f"{options.out / 'peers.json'} has {count} cells")
    if failures:
        raise SystemExit(f"{len(failures)} cells failed; the others are kept, so call it again")


if __name__ == "__main__":
    main()
