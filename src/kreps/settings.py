"""The settings of each learner, in sections, with their defaults and ranges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, get_args

from kreps.errors import ConfigurationError, shown

TransitionModelName = Literal["dynamics", "change", "embedding", "sample"]
RolloutLengths = Literal["independent", "stratified"]
PolicyFitName = Literal["map", "bounded"]
AngleWrap = Literal["discontinuous", "continuous"]
Noise = Literal["bang-bang", "gaussian", "pink"]


MOST = 100_000
"""Largest number of rollouts, grid points per coordinate or candidate actions: all are made."""

LARGEST = 10**15
"""Largest whole number elsewhere, where it only limits others."""


class Checked:
    """Checks of single fields, for the frozen dataclasses below.

    Each raises `ConfigurationError` with the value and what it must be.
    """

    def _choose(self, name: str, kind: Any) -> None:
        if getattr(self, name) not in get_args(kind):
            raise ConfigurationError(
                f"{name} = {shown(getattr(self, name))} is unknown; choose one of "
                + ", ".join(repr(choice) for choice in get_args(kind))
            )

    def _positive(self, *names: str) -> None:
        for name in names:
            self._check(name, Real, "positive and finite", lambda v: 0 < v < inf)

    def _whole(self, *names: str, most: int = LARGEST) -> None:
        for name in names:
            limit = f"a whole number from 1 to {most}"
            self._check(name, Integral, limit, lambda v: 1 <= v <= most)

    def _check(self, name: str, kind: type, limit: str, holds: Callable[[Any], bool]) -> None:
        """Accept numbers of any type, NumPy's included, and store them as Python's."""
        value = getattr(self, name)
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        if is_number and kind is Real:
            try:
                value = float(value)
            except OverflowError:  # a whole number that is too large for a float
                value = inf
        if not (is_number and holds(value)):
            raise ConfigurationError(f"{name} = {shown(value)}, but it must be {limit}")
        object.__setattr__(self, name, int(value) if kind is Integral else value)

    def _section(self, name: str, *kinds: type) -> None:
        value = getattr(self, name)
        if not isinstance(value, kinds):
            names = ["None" if k is type(None) else f"kreps.{k.__name__}(...)" for k in kinds]
            raise ConfigurationError(
                f"{name} = {shown(value)}, but it must be {' or '.join(names)}; "
                f'to change one field, write {{"{name}.field": value}}'
            )


# ---- sections ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Exploration(Checked):
    """The policy of the first rollouts, before one has been learnt.

    Attributes:
        noise: ``"bang-bang"``: each action coordinate is at its lower or upper limit, with equal
            probability; ``"gaussian"``: independent normal numbers; ``"pink"``: normal numbers with
            the power spectrum 1 / f, so that actions are correlated over time.
        scale: standard deviation of normal numbers, in units of half the action range.
    """

    noise: Noise = "bang-bang"
    scale: float = 1.0

    def __post_init__(self) -> None:
        self._choose("noise", Noise)
        self._positive("scale")


@dataclass(frozen=True)
class RKHS(Checked):
    """V in a reproducing-kernel Hilbert space (Eq. 3), in coordinates of a pivoted Cholesky basis.

    Attributes:
        max_rank: largest number of features of V.
        tolerance: largest squared residual of the kernel function of a sampled state that needs no
            further feature, in (0, 1).  Squared norms of these functions are 1.
        angle_wrap: whether V and the reward model may be ``"discontinuous"`` where an angle wraps
            around, as a reward that is a function of the angle in rad is; or are
            ``"continuous"``, that is periodic, as the dynamics and the policy always are.
    """

    max_rank: int = 400
    tolerance: float = 1e-6
    angle_wrap: AngleWrap = "discontinuous"

    def __post_init__(self) -> None:
        self._whole("max_rank")
        self._check("tolerance", Real, "above 0 and below 1", lambda v: 0 < v < 1)
        self._choose("angle_wrap", AngleWrap)


@dataclass(frozen=True)
class Grid(Checked):
    """V in fixed radial basis functions on a grid (feature-based REPS, Sec. 4.2).

    Attributes:
        size: centres per observation coordinate.
    """

    size: int = 10

    def __post_init__(self) -> None:
        self._whole("size", most=MOST)


@dataclass(frozen=True)
class LowRank(Checked):
    """Updates of low rank (Nystroem features), whose cost is linear in the number of samples.

    Centres are chosen by pivoted Cholesky on a subsample.
    Sums over samples are computed in chunks.

    Attributes:
        rank: largest number of features of states and actions, and of centres of the policy.  The
            limit for V is ``RKHS.max_rank``.
        above: largest number of samples for which the update is exact, at cubic cost; with more it
            is of low rank.
        subsample: number of samples from which centres are chosen and to which hyper-parameters are
            fitted.
    """

    rank: int = 1000
    above: int = 3_000
    subsample: int = 10_000

    def __post_init__(self) -> None:
        self._whole("rank", "subsample")
        self._check(
            "above", Integral, f"a whole number from 0 to {LARGEST}", lambda v: 0 <= v <= LARGEST
        )


@dataclass(frozen=True)
class ModelBased(Checked):
    """Further KL-bounded steps on samples generated by the learnt model, which the paper has not.

    Model rollouts are used by ``model_rollout_fraction``, the acceptance test and the exploration
    bonus.  They are made with ``model="dynamics"`` only, not in images, and with at least ten
    samples for each coordinate of state and action.

    Attributes:
        actions_per_state: number of actions that are generated for each sample.
        proposal_std_scale: candidate actions are sampled with the standard deviation of the policy
            times this; that of the policy fitted to them is divided by it.  Without an acceptance
            test, 1 is used.
        model_rollout_fraction: share of the generated actions in states that model rollouts of the
            new policy visit, in a second step.  The others are in replayed states, in the first.
        acceptance_rollouts: model rollouts per policy in the acceptance test.  The previous policy
            is kept if the new return is lower by more than one standard error; 0 accepts all.
        exploration_bonus: of R-max: reward per step of an unexplored region, as a share of the
            difference between the largest and the average reward, above the average.  It is
            multiplied by 0.35 after each update; 0 switches it off.
        max_samples: largest number of generated actions of an update.
    """

    actions_per_state: int = 4
    proposal_std_scale: float = 1.2
    model_rollout_fraction: float = 0.5
    acceptance_rollouts: int = 50
    exploration_bonus: float = 0.1
    max_samples: int = 20_000

    def __post_init__(self) -> None:
        self._whole("actions_per_state", "max_samples", most=10_000_000)
        self._check("proposal_std_scale", Real, "from 1 to 1000", lambda v: 1 <= v <= 1000)
        self._check("model_rollout_fraction", Real, "in [0, 1]", lambda v: 0 <= v <= 1)
        none_or_some = f"0, or a whole number from 2 to {MOST}"
        self._check(
            "acceptance_rollouts", Integral, none_or_some, lambda v: v == 0 or 2 <= v <= MOST
        )
        self._check("exploration_bonus", Real, "finite and >= 0", lambda v: 0 <= v < inf)


# ---- learners ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class LearnerSettings(Checked):
    """The settings that all learners have.

    Attributes:
        restart_probability: p, with which the process restarts at each step, in [1e-9, 1).
        window: largest number of rollouts in the replay window, a third of them reserved for those
            with a state-dependent reward.  None keeps all.
        window_steps: smallest number of steps in the window, for which more rollouts are kept than
            ``window``: rollouts that terminate early have few.
    """

    restart_probability: float = 0.02
    window: int | None = 30
    window_steps: int = 0

    def __post_init__(self) -> None:
        self._check(
            "restart_probability", Real, "at least 1e-9 and below 1", lambda v: 1e-9 <= v < 1
        )
        whole = f"a whole number from 0 to {LARGEST}"
        self._check("window_steps", Integral, whole, lambda v: 0 <= v <= LARGEST)
        if self.window is not None:
            whole = f"a whole number from 1 to {LARGEST}, or None to keep all"
            self._check("window", Integral, whole, lambda v: 1 <= v <= LARGEST)


@dataclass(frozen=True)
class OnPolicySettings(LearnerSettings):
    """The settings of learners that collect rollouts with their own policy (Sec. 4.1).

    Those of `LearnerSettings`, and:

    Attributes:
        exploration: the policy of the first rollouts.
        initial_rollouts: number of rollouts before the first update.
        rollouts_per_iteration: number of rollouts before each later update.  They are made with the
            current policy; or with bang-bang actions of red noise, if the reward of none of the
            newest rollouts depends on the state.
        rollout_lengths: how the lengths are drawn, which are (1 - p) / p steps on average.
            ``"independent"``: each by itself, as printed.  ``"stratified"``: each from the same
            distribution, but one from each of R equally likely ranges for R rollouts, so that
            their total varies less.
    """

    exploration: Exploration = field(default_factory=Exploration)
    initial_rollouts: int = 30
    rollouts_per_iteration: int = 10
    rollout_lengths: RolloutLengths = "independent"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._section("exploration", Exploration)
        self._choose("rollout_lengths", RolloutLengths)
        self._whole("initial_rollouts", "rollouts_per_iteration", most=MOST)


@dataclass(frozen=True)
class Settings(OnPolicySettings):
    """The parameters of REPS with RKHS embeddings; the defaults are the preset ``"model_based"``.

    Those of `OnPolicySettings`, and:

    Attributes:
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
        policy_fit: hyper-parameters of the policy by leave-one-out density, ``"map"`` with priors
            or ``"bounded"`` within hard ranges.
        value: where the features of V come from: `RKHS` or `Grid`.
        low_rank: `LowRank`, or None for an exact update whatever the number of samples.
        model_based: `ModelBased`, or None: the paper's single step on the sampled actions.
    """

    window_steps: int = 1_000
    rollout_lengths: RolloutLengths = "stratified"
    kl_bound: float = 1.0
    eta_floor: float | None = None
    ridge: float | None = None
    exploring_starts: float = 0.25
    model: TransitionModelName = "dynamics"
    policy_fit: PolicyFitName = "map"
    value: RKHS | Grid = field(default_factory=RKHS)
    low_rank: LowRank | None = field(default_factory=LowRank)
    model_based: ModelBased | None = field(default_factory=ModelBased)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._choose("model", TransitionModelName)
        self._choose("policy_fit", PolicyFitName)
        self._positive("kl_bound")
        if self.ridge is not None:
            self._check("ridge", Real, "positive and finite, or None", lambda v: 0 < v < inf)
        if self.eta_floor is not None:
            self._check("eta_floor", Real, "finite and >= 0, or None", lambda v: 0 <= v < inf)
        self._check("exploring_starts", Real, "in [0, 1]", lambda v: 0 <= v <= 1)
        self._section("value", RKHS, Grid)
        self._section("low_rank", LowRank, type(None))
        self._section("model_based", ModelBased, type(None))
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
        temperature: of the softmax, in standard deviations of the reward.
        actions: candidate actions, evenly spaced over the range: the largest number of levels
            per dimension whose product does not exceed this.
    """

    temperature: float = 1.0
    actions: int = 25

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive("temperature")
        self._whole("actions", most=6000)  # as many as the file of a policy may hold


