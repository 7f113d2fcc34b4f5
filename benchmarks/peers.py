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
MISSING = """stable_baselines3 is not installed; it needs a virtual environment of its own:
    python -m venv .venv-peers
    .venv-peers/bin/pip install -r benchmarks/peers_requirements.txt
    .venv-peers/bin/pip install -e .
then use .venv-peers/bin/python instead of python"""


@dataclass(frozen=True)
class Task:
    """One task and the evaluation of policies on it.

    Attributes:
        environment: Gymnasium name.
        zoo: the task of the zoo that the settings are of.
        episodes, steps: rollouts of an evaluation and their largest length; fewer where the
            environment simulates rollouts one at a time or observes images.
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
"""By learner and task of the zoo; other settings are the defaults of Stable-Baselines3."""


@dataclass(frozen=True)
class Trial:
    """The work of one worker process.

    Attributes:
        task: key of `TASKS`.
        learner: one of `LEARNERS`.
        seed: of learning and of the evaluations.
        marks: numbers of environment steps at which the policy is evaluated, ascending.
    """

    task: str
    learner: str
    seed: int
    marks: tuple[int, ...]

    @property
    def settings(self) -> dict[str, Any]:
        return SETTINGS[self.learner, TASKS[self.task].zoo]

    def description(self) -> dict[str, Any]:
        """Everything that the rows depend on, in the form that a JSON file returns it in."""
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
    """Input of the networks for observations (m, ds): angles (rad) as cosine and sine.

    Returns:
        (m, ds + number of angles): the other coordinates in order, then cosines, then sines.
    """
    angles = states[:, list(periodic)]
    others = np.delete(states, list(periodic), axis=1)
    return np.concatenate([others, np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)


def training_environment(name: str) -> Environment:
    """The environment with restarts, cosines and sines of angles, and actions in [-1, 1]."""
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


def model_of(trial: Trial) -> Any:
    """The untrained learner of a trial, with its environments."""
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

    # the mini-batch of the zoo for mountain car is larger than the rollout of PPO
    warnings.filterwarnings("ignore", message="You have specified a mini-batch size")
    settings = dict(trial.settings)
    make = partial(training_environment, TASKS[trial.task].environment)
    envs: VecEnv = DummyVecEnv([make] * settings.pop("n_envs", 1))
    if settings.pop("normalize", False):
        envs = VecNormalize(envs, gamma=settings["gamma"])
    kind = {"sac": SAC, "ppo": PPO}[trial.learner]
    seed = integer_seed(
        trial.seed, Purpose.ENVIRONMENT
    )  # of the first environment; others add 1, 2, ...
    return kind("MlpPolicy", envs, seed=seed, device="cpu", **settings)


def noise_period(settings: Mapping[str, Any]) -> int | None:
    """Steps between draws of the noise of gSDE in training; None without gSDE."""
    if not settings.get("use_sde"):
        return None
    steps: int = next(
        settings[name] for name in ("sde_sample_freq", "n_steps", "train_freq") if name in settings
    )
    return steps


class NetworkPolicy:
    """A copy of a learnt policy, with the interface that `kreps.learning.evaluate` needs.

    Args:
        model: the learner.
        task: of the environment of the evaluation.
        period: steps between draws of the noise of gSDE; None draws it for each action.
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
        """Actions (m, da) in units of the task for observations (m, ds), with noise from torch."""
        if self.period is not None and self.calls % self.period == 0:
            self.policy.reset_noise(len(states))
        self.calls += 1
        inputs = network_input(states, self.task.periodic)
        if self.normaliser is not None:
            inputs = self.normaliser.normalize_obs(inputs)
        actions, _ = self.policy.predict(inputs, deterministic=self.greedy)
        return self.task.unscaled(np.asarray(actions, dtype=np.float64))


class Stopwatch:
    """CPU and wall-clock seconds since its creation, without paused ones."""

    def __init__(self) -> None:
        self._since = self._now()

    @staticmethod
    def _now() -> FloatArray:
        return np.array([time.process_time(), time.perf_counter()])

    @contextmanager
    def paused(self) -> Iterator[tuple[float, float]]:
        """Pause while the block runs; yields the CPU and wall-clock seconds so far."""
        at = self._now()
        cpu, wall = (at - self._since).tolist()
        try:
            yield cpu, wall
        finally:
            self._since += self._now() - at


class MarkEvaluation:
    """Callback of Stable-Baselines3 that evaluates the policy at each mark.

    It is called after each step and before the update from it, so that at the first step beyond a
    mark the policy was learnt from at most that many steps.  Learning ends after the last mark.
    """

    def __init__(self, trial: Trial, model: Any) -> None:
        self.trial, self.model = trial, model
        self.env = gym.make(TASKS[trial.task].environment)
        self.task = task_of(self.env)
        self.left = list(trial.marks)
        self.rows: list[dict[str, Any]] = []
        self.watch = Stopwatch()

    def __call__(self, local: dict[str, Any], global_: dict[str, Any]) -> bool:
        """Whether learning is to continue."""
        while self.left and self.model.num_timesteps > self.left[0]:
            with self.watch.paused() as (cpu, wall):
                scores = self.scores()
            self.rows.append(
                {
                    "task": self.trial.task,
                    "learner": self.trial.learner,
                    "seed": self.trial.seed,
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

        scores: dict[str, float] = {}
        about = TASKS[self.trial.task]
        for name in ("stochastic", "greedy"):
            with torch.random.fork_rng(
                devices=[]
            ):  # does not change the random numbers of learning
                torch.manual_seed(integer_seed(self.trial.seed, Purpose.EVALUATION_POLICY))
                score = evaluate(
                    self.env,
                    self.task,
                    NetworkPolicy(
                        self.model, self.task, noise_period(self.trial.settings), name == "greedy"
                    ),
                    restart_probability=RESTART,
                    episodes=about.episodes,
                    steps=about.steps,
                    seed=self.trial.seed,
                )
            scores[name], scores[f"{name}_standard_error"] = score.mean, score.standard_error
        return scores


def run_trial(trial: Trial) -> dict[str, Any]:
    """Learn and evaluate: the description of the trial, one row per mark, and versions."""
    import torch

    torch.set_num_threads(1)
    with blas_threads(1):
        model = model_of(trial)
        evaluation = MarkEvaluation(trial, model)
        # one round of steps beyond the last mark, where the callback ends learning
        model.learn(trial.marks[-1] + model.n_envs, callback=evaluation)
    names = ("gymnasium", "stable-baselines3", "torch")
    return {
        "trial": trial.description(),
        "command": trial.command(),
        "versions": {**versions(), **{name: version(name) for name in names}},
        "rows": evaluation.rows,
    }


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
