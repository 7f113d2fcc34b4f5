"""The learnt policy as users have it: predict, save, load, compress, export."""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kreps.data.history import first_lags, next_lags, states_of
from kreps.data.rollouts import Rollout
from kreps.errors import ConfigurationError, DataError
from kreps.intake import as_flags, as_numbers
from kreps.kernels.arrays import FloatArray, IntArray, default_errstate
from kreps.learning import storage
from kreps.learning.extrapolation import Extrapolation, extrapolation_of
from kreps.learning.storage.c_source import write_c
from kreps.learning.storage.onnx import write_onnx
from kreps.policies.base import LearntPolicy
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.sparse_gp import SparseGP
from kreps.seeding import Purpose, generator


@dataclass(frozen=True)
class PolicyState:
    """What `Policy.predict` returns as state, of m observations.

    Attributes:
        lags: (m, ds - do) observations and actions before the next decision, the newest first
            (`kreps.data.history`).
        commanded: (m, da) actions that are held, before clipping.
        left: (m,) calls in which each is still to be returned.
    """

    lags: FloatArray
    commanded: FloatArray
    left: IntArray


class Policy:
    """A learnt stochastic policy, with Stable-Baselines3's signature of `predict`.

    Args:
        process: the distribution of actions, for KREPS a cost-sensitive Gaussian process.
        seed, iteration: address the exploration noise in `predict`.  Policies of one seed explore
            with the same numbers unless their iterations differ.
    """

    def __init__(self, process: LearntPolicy, seed: int = 0, iteration: int = 0) -> None:
        self.process = process
        self.seed = seed
        self.iteration = iteration
        self._noise = generator(seed, Purpose.PREDICT, iteration)

    @property
    def action_repeat(self) -> int:
        """Steps of the environment for which the policy was learnt to hold each action."""
        return self.process.task.action_repeat

    @default_errstate()
    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], Any]:
        """Actions for one observation or several, clipped to the task's limits.

        Args:
            observation: one as the environment gives it, or several along a first axis; or one or
                several that are flattened, (ds,) or (m, ds).
            state: what the previous call returned; None begins an episode.  With it, an action is
                held for `action_repeat` steps, and the policy knows the observations and actions
                of the steps before, as one that was learnt with ``delay`` or ``history`` has to.
            episode_start: flag, or (m,) flags, of a new episode, of which ``state`` is not used.
            deterministic: whether to leave out the exploration noise (the mean of a Gaussian
                process).

        Returns:
            Action in the task's units, of the shape and the type of numbers that the environment
            takes ((da,) of float64 for a `TaskSpec`), or actions along a first axis; and the state
            for the next call, which is ``state`` unchanged where no action is held for longer than
            a step and the policy needs no earlier steps.

        Raises:
            DataError: another shape, NaN or infinities, or a state of other calls.
            NumericalError: the action is NaN or infinite; it is not handed out.
        """
        task = self.process.task
        remedy = "no action is defined for it, so check the sensors"
        observations = as_numbers("observations", observation, remedy)
        observed, single = task.given_spaces.states(observations)
        if self.action_repeat == 1 and task.state_size == task.observation_size:
            commanded = self._decided(observed, deterministic)
        else:
            state = self._continued(observed, state, episode_start, deterministic)
            commanded = state.commanded
        applied = task.clip(commanded)
        return task.given_spaces.actions(applied[0] if single else applied), state

    def _decided(self, states: FloatArray, deterministic: bool) -> FloatArray:
        """Commanded actions (m, da) in states (m, ds)."""
        if deterministic:
            return self.process.greedy(states)
        noise = self._noise.standard_normal((len(states), self.process.task.action_size))
        return self.process.act(states, noise)

    def _continued(
        self, observed: FloatArray, state: Any, episode_start: Any, deterministic: bool
    ) -> PolicyState:
        """The actions at observations (m, do): held ones, and new ones where none is left."""
        task, count, first = (
            self.process.task,
            len(observed),
            first_lags(observed, self.process.task),
        )
        if state is None:
            state = PolicyState(
                first, np.zeros((count, task.action_size)), np.zeros(count, np.intp)
            )
        if not isinstance(state, PolicyState) or state.lags.shape != first.shape:
            raise DataError(
                f"state = {state!r:.60}, but what predict returned for as many observations before "
                "is needed; pass None at the start"
            )
        started = False if episode_start is None else as_flags("episode_start", episode_start)
        try:
            started = np.broadcast_to(started, count)
        except ValueError as error:
            raise DataError(
                f"episode_start has shape {np.shape(episode_start)}, but a flag for each of "
                f"{count} observations is needed"
            ) from error
        new = started | (state.left == 0)
        lags = np.where(started[:, None], first, state.lags)
        commanded, left = state.commanded.copy(), state.left.copy()
        if new.any():
            known = observed[new], lags[new]
            commanded[new] = self._decided(states_of(*known, task), deterministic)
            left[new] = self.action_repeat
            lags[new] = next_lags(*known, task.scaled_applied(commanded[new]), task)
        return PolicyState(lags, commanded, left - 1)

    def save(self, path: str | Path) -> None:
        """Write the policy to a file; read it with `kreps.load_policy`."""
        storage.save_policy(self.process, path)

    @default_errstate()
    def compressed(self, centres: int) -> Policy:
        """A sparse approximation of this policy, which is smaller and predicts faster.

        It is fitted to all samples of this policy.  Far from its centres the exploration noise is
        that of the prior.  Evaluate it to see what the approximation costs in reward, as
        ``benchmarks/predict.py`` does.

        Args:
            centres: largest number of support points.

        Returns:
            A policy with the same address of its noise, or this policy if it has no more centres.

        Raises:
            ConfigurationError: fewer than one centre, or the policy is no Gaussian process.
        """
        try:
            count = operator.index(centres)
        except TypeError as error:
            raise ConfigurationError(
                f"centres = {centres!r:.40}, but a whole number is needed, such as 50"
            ) from error
        if count < 1:
            raise ConfigurationError(
                f"centres = {count}, but at least one is needed; 50 are often enough"
            )
        process = self.process
        if not isinstance(process, CostSensitiveGP | SparseGP):
            raise ConfigurationError(_no_process(process, "compress"))
        few = process.compressed(count)
        return self if few is process else Policy(few, self.seed, self.iteration)

    @default_errstate()
    def extrapolation(self, rollouts: Iterable[Rollout]) -> Extrapolation:
        """How far this policy goes beyond recordings of another controller.

        Args:
            rollouts: of the recorded controller, such as those that the policy was learnt from.

        Returns:
            Effective sample size of the steps, and the share of the actions outside the data.

        Raises:
            ConfigurationError: the policy is no Gaussian process.
            DataError: no rollout, or widths that are not the task's.
        """
        process = self.process
        if not isinstance(process, CostSensitiveGP | SparseGP):
            raise ConfigurationError(_no_process(process, "compare"))
        rng = generator(self.seed, Purpose.EXTRAPOLATION, self.iteration)
        return extrapolation_of(process, rollouts, rng)

    @default_errstate()
    def export_onnx(self, path: str | Path, dtype: str = "float64") -> str:
        """Write an ONNX model of the policy without exploration, for controllers in any language.

        Its input is ``observation`` (batch, do).  Its outputs are ``action`` (batch, da), the mean
        clipped to the task's limits, and ``standard_deviation`` (batch, da) of the commanded
        action, both in the task's units.  A policy that needs earlier steps has also the input
        ``lags`` and the output ``next_lags`` (batch, h do + k da), which is the next input: once
        per decision, not per control period (docs/delays.md).  The metadata have
        ``action_repeat``, the control periods (of ``dt`` in s) for which the controller has to hold
        an action.  If an observation or a result is NaN or infinite, the model ends with an error
        in place of an action.
        `kreps.check_file` tells whether a copy of the model is undamaged.

        Args:
            path: such as ``policy.onnx``; the folder must exist.
            dtype: "float64" or "float32", of input and outputs.  The model computes in the same
                type, unless float32 could change the mean by 1e-4 of the action scale; then it
                computes in float64.  For compressed policies float32 is accurate enough.

        Returns:
            The type that the model computes in.

        Raises:
            ConfigurationError: ONNX is not installed (``pip install 'kreps[onnx]'``), or the
                policy is no Gaussian process.
            StorageError: the file cannot be written.
        """
        return write_onnx(self._sparse(), path, dtype)

    @default_errstate()
    def export_c(self, path: str | Path, dtype: str = "float64") -> str:
        """Write C99 source of the policy without exploration, for controllers without a library.

        Beside ``NAME.c`` is its header, ``NAME.h``.  The function ``NAME_act`` gives the mean
        action (da,), clipped to the task's limits, from the observation (do,), both in the task's
        units (docs/how_to/export.md).  A policy that needs earlier steps also has ``lags``, an
        array of h do + k da numbers, which ``NAME_start`` sets at the start of an episode and
        ``NAME_act`` updates: once per decision, not per control period (docs/delays.md).

        Args:
            path: such as ``arm_policy.c``; the folder must exist.
            dtype: "float64" for ``double`` or "float32" for ``float``, of arguments and results.
                The arithmetic is of the same type, unless float32 could change the mean by 1e-5 of
                the action scale; then it is in ``double``.

        Returns:
            The dtype of the arithmetic.

        Raises:
            ConfigurationError: the policy is no Gaussian process, or the name of the file cannot
                begin the name of a function.
            StorageError: a file cannot be written.
        """
        return write_c(self._sparse(), path, dtype)

    def _sparse(self) -> SparseGP:
        """The process on few centres, as it is exported.

        Raises:
            ConfigurationError: this is no Gaussian process.
        """
        process = self.process
        if isinstance(process, CostSensitiveGP):
            process = process.predictor
        if not isinstance(process, SparseGP):
            raise ConfigurationError(_no_process(process, "export"))
        return process


def _no_process(process: LearntPolicy, verb: str) -> str:
    return (
        f"cannot {verb} a policy of type {type(process).__name__}, only Gaussian processes; "
        "learn one with kreps.KREPS, or use Policy.save"
    )


def mean_difference(exact: Policy, compressed: Policy) -> float:
    """Root mean square difference of the actions of two policies, without exploration.

    It is taken at the support points of the exact policy, after clipping, in units of the action
    scale.
    """
    process = exact.process
    assert isinstance(process, CostSensitiveGP | SparseGP)
    a, b = (process.task.clip(p.process.greedy(process.states)) for p in (exact, compressed))
    return float(np.sqrt(np.mean(((a - b) / process.task.action_scale) ** 2)))


def load_policy(path: str | Path, seed: int = 0) -> Policy:
    """A policy saved by `Policy.save`.

    Args:
        path: of the file.
        seed: of the exploration noise in `Policy.predict`.  Who loads the policy anew after each
            update needs a new seed each time, or explores with the same numbers again.

    Raises:
        StorageError: the file is missing, damaged or not a policy.
    """
    return Policy(storage.load_policy(path), seed)
