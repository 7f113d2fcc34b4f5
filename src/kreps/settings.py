"""Everything that can be chosen about each learner, with its defaults and named recipes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from math import inf
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, TypeVar, get_args

from kreps.errors import ConfigurationError

Model = Literal["dynamics", "change", "embedding", "sample"]
Approximation = Literal["auto", "exact", "pivoted", "uniform", "fourier"]
Features = Literal["rkhs", "grid"]
Restarts = Literal["independent", "stratified"]
PolicyFit = Literal["map", "bounded"]
Angles = Literal["cut", "round"]
Exploration = Literal["bang-bang", "gaussian", "pink"]


@dataclass(frozen=True)
class LearnerSettings:
    """What every learner has in common.

    Attributes:
        restart_probability: p, with which the process restarts at each step.
        window: how many of the latest roll-outs are kept, a third of them for those whose rewards
            tell of the states; None keeps all.
    """

    restart_probability: float = 0.02
    window: int | None = 30

    def __post_init__(self) -> None:
        self._check("restart_probability", Real, "in (0, 1)", lambda v: 0 < v < 1)
        if self.window is not None:
            whole = "a whole number >= 1, or None to keep all"
            self._check("window", Integral, whole, lambda v: v >= 1)

    def _choose(self, name: str, kind: Any) -> None:
        if getattr(self, name) not in get_args(kind):
            raise ConfigurationError(
                f"{name} = {getattr(self, name)!r} is unknown; choose one of "
                + ", ".join(repr(choice) for choice in get_args(kind))
            )

    def _positive(self, *names: str) -> None:
        for name in names:
            self._check(name, Real, "positive and finite", lambda v: 0 < v < inf)

    def _whole(self, *names: str) -> None:
        for name in names:
            self._check(name, Integral, "a whole number >= 1", lambda v: v >= 1)

    def _check(self, name: str, kind: type, limit: str, holds: Callable[[Any], bool]) -> None:
        """Take numbers of any make, NumPy's too, and keep them as Python's."""
        value = getattr(self, name)
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        if not (is_number and holds(value)):
            raise ConfigurationError(f"{name} = {value!r}, but it must be {limit}")
        object.__setattr__(self, name, int(value) if kind is Integral else float(value))


@dataclass(frozen=True)
class OnPolicySettings(LearnerSettings):
    """How a learner that explores by its own policy collects its data (Sec. 4.1).

    A roll-out lasts (1 - p) / p steps on expectation.  Beside `LearnerSettings`:

    Attributes:
        exploration: first policy, ``"bang-bang"`` (limits with random sign), ``"gaussian"`` or
            ``"pink"``, a Gaussian one with noise that has slow parts as well as fast ones.
        exploration_scale: standard deviation of the Gaussian ones, in units of half the range.
        initial_rollouts: roll-outs before the first update.
        rollouts_per_iteration: roll-outs before each later one, of the current policy; or at the
            limits with slow noise while no reward tells of the states.
        restarts: lengths of these roll-outs, ``"independent"``, as printed, or ``"stratified"``: as
            random each, but one from each of as many equally likely ranges of lengths, so that a
            batch has nearly as many steps as are expected.
    """

    exploration: Exploration = "bang-bang"
    exploration_scale: float = 1.0
    initial_rollouts: int = 30
    rollouts_per_iteration: int = 10
    restarts: Restarts = "independent"

    def __post_init__(self) -> None:
        super().__post_init__()
        self._choose("exploration", Exploration)
        self._choose("restarts", Restarts)
        self._positive("exploration_scale")
        self._whole("initial_rollouts", "rollouts_per_iteration")


@dataclass(frozen=True)
class Settings(OnPolicySettings):
    """The parameters of REPS with RKHS embeddings; the defaults are the recipe ``"default"``.

    Those of `OnPolicySettings`, and:

    Attributes:
        kl_bound: epsilon of Eq. 2 in nats: how far one update may move from the samples.
        eta_floor: least temperature, in standard deviations of the reward.  Near convergence the
            optimum of the dual falls to zero and the KL bound would chase noise; a floor lets the
            bound go slack instead.  0 leaves only a numerical safeguard of 1e-6; None takes 0.01
            where policies are judged, see below, and 0.05 where they are not.
        ridge: rho times the number of samples; the softness of the stationarity constraint.  None
            takes the mean squared leave-one-out error of the transition model: stationarity is
            asked for as strictly as successors can be predicted (but not below 0.001).
        exploring_starts: share of the random restarts that an update plans with in any of the
            sampled states instead of the start states, so that V is learnt beside the way, too; and
            of the imagined roll-outs that begin there.  Real ones begin where the environment does.
        imagined: actions per state that are drawn anew for a second bounded step, in which the
            model says what they lead to; 0 leaves that step out, and while no reward tells of the
            states there is none.
        imagined_noise: these actions are drawn with so many times the deviation of the policy, and
            that of the policy fitted to them is divided by it; where that is judged, see below.
        imagined_rollouts: share of these actions that a third step takes, in states that the policy
            of the second is led to in roll-outs simulated by the model ``"dynamics"``.  There are
            none in images, nor with fewer than ten samples for each coordinate of state and action.
        judging_rollouts: simulated likewise, of the new policy and of the one before, which acts on
            if the new one earns less by more than the standard error; 0 takes every new one, as it
            is where nothing is imagined.
        optimism: about what no sample is like, where roll-outs can be simulated: share of the way
            from the average reward to the best one that it is thought to earn, step after step
            until the restart.  It falls to 0.35 of itself at each update.  0.1 leads out of a local
            optimum that the first roll-outs show nothing beyond; 0 leaves it out.
        angles: for V and for the reward that a model expects: ``"cut"`` where their numbers begin
            anew, as a reward of the number may jump there, or ``"round"``, as for the dynamics and
            the policy.  On a grid they are round.
        model: transition model: ``"dynamics"`` regresses how the state changes, after a linear
            trend, and takes the features of V where that leads; ``"change"`` embeds how the
            features change, so that far from the data the state stays; ``"embedding"`` embeds the
            successor itself, as printed (Eq. 4); ``"sample"`` takes the observed successor.
        features: of V, ``"rkhs"`` (Eq. 3) or ``"grid"`` (fixed radial basis functions).
        grid_size: centres per coordinate of the grid.
        policy_fit: hyper-parameters of the policy by leave-one-out density, ``"map"`` with priors
            or ``"bounded"`` within hard ranges.
        max_rank: most features of V.
        basis_tolerance: the basis of V is complete when no state has a larger squared residual.
        approximation: ``"exact"``, or features in place of kernels: Nystroem's with pivots
            chosen by pivoted Cholesky (``"pivoted"``) or at random (``"uniform"``), or random
            Fourier features (``"fourier"``; the policy then has Nystroem's, chosen by pivots).
            ``"auto"`` is exact up to 3000 samples and pivoted above.
        rank: most features of states and actions and most centres of the policy where they are
            approximated; V has ``max_rank``.
    """

    restarts: Restarts = "stratified"
    kl_bound: float = 1.0
    eta_floor: float | None = None
    ridge: float | None = None
    exploring_starts: float = 0.25
    imagined: int = 4
    imagined_noise: float = 1.2
    imagined_rollouts: float = 0.5
    judging_rollouts: int = 50
    optimism: float = 0.1
    angles: Angles = "cut"
    model: Model = "dynamics"
    features: Features = "rkhs"
    grid_size: int = 10
    policy_fit: PolicyFit = "map"
    max_rank: int = 400
    basis_tolerance: float = 1e-6
    approximation: Approximation = "auto"
    rank: int = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        self._choose("model", Model)
        self._choose("features", Features)
        self._choose("policy_fit", PolicyFit)
        self._choose("angles", Angles)
        self._choose("approximation", Approximation)
        self._positive("kl_bound", "basis_tolerance")
        if self.ridge is not None:
            self._check("ridge", Real, "positive and finite, or None", lambda v: 0 < v < inf)
        if self.eta_floor is not None:
            self._check("eta_floor", Real, "finite and >= 0, or None", lambda v: 0 <= v < inf)
        self._check("exploring_starts", Real, "in [0, 1]", lambda v: 0 <= v <= 1)
        self._check("imagined_noise", Real, "finite and >= 1", lambda v: 1 <= v < inf)
        self._check("imagined_rollouts", Real, "in [0, 1]", lambda v: 0 <= v <= 1)
        none_or_some = "0, or a whole number >= 2"
        self._check("judging_rollouts", Integral, none_or_some, lambda v: v == 0 or v >= 2)
        self._check("imagined", Integral, "a whole number >= 0", lambda v: v >= 0)
        self._check("optimism", Real, "finite and >= 0", lambda v: 0 <= v < inf)
        self._whole("max_rank", "grid_size", "rank")
        if self.model == "sample" and (self.imagined or self.ridge is None):
            raise ConfigurationError(
                f'model = "sample" with imagined = {self.imagined} and ridge = {self.ridge}, but '
                "without a learnt model no other action can be imagined and no error be estimated; "
                'start from recipe="observed", or set imagined=0 and ridge=0.1'
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
        self._whole("actions")


@dataclass(frozen=True)
class GridValueIterationSettings(LearnerSettings):
    """The parameters of off-policy value iteration on a grid of state-action pairs.

    Those of `LearnerSettings`, and the following.  A grid point is a roll-out of one step, and the
    window holds the latest of them.

    Attributes:
        ranges: least and largest value of each observation coordinate on the grid; None asks the
            observation space.  An angle gets a whole turn in any case.
        actions: candidate actions of the maximisation, as in `ValueIterationSettings`.
        grid_states: grid points per state coordinate.
        grid_actions: grid points per action coordinate.
    """

    temperature: ClassVar[float] = 0.0
    """Nothing has to be explored: the soft maximum is the maximum."""

    window: int = 6000
    ranges: tuple[tuple[float, float], ...] | None = None
    actions: int = 25
    grid_states: int = 15
    grid_actions: int = 7

    def __post_init__(self) -> None:
        super().__post_init__()
        self._whole("actions", "grid_states", "grid_actions")
        if self.ranges is not None:
            try:
                ranges = tuple((float(low), float(high)) for low, high in self.ranges)
            except (TypeError, ValueError):
                ranges = ((1.0, 0.0),)
            if not all(-float("inf") < low < high < float("inf") for low, high in ranges):
                raise ConfigurationError(
                    f"ranges = {self.ranges!r}, but it must be a pair (least, largest) of finite "
                    "numbers for each observation coordinate"
                )
            object.__setattr__(self, "ranges", ranges)


@dataclass(frozen=True)
class NPALPSettings(OnPolicySettings):
    """The parameters of non-parametric approximate linear programming.

    Those of `OnPolicySettings`, and:

    Attributes:
        lipschitz: slope of V, in standard deviations of the reward per median distance of states.
        noise_fraction: share of the actions that gets exploration noise, in [0, 1].
        noise_scale: standard deviation of that noise, in units of half the range.
    """

    lipschitz: float = 10.0
    noise_fraction: float = 0.3
    noise_scale: float = 0.3

    def __post_init__(self) -> None:
        super().__post_init__()
        self._positive("lipschitz", "noise_scale")
        self._check("noise_fraction", Real, "in [0, 1]", lambda v: 0 <= v <= 1)


AnySettings = TypeVar("AnySettings", bound=LearnerSettings)

OBSERVED = Settings(
    restarts="independent",
    eta_floor=0.1,
    ridge=0.1,
    exploring_starts=0.0,
    imagined=0,
    angles="round",
    model="change",
)

RECIPES: dict[str, Settings] = {
    "default": Settings(),
    "observed": OBSERVED,
    "paper": replace(
        OBSERVED, kl_bound=0.5, eta_floor=0.02, model="embedding", policy_fit="bounded"
    ),
}
"""``"paper"`` follows the printed method where it is printed, with a low floor against a vanishing
temperature (``eta_floor=0`` takes it away).  ``"observed"`` makes one step too, on the
actions that were taken, with the changes that were found to learn faster.  ``"default"``
goes past the paper; docs/deviations.md says how, and what it gains."""


def settings_of(recipe: str | Settings = "default", /, **changes: Any) -> Settings:
    """The named (or given) recipe with some parameters changed.

    Raises:
        ConfigurationError: unknown recipe or parameter, or a value out of range.
    """
    if isinstance(recipe, str) and recipe in RECIPES:
        recipe = RECIPES[recipe]
    if not isinstance(recipe, Settings):
        raise ConfigurationError(
            f"recipe {recipe!r} is unknown; choose one of {', '.join(map(repr, RECIPES))}"
        )
    return changed(recipe, changes)


def changed(settings: AnySettings, changes: Mapping[str, Any]) -> AnySettings:
    """The settings with some parameters changed.

    Raises:
        ConfigurationError: unknown parameter, or a value out of range.
    """
    known = [f.name for f in fields(settings)]
    unknown = [name for name in changes if name not in known]
    if unknown:
        raise ConfigurationError(
            f"unknown parameter {', '.join(unknown)}; the parameters are {', '.join(known)}"
        )
    return replace(settings, **changes)
