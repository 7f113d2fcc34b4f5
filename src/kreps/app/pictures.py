"""Pictures of a run folder: learning curve, policy maps, film and the page of the diagnosis.

Matplotlib is imported only where a picture is drawn, so that other commands start quickly.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from pathlib import Path

from kreps.app.console import console, say
from kreps.app.diagnosis import Finding
from kreps.app.environments import (
    Labels,
    environment_of,
    labels_of,
    literal,
    metadata_of,
    references_of,
)
from kreps.app.prediction import predicted_states
from kreps.app.recording import record
from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError
from kreps.learning.environment import environment_for
from kreps.learning.methods import KREPS
from kreps.learning.policy import Policy
from kreps.learning.wrappers import Environment

SHOWN_LENGTHS = 2.0
"""Steps over which rollouts are drawn, in mean lengths of a training rollout."""


def draw_run(folder: RunFolder, learner: KREPS) -> list[Path]:
    """Draw the learning curve, evaluated rollouts over time, and maps for two-dimensional states.

    The rollouts are those of the latest evaluation, so the environment does not move.

    Raises:
        ConfigurationError: the run has no iteration yet.
    """
    from kreps import plotting
    from kreps.app.plots.learning_curve import learning_curve
    from kreps.app.plots.policy_maps import policy_maps

    assert learner.env is not None
    rows, config = folder.recorded_rows(), folder.config()
    evaluation = folder.evaluation(learner.state.iteration)
    with console().status("drawing ..."):
        curve = learning_curve(rows, references_of(config), evaluation, literal(config.environment))
        drawn = [plotting.save(curve, folder.path / "learning_curve.png")]
        labels = labels_of(learner.env, learner.task)
        drawn += _draw_trajectories(folder, learner, labels)
        if learner.task.state_size == 2:
            maps = policy_maps(learner.state, learner.task, labels)
            drawn.append(plotting.save(maps, folder.path / "policy_maps.png"))
    return drawn


def _draw_trajectories(folder: RunFolder, learner: KREPS, labels: Labels) -> list[Path]:
    from kreps import plotting
    from kreps.app.plots.trajectories import trajectories

    rollouts = folder.evaluation_rollouts(learner.state.iteration)
    if rollouts is None:
        say(f"no rollouts to draw over time: `kreps evaluate {folder.path}` records them")
        return []
    rollouts.check(learner.task)
    longest = float(rollouts.lengths.max())
    steps = ceil(min(SHOWN_LENGTHS / learner.restart_probability, longest))
    predicted = predicted_states(learner, rollouts[0].observations[0], steps)
    title = f"{literal(folder.config().environment)}, iteration {learner.state.iteration}"
    figure = trajectories(rollouts, predicted, steps, learner.policy.process, labels, title)
    return [plotting.save(figure, folder.path / "trajectories.png")]


def film_run(
    folder: RunFolder,
    learner: KREPS,
    steps: int = 120,
    *,
    stochastic: bool = False,
    seed: int = 0,
    out: Path | None = None,
) -> Path:
    """Film a rollout of the learnt policy in a new environment.

    Args:
        folder: of the run.
        learner: with at least one update.  Its own environment, if it has one, is not used and
            should be closed: the two may be the same robot.
        steps: largest length of the rollout.
        stochastic: whether the policy acts with its exploration noise.
        seed: of the rollout.
        out: a ``.gif`` file; ``video.gif`` in the run if None.

    Raises:
        ConfigurationError: ``out`` does not end in ``.gif``, or the environment cannot be made, is
            not that of the learner, or has no pictures among its render modes.
        EnvironmentFailure: the environment raised, or returned no picture.
        StorageError: the film cannot be written.
    """
    from kreps.app.plots.film import check_film_name, film

    path = out or folder.path / "video.gif"
    check_film_name(path)
    if learner.env is not None:
        _require_pictures(learner.env)  # so that no other one is made in vain
    policy, task = Policy(learner.policy.process, seed), learner.task
    with console().status("filming ..."):
        with environment_of(folder.config(), render_mode="rgb_array") as env:
            _require_pictures(env)
            inside = environment_for(env, task, learner.settings.restart_probability)
            recording = record(inside, policy, steps, seed, deterministic=not stochastic)
            labels = labels_of(inside, task)
        return film(recording, learner.state, task, labels, path)


def _require_pictures(env: Environment) -> None:
    """Raise `ConfigurationError` if the environment names its render modes and none are arrays."""
    modes = metadata_of(env).get("render_modes")
    if isinstance(modes, list | tuple) and modes and "rgb_array" not in modes:
        raise ConfigurationError(
            f"the environment draws no pictures: its render_modes are {modes}, and a film needs "
            '"rgb_array"'
        )


def draw_diagnosis(folder: RunFolder, findings: Sequence[Finding], path: Path) -> Path:
    """Draw the page of the diagnosis."""
    from kreps import plotting
    from kreps.app import diagnosis_page

    config = folder.config()
    title = literal(f"{config.environment}, {folder.path}")
    page = diagnosis_page.page(folder.recorded_rows(), findings, references_of(config), title)
    return plotting.save(page, path)