@dataclass(frozen=True)
class GridValueIterationSettings(LearnerSettings):
    """The parameters of off-policy value iteration on a grid of state-action pairs.

    Those of `LearnerSettings`, and the following.  A grid point is a rollout of one step, and the
    window holds the newest of them.

    Attributes:
        ranges: smallest and largest value of each observation coordinate on the grid; None takes
            those of the observation space.  The range of an angle is always a whole turn.
        actions: candidate actions of the maximisation, as in `ValueIterationSettings`.
        grid_states: grid points per state coordinate.
        grid_actions: grid points per action coordinate.
    """

    temperature: ClassVar[float] = 0.0
    """Exploration is not needed: the soft maximum is the maximum."""

    window: int = 6000
    ranges: tuple[tuple[float, float], ...] | None = None
    actions: int = 25
    grid_states: int = 15
    grid_actions: int = 7

    def __post_init__(self) -> None:
        super().__post_init__()
        self._whole("grid_states", "grid_actions", most=MOST)
        self._whole("actions", most=6000)
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


@dataclass(frozen=True)
class NPALPSettings(OnPolicySettings):
    """The parameters of non-parametric approximate linear programming.

    Those of `OnPolicySettings`, and:

    Attributes:
        lipschitz: Lipschitz constant of V, in standard deviations of the reward per median distance
            of states.
        noise_fraction: share of the actions to which exploration noise is added, in [0, 1].
        noise_scale: standard deviation of that noise, in units of half the range.
    """

    lipschitz: float = 10.0
    noise_fraction: float = 0.3
    noise_scale: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive("lipschitz", "noise_scale")
        self._check("noise_fraction", Real, "in [0, 1]", lambda v: 0 <= v <= 1)
