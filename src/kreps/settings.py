"""Everything that can be chosen about a learner, with its defaults and named recipes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any, Literal, get_args

from kreps.errors import ConfigurationError

Model = Literal["embedding", "sample"]
Features = Literal["rkhs", "grid"]
PolicyFit = Literal["map", "bounded"]
Exploration = Literal["bang-bang", "gaussian"]


@dataclass(frozen=True)
class Settings:
    """The parameters of REPS with RKHS embeddings; the defaults are the recipe ``"default"``.

    Attributes:
        kl_bound: epsilon of Eq. 2 in nats: how far one update may move from the samples.
        eta_floor: least temperature, in standard deviations of the reward.  Near convergence the
            optimum of the dual falls to zero and the KL bound would chase noise; a floor lets the
            bound go slack instead.  0 leaves only a numerical safeguard of 1e-6.
        ridge: rho times the number of samples; the softness of the stationarity constraint.
        model: transition model, ``"embedding"`` (Eq. 4) or ``"sample"`` (the observed successor).
        features: of V, ``"rkhs"`` (Eq. 3) or ``"grid"`` (fixed radial basis functions).
        grid_size: centres per coordinate of the grid.
        policy_fit: hyper-parameters of the policy by leave-one-out density, ``"map"`` with priors
            or ``"bounded"`` within hard ranges.
        exploration: first policy, ``"bang-bang"`` (limits with random sign) or ``"gaussian"``.
        exploration_scale: standard deviation of the Gaussian one, in units of half the range.
        restart_probability: p; a roll-out lasts (1 - p) / p steps on expectation.
        initial_rollouts: roll-outs of the first policy.
        rollouts_per_iteration: roll-outs of the current policy before each later update.
        window: how many of the latest roll-outs are kept.
        max_rank: most features of V.
        basis_tolerance: the basis of V is complete when no state has a larger squared residual.
    """

    kl_bound: float = 1.0
    eta_floor: float = 0.1
    ridge: float = 0.1
    model: Model = "embedding"
    features: Features = "rkhs"
    grid_size: int = 10
    policy_fit: PolicyFit = "map"
    exploration: Exploration = "bang-bang"
    exploration_scale: float = 1.0
    restart_probability: float = 0.02
    initial_rollouts: int = 30
    rollouts_per_iteration: int = 10
    window: int = 30
    max_rank: int = 400
    basis_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        for name, kind in (
            ("model", Model),
            ("features", Features),
            ("policy_fit", PolicyFit),
            ("exploration", Exploration),
        ):
            if getattr(self, name) not in get_args(kind):
                raise ConfigurationError(
                    f"{name} = {getattr(self, name)!r} is unknown; choose one of "
                    + ", ".join(repr(choice) for choice in get_args(kind))
                )
        for name in ("kl_bound", "ridge", "exploration_scale", "basis_tolerance"):
            self._check(name, Real, "positive and finite", lambda v: 0 < v < float("inf"))
        self._check("eta_floor", Real, "finite and >= 0", lambda v: 0 <= v < float("inf"))
        self._check("restart_probability", Real, "in (0, 1)", lambda v: 0 < v < 1)
        for name in (
            "initial_rollouts",
            "rollouts_per_iteration",
            "window",
            "max_rank",
            "grid_size",
        ):
            self._check(name, Integral, "a whole number >= 1", lambda v: v >= 1)

    def _check(self, name: str, kind: type, limit: str, holds: Callable[[Any], bool]) -> None:
        """Take numbers of any make, NumPy's too, and keep them as Python's."""
        value = getattr(self, name)
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        if not (is_number and holds(value)):
            raise ConfigurationError(f"{name} = {value!r}, but it must be {limit}")
        object.__setattr__(self, name, int(value) if kind is Integral else float(value))


RECIPES: dict[str, Settings] = {
    "default": Settings(),
    "paper": Settings(kl_bound=0.5, eta_floor=0.02, policy_fit="bounded"),
}
"""``"paper"`` follows the printed method where it is printed, with a low floor against a vanishing
temperature (``eta_floor=0`` takes it away); docs/deviations.md says what ``"default"`` changes."""


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
    known = [f.name for f in fields(Settings)]
    unknown = [name for name in changes if name not in known]
    if unknown:
        raise ConfigurationError(
            f"unknown parameter {', '.join(unknown)}; the parameters are {', '.join(known)}"
        )
    return replace(recipe, **changes)
