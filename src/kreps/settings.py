"""The settings of each learner, with their defaults and ranges; `kreps.sections` has the parts."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf
from numbers import Integral, Real
from typing import Literal

from kreps.checks import MAX_ACTION_REPEAT, MAX_COUNT, MAX_LAGS, MAX_WHOLE_NUMBER, Checked
from kreps.errors import ConfigurationError, shown
from kreps.sections import RKHS as RKHS
from kreps.sections import Exploration as Exploration
from kreps.sections import Grid as Grid
from kreps.sections import LowRank as LowRank
from kreps.sections import ModelBased as ModelBased
from kreps.sections import Noise as Noise

TransitionModelName = Literal["dynamics", "change", "embedding", "sample"]
RolloutLengths = Literal["independent", "stratified"]
PolicyFitName = Literal["map", "bounded", "free"]
CrossValidation = Literal["samples", "rollouts"]
TemperatureUnit = Literal["reward", "q"]
LipschitzUnit = Literal["standardised", "raw"]

USUAL_RESTART_PROBABILITY = 0.02
"""That of the paper, with rollouts of 49 steps on average."""


@dataclass(frozen=True)
class LearnerSettings(Checked):
    """The settings that all learners have.

    Attributes:
        restart_probability: p, with which the process restarts at each step, in [1e-9, 1).  None
            is 0.02, and 0.005 once an episode has terminated.
        window: largest number of rollouts in the replay window, a third of them reserved for those
            with a state-dependent reward.  None keeps all.
        window_steps: smallest number of steps in the window, for which more rollouts are kept than
            ``window``: rollouts that terminate early have few.
    """

    restart_probability: float | None = 0.02
    window: int | None = 30
    window_steps: int = 0

    def __post_init__(self) -> None:
        if self.restart_probability is not None:
            limit = "at least 1e-9 and below 1, or None for the default"
            self._check("restart_probability", Real, limit, lambda v: 1e-9 <= v < 1)
        whole = f"a whole number from 0 to {MAX_WHOLE_NUMBER}"
        self._check("window_steps", Integral, whole, lambda v: 0 <= v <= MAX_WHOLE_NUMBER)
        if self.window is not None:
            whole = f"a whole number from 1 to {MAX_WHOLE_NUMBER}, or None to keep all"
            self._check("window", Integral, whole, lambda v: 1 <= v <= MAX_WHOLE_NUMBER)

    @property
    def p(self) -> float:
        """The restart probability; 0.02 where a learner is still to choose it."""
        given = self.restart_probability
        return USUAL_RESTART_PROBABILITY if given is None else given


@dataclass(frozen=True)
class OnPolicySettings(LearnerSettings):
    """The settings of learners that collect rollouts with their own policy (Sec. 4.1).

    Those of `LearnerSettings`, and:

    Attributes:
        exploration: the policy of the first rollouts.
        initial_rollouts: number of rollouts before the first update.  None is 3 if batches grow and
            30 if not.
        rollouts_per_iteration: number of rollouts before each later update.  They are made with the
            current policy; or with bang-bang actions of red noise, if the reward of none of the
            newest rollouts depends on the state.
        growth: if positive, batches are counted in environment steps and grow with the data: each
            later update has new steps of this share of those seen so far, but at least as many as
            two mean rollouts and at most as many as ``rollouts_per_iteration``.  No rollout is
            longer than two mean rollouts, and more of them are made where episodes end early, up
            to ten times as many.  None is 0.25, and 0 where observations are images.
        rollout_lengths: how the lengths are drawn, which are (1 - p) / p steps on average before
            any limit.
            ``"independent"``: each by itself, as printed.  ``"stratified"``: each from the same
            distribution, but one from each of R equally likely ranges for R rollouts, so that
            their total varies less.
    """

    exploration: Exploration = field(default_factory=Exploration)
    initial_rollouts: int | None = 30
    rollouts_per_iteration: int = 10
    growth: float | None = 0.0
    rollout_lengths: RolloutLengths = "independent"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._section("exploration", Exploration)
        self._choose("rollout_lengths", RolloutLengths)
        self._whole("rollouts_per_iteration", largest=MAX_COUNT)
        if self.initial_rollouts is not None:
            self._whole("initial_rollouts", largest=MAX_COUNT)
        if self.growth is not None:
            self._check("growth", Real, "finite and >= 0, or None", lambda v: 0 <= v < inf)


@dataclass(frozen=True)
class Settings(OnPolicySettings):
    """The parameters of REPS with RKHS embeddings; the defaults are the preset ``"model_based"``.

    Those of `OnPolicySettings`, and:

    Attributes:
        action_repeat: steps of the environment for which an action is held; those that are held
            together are one step for the learner, with the sum of their rewards.  None is chosen
            from the control period, by `kreps.learning.timescale.action_repeat`.
        delay: number of earlier actions in a state (docs/delays.md).
        history: number of earlier steps, with observation and action, in a state; ``"auto"``
            chooses both by held-out error.
        kl_bound: epsilon of Eq. 2 in nats: largest relative entropy between the state-action
            distribution after an update and that of the samples.
        eta_floor: smallest temperature, in standard deviations of the reward.  Near convergence the
            optimal temperature falls to zero, and the update would fit noise until the KL bound is
            met; with a floor the bound may stay slack.  0 leaves a numerical safeguard of 1e-6.
            None is 0.01 with an acceptance test and 0.05 without.
        ridge: rho times the number of samples: the larger, the softer the stationarity constraint.
            None is the mean squared leave-one-out error of the transition model in feature space,
            but at least 0.001, so that the constraint is as strict as predictions are accurate.
        exploring_starts: share of the restarts in the model of an update that lead to any of the
            sampled states instead of the start states, so that V is also learnt off the usual
            path.  The same share of model rollouts begins there.  Rollouts in the environment
            always begin where the environment starts them.
        model: transition model.  ``"dynamics"`` regresses the change of the state, after a linear
            mean, and evaluates V's features at the predicted successor; ``"change"`` embeds the
            change of the features, so that far from the data the state stays; ``"embedding"``
            embeds the features of the successor, as printed (Eq. 4); ``"sample"`` uses the
            observed successor.
        policy_fit: hyper-parameters of the policy by held-out density, ``"map"`` with priors,
            ``"bounded"`` within hard ranges, or ``"free"`` without either.
        cross_validation: what the fits hold out.  ``"samples"``: one at a time; the lengthscales of
            V are median distances.  ``"rollouts"``, as in the authors' scripts: every second
            rollout for V, whose lengthscales have the smallest temporal-difference error, and for
            the embedding, which has the kernel of V; one rollout at a time for the policy.
        value: where the features of V come from: `RKHS` or `Grid`.
        low_rank: `LowRank`, or None for an exact update whatever the number of samples.
        model_based: `ModelBased`, or None: the paper's single step on the sampled actions.
    """

    restart_probability: float | None = None
    initial_rollouts: int | None = None
    growth: float | None = None
    window_steps: int = 2_500
    rollout_lengths: RolloutLengths = "stratified"
    action_repeat: int | None = None
    delay: int = 0
    history: int | Literal["auto"] = 0
    kl_bound: float = 1.0
    eta_floor: float | None = None
    ridge: float | None = None
    exploring_starts: float = 0.25
    model: TransitionModelName = "dynamics"
    policy_fit: PolicyFitName = "map"
    cross_validation: CrossValidation = "samples"
    value: RKHS | Grid = field(default_factory=RKHS)
    low_rank: LowRank | None = field(default_factory=LowRank)
    model_based: ModelBased | None = field(default_factory=ModelBased)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._choose("model", TransitionModelName)
        self._choose("policy_fit", PolicyFitName)
        self._choose("cross_validation", CrossValidation)
        self._positive("kl_bound")
        if self.action_repeat is not None:
            limit = f"a whole number from 1 to {MAX_ACTION_REPEAT}, or None to choose it"
            self._check("action_repeat", Integral, limit, lambda v: 1 <= v <= MAX_ACTION_REPEAT)
        lags = f'a whole number from 0 to {MAX_LAGS}, or history="auto" to choose both'
        for name in ("delay", "history") if self.history != "auto" else ("delay",):
            self._check(name, Integral, lags, lambda v: 0 <= v <= MAX_LAGS)
        if self.ridge is not None:
            self._check("ridge", Real, "positive and finite, or None", lambda v: 0 < v < inf)
        if self.eta_floor is not None:
            self._check("eta_floor", Real, "finite and >= 0, or None", lambda v: 0 <= v < inf)
        self._check("exploring_starts", Real, "in [0, 1]", lambda v: 0 <= v <= 1)
        self._section("value", RKHS, Grid)
        self._section("low_rank", LowRank, type(None))
        self._section("model_based", ModelBased, type(None))
        if self.cross_validation == "rollouts" and (self.low_rank or self.model == "dynamics"):
            raise ConfigurationError(
                f'cross_validation = "rollouts" with model = "{self.model}" and low_rank = '
                f"{self.low_rank}, but it is of the embedding and of exact updates; start from "
                'preset="authors", or set model="embedding", model_based=None and low_rank=None'
            )
        if self.model == "sample" and (self.model_based is not None or self.ridge is None):
            raise ConfigurationError(
                f'model = "sample" with model_based = {self.model_based} and ridge = {self.ridge}, '
                "but without a learnt model no sample can be generated and no ridge be estimated; "
                'start from preset="single_step", or set model_based=None and ridge=0.1'
            )


@dataclass(frozen=True)
class ValueIterationSettings(OnPolicySettings):
    """The parameters of on-policy value iteration with RKHS embeddings.

    Those of `OnPolicySettings`, and:

    Attributes:
        temperature: of the softmax.
        temperature_unit: ``"reward"``: standard deviations of the reward, and V is the soft maximum
            at the same temperature; ``"q"``: standard deviations of Q over the candidates of each
            state, and V is the maximum, as in the authors' scripts.
        actions: candidate actions, evenly spaced over the range: the largest number of levels
            per dimension whose product does not exceed this.
        known_reward: whether the reward function of the environment's batch model is used, in place
            of the observed rewards; only with ``temperature_unit="q"``.
        cross_validation: what the fits hold out, as in `Settings`.
    """

    temperature: float = 1.0
    temperature_unit: TemperatureUnit = "reward"
    actions: int = 25
    known_reward: bool = False
    cross_validation: CrossValidation = "samples"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive("temperature")
        self._choose("temperature_unit", TemperatureUnit)
        self._choose("cross_validation", CrossValidation)
        _check_known_reward(self)
        self._whole("actions", largest=6000)  # as many as the file of a policy may hold


@dataclass(frozen=True)
class GridValueIterationSettings(LearnerSettings):
    """The parameters of off-policy value iteration on a grid of state-action pairs.

    Those of `LearnerSettings`, and the following.  A grid point is a rollout of one step, and the
    window holds the newest of them.

    Attributes:
        ranges: smallest and largest value of each observation coordinate on the grid; None takes
            those of the observation space.  The range of an angle is always a whole turn.
        actions: candidate actions of the maximisation, as in `ValueIterationSettings`.
        grid_states: grid points per state coordinate; one number, or one for each coordinate.
        grid_actions: grid points per action coordinate.
        temperature: as in `ValueIterationSettings`; 0, as exploration is not needed, for the
            maximum in place of the soft maximum.
        temperature_unit: as in `ValueIterationSettings`.
        known_reward: as in `ValueIterationSettings`.
        cross_validation: as in `ValueIterationSettings`.
    """

    window: int = 6000
    ranges: tuple[tuple[float, float], ...] | None = None
    actions: int = 25
    grid_states: int | tuple[int, ...] = 15
    grid_actions: int = 7
    temperature: float = 0.0
    temperature_unit: TemperatureUnit = "reward"
    known_reward: bool = False
    cross_validation: CrossValidation = "samples"

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.grid_states, tuple | list):
            self._counts("grid_states", largest=MAX_COUNT)
        else:
            self._whole("grid_states", largest=MAX_COUNT)
        self._whole("grid_actions", largest=MAX_COUNT)
        self._whole("actions", largest=6000)
        self._check("temperature", Real, "finite and >= 0", lambda v: 0 <= v < inf)
        self._choose("temperature_unit", TemperatureUnit)
        self._choose("cross_validation", CrossValidation)
        _check_known_reward(self)
        if self.ranges is not None:
            try:
                ranges = tuple((float(low), float(high)) for low, high in self.ranges)
            except (TypeError, ValueError):
                ranges = ((1.0, 0.0),)
            if not all(-float("inf") < low < high < float("inf") for low, high in ranges):
                raise ConfigurationError(
                    f"ranges = {shown(self.ranges)}, but it must be a pair (smallest, largest) of "
                    "finite numbers for each observation coordinate"
                )
            object.__setattr__(self, "ranges", ranges)


def _check_known_reward(settings: ValueIterationSettings | GridValueIterationSettings) -> None:
    """Raise `ConfigurationError` unless the settings about rewards and temperature agree."""
    settings._flag("known_reward")
    if settings.temperature_unit == "reward" and settings.known_reward:
        raise ConfigurationError(
            'known_reward = True with temperature_unit = "reward", but a known reward is part of '
            'the authors\' value iteration; set temperature_unit="q", or start from '
            'preset="authors"'
        )
    if settings.temperature_unit == "q" and settings.temperature == 0.0:
        raise ConfigurationError(
            'temperature = 0.0 with temperature_unit = "q", but the softmax needs a positive one; '
            "a small one, such as 0.05, is nearly the maximum"
        )


@dataclass(frozen=True)
class NPALPSettings(OnPolicySettings):
    """The parameters of non-parametric approximate linear programming.

    Those of `OnPolicySettings`, and:

    Attributes:
        lipschitz: Lipschitz constant of V.
        lipschitz_unit: ``"standardised"``: standard deviations of the reward per median distance of
            states; ``"raw"``: units of the reward per unit of distance, with all coordinates in
            their own units, as in the authors' scripts.
        noise_fraction: share of the actions to which exploration noise is added, in [0, 1].
        noise_scale: standard deviation of that noise, in units of half the range.
    """

    lipschitz: float = 10.0
    lipschitz_unit: LipschitzUnit = "standardised"
    noise_fraction: float = 0.3
    noise_scale: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive("lipschitz", "noise_scale")
        self._choose("lipschitz_unit", LipschitzUnit)
        self._check("noise_fraction", Real, "in [0, 1]", lambda v: 0 <= v <= 1)
