"""One trial of the comparison with Stable-Baselines3: settings, learning and evaluation.

`peers.py` describes the protocol and runs the trials.
"""

from __future__ import annotations

import io
import json
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from kreps.data.task import TaskSpec
from kreps.envs import RandomRestart
from kreps.experiments.specs import TASKS as OURS
from kreps.kernels.arrays import FloatArray
from kreps.kernels.threads import blas_threads
from kreps.learning.environment import Environment, task_of
from kreps.learning.evaluate import EPISODES, STEPS, evaluate
from kreps.seeding import Purpose, integer_seed
from kreps.versions import versions

RESTART = 0.02
MARKS = (3000, 5000, 8000)
LEARNERS = ("sac", "ppo")


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
    # the first environment has this seed, the others the following ones
    seed = integer_seed(trial.seed, Purpose.ENVIRONMENT)
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
            # the evaluation must not change the random numbers of learning
            with torch.random.fork_rng(devices=[]):
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
