"""A search of settings with Optuna: settings are sampled, learnt with, and pruned by reward.

A study is a file, which several processes can share: each takes the next trial.  The settings of
trial i are drawn from the study's trials so far by a generator addressed by the seed and i, so a
study by one process is the same again with the same seed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kreps.app.console import say
from kreps.app.run_folder import RunConfig
from kreps.errors import ConfigurationError, KrepsError
from kreps.learning.callbacks import EvalCallback
from kreps.learning.environment import batch_model_of
from kreps.learning.evaluate import STEPS
from kreps.learning.methods import KREPS
from kreps.learning.wrappers import Environment
from kreps.presets import flat, settings_of
from kreps.seeding import Purpose, integer_seed

Study = Any
"""``optuna.Study``; Optuna is imported where a study is opened."""

JOURNAL = "study.log"
"""The file of a study in its folder."""

NAME = "kreps"
"""Of the study, as tools of Optuna show it."""

EPISODES, FEW_EPISODES = 20, 10
"""Rollouts of an evaluation; the few where the environment has no batch model."""

UNPRUNED = 5
"""Trials that are complete before one is pruned."""


@dataclass(frozen=True)
class Interval:
    """Numbers from ``low`` to ``high``; ``log``: evenly by their logarithm; ``whole``: integers."""

    low: float
    high: float
    log: bool = False
    whole: bool = False

    def sampled(self, trial: Any, name: str) -> Any:
        if self.whole:
            return trial.suggest_int(name, int(self.low), int(self.high), log=self.log)
        return trial.suggest_float(name, self.low, self.high, log=self.log)

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values that must be valid."""
        return tuple(int(each) if self.whole else each for each in (self.low, self.high))


@dataclass(frozen=True)
class Choice:
    """One of some values."""

    values: tuple[Any, ...]

    def sampled(self, trial: Any, name: str) -> Any:
        return trial.suggest_categorical(name, self.values)

    @property
    def ends(self) -> tuple[Any, ...]:
        """Values that must be valid."""
        return self.values


Space = Mapping[str, Interval | Choice]

DEFAULT_SPACE: Space = {
    "kl_bound": Interval(0.2, 3.0, log=True),
    "exploring_starts": Interval(0.0, 0.5),
    "exploration.noise": Choice(("bang-bang", "gaussian", "pink")),
    "model_based.exploration_bonus": Interval(0.0, 0.3),
    "model_based.proposal_std_scale": Interval(1.0, 1.5),
}
"""Settings that change neither the number of steps of an iteration nor what is evaluated."""


def space_for(config: RunConfig, given: Space) -> Space:
    """The space of a study: what is given, or `DEFAULT_SPACE` without what is fixed or absent.

    Raises:
        ConfigurationError: a setting that is unknown, fixed as well, or out of range.
    """
    fixed = settings_of(config.preset, **config.settings)
    if not given:
        free = {*flat(fixed)} - {*config.settings}
        given = {name: each for name, each in DEFAULT_SPACE.items() if name in free}
    for name, each in given.items():
        if name in config.settings:
            raise ConfigurationError(
                f"{name} is fixed to {config.settings[name]!r:.40} and searched as well; leave out "
                "one of them"
            )
        for value in each.ends:
            settings_of(config.preset, **{**config.settings, name: value})
    return given


def open_study(folder: Path, config: RunConfig, seeds: int, space: Space) -> Study:
    """The study of a folder, a new one unless there is one.

    Raises:
        ConfigurationError: Optuna is not installed, or the folder has a study of something else.
    """
    try:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend
    except ImportError as error:
        raise ConfigurationError(
            "tuning needs Optuna, which is not installed: pip install 'kreps[tune]'"
        ) from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(folder / JOURNAL))),
        study_name=NAME,
        direction="maximize",
        pruner=optuna.pruners.MedianPruner(UNPRUNED, n_warmup_steps=config.iterations // 4),
        load_if_exists=True,
    )
    content = {**asdict(config), "seeds": seeds, "space": {n: asdict(e) for n, e in space.items()}}
    content = json.loads(json.dumps(content))
    known = study.user_attrs.get("config", content)
    if known != content:
        changed = [name for name in content if content[name] != known.get(name)]
        raise ConfigurationError(
            f"the study in {folder} has another {' and '.join(changed)}; give what it was begun "
            "with, or choose another folder"
        )
    study.set_user_attr("config", content)
    return study


def run_study(
    study: Study, trials: int, config: RunConfig, seeds: int, space: Space, env: Environment
) -> None:
    """Make trials until the study has so many that are finished, those of other processes included.

    A trial whose learning ends in an error of kreps counts as failed, and not among the finished.

    Args:
        study: of `open_study`.
        trials: number of finished trials, complete or pruned.
        config: of the runs.
        seeds: learners of a trial; their seeds count up from that of the configuration.
        space: of the settings.
        env: to learn in.
    """
    from optuna.exceptions import TrialPruned
    from optuna.samplers import TPESampler
    from optuna.trial import TrialState

    def finished() -> int:
        states = (TrialState.COMPLETE, TrialState.PRUNED)
        return len(study.get_trials(deepcopy=False, states=states))

    failures = 0
    while finished() < trials:
        trial = study.ask()
        study.sampler = TPESampler(seed=integer_seed(config.seed, Purpose.TUNING, trial.number))
        settings = {name: each.sampled(trial, name) for name, each in space.items()}
        say(f"trial {trial.number}: {shown(settings)}")
        try:
            value = _learnt(trial, config, seeds, settings, env)
        except TrialPruned as pruned:
            study.tell(trial, state=TrialState.PRUNED)
            say(f"trial {trial.number}: {pruned}")
        except KrepsError as error:
            study.tell(trial, state=TrialState.FAIL)
            say(f"trial {trial.number} failed: {error}")
            failures += 1
            if failures == UNPRUNED:
                raise
        except BaseException:  # Ctrl-C
            study.tell(trial, state=TrialState.FAIL)
            raise
        else:
            study.tell(trial, value)
            say(f"trial {trial.number}: {value:.5g}")


def _learnt(
    trial: Any, config: RunConfig, seeds: int, settings: Mapping[str, Any], env: Environment
) -> float:
    """Average reward per step without noise after the last update, mean over the seeds.

    Raises:
        TrialPruned: after some update it was below the median of the other trials.
    """
    from optuna.exceptions import TrialPruned

    learners = [
        KREPS(
            env,
            seed=config.seed + i,
            preset=config.preset,
            periodic=config.periodic,
            **{**config.settings, **settings},
        )
        for i in range(seeds)
    ]
    episodes = FEW_EPISODES if batch_model_of(env) is None else EPISODES
    evaluation = EvalCallback(episodes=episodes, steps=STEPS)
    value = -np.inf
    for iteration in range(1, config.iterations + 1):
        for learner in learners:
            learner.learn(1, callback=evaluation, progress=False)
        value = float(np.mean([found.mean for _, found in evaluation.evaluations[-seeds:]]))
        trial.report(value, iteration)
        if iteration < config.iterations and trial.should_prune():
            raise TrialPruned(f"pruned after {iteration} updates at {value:.5g}")
    return value


def shown(settings: Mapping[str, Any]) -> str:
    """Settings on one line."""
    return ", ".join(
        f"{name} = {value:.3g}" if isinstance(value, float) else f"{name} = {value}"
        for name, value in settings.items()
    )


def importances(study: Study) -> dict[str, float]:
    """The share of each setting in the variance of the reward, largest first.

    Empty if fewer than two trials are complete, or all have the same reward.
    """
    import optuna

    try:
        found: dict[str, float] = optuna.importance.get_param_importances(study)
    except (RuntimeError, ValueError):
        return {}
    return found


def finished_rows(study: Study) -> Sequence[dict[str, Any]]:
    """Number, state, last reward, updates and settings of each finished trial, the best first.

    Complete trials come before pruned ones.
    """
    rows = []
    for trial in study.get_trials(deepcopy=False):
        if trial.state.name in ("COMPLETE", "PRUNED") and trial.intermediate_values:
            updates = max(trial.intermediate_values)
            rows.append(
                {
                    "trial": trial.number,
                    "state": trial.state.name.lower(),
                    "reward": trial.intermediate_values[updates],
                    "updates": updates,
                    **trial.params,
                }
            )
    return sorted(rows, key=lambda row: (row["state"], -row["reward"]))
