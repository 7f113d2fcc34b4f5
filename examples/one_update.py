# %% [markdown]
# # One update, step by step
#
# A stochastic policy is a distribution over actions for each state. This page makes **one** update
# of such a policy by REPS with RKHS embeddings (Algorithm 1 of the paper), on a problem so small
# that every quantity can be drawn. Each step calls functions of the library. Only the simulation
# and the true values that are drawn for comparison are written here.

# %%
from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from kreps.algorithms.dual import (
    DualProblem,
    bellman_errors,
    dual_gradient,
    dual_value,
    effective_sample_size,
    kl_from_uniform,
    sample_weights,
    standardise,
)
from kreps.algorithms.newton import solve_dual
from kreps.algorithms.policy_targets import (
    PolicyTargets,
    exploration_noise,
    policy_hyperparameters,
)
from kreps.algorithms.reps import stationarity_ridge
from kreps.algorithms.state import LearnerState
from kreps.algorithms.update import update
from kreps.data.compute import Compute
from kreps.data.rollouts import Rollout
from kreps.data.task import TaskSpec
from kreps.data.window import ReplayWindow
from kreps.envs.restart import restart_length
from kreps.kernels.arrays import FloatArray
from kreps.kernels.basis import KernelExpansion, RKHSBasis
from kreps.models.transition import (
    feature_differences,
    fit_embedding,
    state_kernel,
    successor_features,
)
from kreps.plotting import BLUE, GREY, ORANGE, STYLE
from kreps.policies.base import StochasticPolicy
from kreps.policies.cost_sensitive_gp import CostSensitiveGP
from kreps.policies.exploration import Gaussian
from kreps.presets import settings_of
from kreps.settings import RKHS

NOTEBOOK = "ipykernel" in sys.modules
parser = argparse.ArgumentParser(
    description="One update of REPS with RKHS embeddings, in pictures."
)
parser.add_argument("--out", type=Path, default=Path("runs/one_update"), help="for the pictures")
parser.add_argument("--rollouts", type=int, default=10)
parser.add_argument("--seed", type=int, default=3)
args = parser.parse_args([] if NOTEBOOK else None)

# %% [markdown]
# ## The problem
#
# A bead moves on a ring. Its state $s$ is its position, an angle in rad from the goal at 0. The
# action $a$ is a commanded velocity in rad/s, clipped to ±2 before it is applied. In each period
# of 0.3 s the bead moves by 0.3 s times the applied velocity, plus noise of standard deviation
# 0.25 rad. The reward of a step is $r = \cos(s) - 1$: 0 at the goal, -2 opposite to it. The
# reward does not depend on the action, so actions differ only in the rewards of *later* steps.
#
# The process restarts with probability $1 - \gamma = 1/16$ per step. Then the rollout ends, and
# the next one starts at a uniformly random position. The objective is the average reward per
# step.

# %%
PERIOD, NOISE, GAMMA = 0.3, 0.25, 15 / 16
task = TaskSpec(
    observation_size=1, action_low=np.array([-2.0]), action_high=np.array([2.0]), periodic=(0,)
)
settings = settings_of("single_step", restart_probability=1.0 - GAMMA)
assert isinstance(settings.value, RKHS)


def wrap(angle: FloatArray) -> FloatArray:
    """The same position as an angle in [-pi, pi)."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def reward(state: FloatArray) -> FloatArray:
    return np.cos(state) - 1.0


def simulate(policy: StochasticPolicy, count: int, rng: np.random.Generator) -> list[Rollout]:
    """Rollouts of the bead, each up to its first restart."""
    rollouts = []
    for _ in range(count):
        states, actions = [rng.uniform(-np.pi, np.pi, size=1)], []
        for _ in range(restart_length(rng, settings.restart_probability)):
            actions.append(policy.act(states[-1][None], rng.standard_normal((1, 1)))[0])
            noise = NOISE * rng.standard_normal(1)
            states.append(wrap(states[-1] + PERIOD * task.clip(actions[-1]) + noise))
        rewards = reward(np.array(states[:-1])[:, 0])
        rollouts.append(Rollout(np.array(states), np.array(actions), rewards))
    return rollouts


def average_reward(rollouts: list[Rollout]) -> float:
    """Mean over all steps of all rollouts."""
    return float(np.concatenate([r.rewards for r in rollouts]).mean())


# %% Helpers for the pictures
GRID = np.linspace(-np.pi, np.pi, 361)  # positions to draw functions at
RAD_TICKS = [-np.pi, -np.pi / 2, 0.0, np.pi / 2, np.pi]
RAD_NAMES = ["-π", "-π/2", "0", "π/2", "π"]


def panels(rows: int, columns: int, height: float, **options: Any) -> tuple[Figure, Any]:
    figure = Figure(figsize=(8.4, height))
    return figure, figure.subplots(rows, columns, **options)


def position_axis(axes: Axes, which: str = "x") -> None:
    set_label, set_ticks, set_limits = (
        (axes.set_xlabel, axes.set_xticks, axes.set_xlim)
        if which == "x"
        else (axes.set_ylabel, axes.set_yticks, axes.set_ylim)
    )
    set_label("position s [rad]")
    set_ticks(RAD_TICKS, RAD_NAMES)
    set_limits(-1.02 * np.pi, 1.02 * np.pi)


def action_plane(axes: Axes) -> None:
    position_axis(axes)
    axes.set_ylabel("action a [rad/s]")
    axes.set_ylim(-5.0, 5.0)
    for limit in (task.action_low[0], task.action_high[0]):
        axes.axhline(limit, color=GREY, lw=0.8, ls="--", zorder=0)


def draw_rollouts(axes: Axes, rollouts: list[Rollout]) -> None:
    """Position over time, with a gap where the bead passes from pi to -pi."""
    for rollout in rollouts:
        path = rollout.observations[:, 0]
        time = PERIOD * np.arange(len(path))
        cuts = np.flatnonzero(np.abs(np.diff(path)) > np.pi) + 1
        axes.plot(np.insert(time, cuts, np.nan), np.insert(path, cuts, np.nan), color=BLUE, lw=0.8)
        axes.plot(time[-1], path[-1], "x", color=ORANGE, ms=5, zorder=3)
    axes.axhline(0.0, color=GREY, lw=0.8, ls="--", zorder=0)
    position_axis(axes, "y")
    axes.set_xlabel("time [s]")


def show(figure: Figure, name: str) -> None:
    """Into the folder of the pictures, or into the notebook."""
    buffer = BytesIO()
    with rc_context(STYLE):
        figure.savefig(buffer, format="png")
    picture = Image.open(buffer).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    if NOTEBOOK:
        from IPython.display import display

        display(picture)
    else:
        args.out.mkdir(parents=True, exist_ok=True)
        picture.save(args.out / f"{name}.png", optimize=True)


# %% [markdown]
# ## 1. The data
#
# The first policy explores: in every state it draws a velocity $a \sim \mathcal{N}(0, 1.4^2)$
# ([`Gaussian`](../src/kreps/policies/exploration.py)). A few rollouts give $n$ samples
# $(s_i, a_i, r_i, s_i')$, where $s_i'$ is the successor of $s_i$
# ([`Transitions`](../src/kreps/data/rollouts.py)). The samples, the restart probability and the
# limits of the action are the only input of the learner. The dynamics and the reward function are
# not.
#
# Left: a cross marks the end of a rollout. Lines are interrupted where the bead passes from π to
# -π. Right: each point is one sample. Its colour changes from left to right but not from bottom to
# top, as the reward does not depend on the action. Commands beyond the dashed limits are clipped
# before they are applied.

# %%
rng = np.random.default_rng(args.seed)
explorer = Gaussian(task, scale=0.7)  # in units of the largest velocity
rollouts = simulate(explorer, args.rollouts, rng)
data = ReplayWindow(task, args.rollouts).append(rollouts).transitions
n = len(data)
states, actions = data.states[:, 0], data.actions[:, 0]

with rc_context(STYLE):
    figure, (left, right) = panels(1, 2, 3.4)
    draw_rollouts(left, rollouts)
    left.set_xlim(right=1.12 * left.get_xlim()[1])
    left.annotate("goal", (left.get_xlim()[1], 0.0), ha="right", va="bottom", color=GREY)
    left.set_title(f"{len(rollouts)} rollouts of the exploring policy")
    dots = right.scatter(states, actions, c=data.rewards, s=16, cmap="viridis", lw=0)
    action_plane(right)
    right.set_title(f"{n} samples")
    figure.colorbar(dots, ax=right, label="reward r", pad=0.02)
show(figure, "1_data")

# %% [markdown]
# ## 2. The kernel and a basis
#
# A kernel measures the similarity of two states. On the ring it is periodic,
#
# $k(s, t) = \exp(-2 \sin^2((s - t) / 2) / l^2)$ ([`Periodic`](../src/kreps/kernels/kernel.py)).
#
# The lengthscale $l$ is the median distance of the samples
# ([`state_kernel`](../src/kreps/models/transition.py)). The kernel values of all pairs of sampled
# states form the Gram matrix (left). With the states sorted by position, it is large along the
# diagonal and in two corners, because positions near -π and π are neighbours on the ring.
#
# Functions of the state are weighted sums of kernels at the sampled states (Eq. 3 of the paper).
# Neighbouring kernels are nearly the same function, so few are needed. Pivoted Cholesky selects
# states, the *pivots*, until no kernel function has more than 1e-6 of its squared norm outside
# the span of the selected ones (right). This gives orthonormal features
# $\phi_1(s), \dots, \phi_m(s)$, together the vector $\phi(s)$
# ([`RKHSBasis.fit`](../src/kreps/kernels/basis.py)). Middle: the first four features, each with a
# dot at its pivot, and grey marks at the other pivots. From here on a function of the state is
# $\phi(s)^\top \theta$ with a short vector $\theta$. The symbol $\top$ denotes the
# transpose of a vector or a matrix.

# %%
update_rng = np.random.default_rng([args.seed, 1])
kernel = state_kernel(data, task, update_rng)
basis, features = RKHSBasis.fit(  # features: a row phi(s) for each state of a rollout
    kernel, data.points, tolerance=settings.value.tolerance, max_rank=settings.value.max_rank
)

order = np.sort(data.points, axis=0)
on_grid = basis.features(GRID[:, None])
residuals = 1.0 - np.cumsum(features**2, axis=1)  # of each state, after 1, 2, ... features

with rc_context(STYLE):
    figure, (left, middle, right) = panels(1, 3, 3.1, width_ratios=(1.25, 1.1, 1.0))
    bands = colormaps["viridis"].resampled(10)
    image = left.imshow(kernel.gram(order), cmap=bands, vmin=0.0, vmax=1.0, aspect="auto")
    at = np.searchsorted(order[:, 0], RAD_TICKS)
    left.set_xticks(at, RAD_NAMES)
    left.set_yticks(at, RAD_NAMES)
    left.set_xlabel("sampled states, sorted [rad]")
    left.set_title("Gram matrix")
    figure.colorbar(image, ax=left, label="k(s, t)", pad=0.02)
    shades = (BLUE, ORANGE, "#3caea3", "#b08900")
    for j, shade in enumerate(shades):
        middle.plot(GRID, on_grid[:, j], color=shade, lw=1.4)
        pivot = basis.pivots[j]
        middle.plot(
            pivot, basis.features(pivot[None])[:, j], "o", color=shade, label=f"φ{'₁₂₃₄'[j]}"
        )
    others = basis.pivots[len(shades) :, 0]
    middle.plot(others, np.full(len(others), -0.62), "|", color=GREY, ms=8)
    position_axis(middle)
    middle.set_ylim(-0.7, 1.3)
    middle.legend(ncols=4, loc="upper center", handletextpad=0.0, columnspacing=0.6)
    middle.set_title("Features and pivots")
    count = np.arange(1, features.shape[1] + 1)
    right.semilogy(count, np.maximum(residuals.max(axis=0), 1e-12), "o-", color=BLUE, ms=3)
    right.axhline(settings.value.tolerance, color=GREY, lw=0.8, ls="--")
    right.set_xlabel("number of features")
    right.set_title("Squared norm outside")
show(figure, "2_kernel")

# %% [markdown]
# ## 3. The embedding: expected successors
#
# A single observed successor is a poor estimate of the effect of an action, because the noise is
# nearly as large as the effect. The expectation of a function $f$ of the successor is therefore
# estimated from *all* samples, through the change of $f$ (Eq. 4, applied to the change instead of
# the value):
#
# $\mathbb{E}[f(s') \mid s, a] = f(s) + \sum_i \beta_i(s, a) (f(s_i') - f(s_i))$ with
# $\beta(s, a) = (K + \lambda I)^{-1} k(s, a)$.
#
# $K$ holds the kernel values of all pairs of samples, now over states *and* applied actions. The
# vector $k(s, a)$ holds the kernel values of the samples with the pair $(s, a)$. The regulariser
# $\lambda$ accounts for the noise. The strength $\beta_i$ is the weight of sample $i$
# ([`KernelEmbedding.strengths`](../src/kreps/kernels/regression.py)). Far from the data all
# strengths are near zero, and the estimate is $f(s)$: the state does not change. Without the
# difference, the estimate there would be zero, which is a worse guess. The lengthscales and
# $\lambda$ minimise the leave-one-out error of the predicted changes of the features
# ([`fit_embedding`](../src/kreps/models/transition.py)).
#
# Left: the strengths for the pair at the star. Samples close to it in state and action have the
# largest ones. Middle: for the same pair, the expected kernel value $\mathbb{E}[k(t, s')]$ of the
# successor and each position $t$. The dotted curve is the estimate without data, for which the
# state does not change. The embedding is close to the truth, which is computed from the
# simulation and is not an input of the learner. Right: the expectations of one function, the
# kernel at the goal $f(s') = k(0, s')$, for all samples against the truth. The single observed
# values scatter widely about the dashed line. The embedding averages most of the noise out.

# %%
successors = successor_features(data, features)  # a row phi(s'_i) per sample
own = features[data.state]  # a row phi(s_i) per sample
changes = successors - own
model, _ = fit_embedding(data, changes, kernel, task, None, update_rng)
expected = own + model.expected_features(changes)  # a row E[phi(s') | s_i, a_i] per sample

pair = np.array([[0.5, -1.0]])  # rad, rad/s
in_units = np.column_stack([pair[:, :1], task.scaled_applied(pair[:, 1:])])
beta = model.strengths(in_units)[:, 0]

goal = np.zeros((1, 1))
near_goal = KernelExpansion(kernel, goal, np.ones(1))  # f
after = data.points[data.successor]
observed_f, own_f = near_goal(after), near_goal(data.states)
embedded_f = own_f + model.strengths(model.inputs).T @ (observed_f - own_f)

# E[k(t, s')] for the pair at the star and all positions t, as function values f(s') for each t
at_pair = kernel.gram(GRID[:, None], pair[:, :1])[:, 0]
moved = kernel.gram(GRID[:, None], after) - kernel.gram(GRID[:, None], data.states)
embedded_at_pair = at_pair + moved @ beta
nodes, node_weights = np.polynomial.hermite_e.hermegauss(20)  # for expectations under the noise


def true_expectation(function: KernelExpansion) -> FloatArray:
    """E[f(s') | s_i, a_i] by the true dynamics and quadrature, for comparison only."""
    mean = data.states + PERIOD * task.clip(data.actions)
    values = [function(wrap(mean + NOISE * node)) for node in nodes]
    expectation: FloatArray = node_weights @ np.array(values) / node_weights.sum()
    return expectation


def rms(error: FloatArray) -> float:
    return float(np.sqrt(np.mean(error**2)))


true_f = true_expectation(near_goal)
pair_after = pair[:, :1] + PERIOD * pair[:, 1:] + NOISE * nodes  # no need to wrap: k is periodic
true_at_pair = kernel.gram(GRID[:, None], pair_after.T) @ node_weights / node_weights.sum()
with rc_context(STYLE):
    figure, (left, middle, right) = panels(1, 3, 3.1, width_ratios=(1.2, 1.0, 1.0))
    top = float(np.abs(beta).max())
    rank = np.argsort(np.abs(beta))
    look: dict[str, Any] = {
        "cmap": "RdBu_r",
        "vmin": -top,
        "vmax": top,
        "edgecolor": GREY,
        "lw": 0.3,
    }
    dots = left.scatter(states[rank], actions[rank], c=beta[rank], s=16, **look)
    left.plot(*pair.T, "*", color="black", ms=9)
    action_plane(left)
    left.set_title("Strengths β for the star")
    figure.colorbar(dots, ax=left, pad=0.02)
    middle.plot(GRID, at_pair, color=GREY, ls=":", label="no change of state")
    middle.plot(GRID, true_at_pair, color=ORANGE, lw=1.6, label="truth")
    middle.plot(GRID, embedded_at_pair, color=BLUE, label="embedding")
    position_axis(middle)
    middle.set_xlabel("position t [rad]")
    middle.set_ylim(top=1.5)
    middle.legend(loc="upper left", handlelength=1.4)
    middle.set_title("E[k(t, s')] for the star")
    right.axline((1.0, 1.0), slope=1.0, color=GREY, lw=0.8, ls="--")
    right.plot(
        true_f, observed_f, "o", color=ORANGE, ms=3, alpha=0.6, mew=0, label="observed f(s')"
    )
    right.plot(true_f, embedded_f, "o", color=BLUE, ms=3, mew=0, label="embedding")
    right.set_xlabel("true E[f(s') | s, a]")
    right.legend(loc="upper left", handletextpad=0.1, borderpad=0.0)
    right.set_title("Expected f(s')")
show(figure, "3_embedding")

# %% [markdown]
# ## 4. The dual: sample weights within a KL bound
#
# Each sample gets a weight $p_i \ge 0$; the weights sum to one. They maximise the weighted reward
# $\sum_i p_i r_i$ under two constraints.
#
# *KL bound*: $\mathrm{KL}(p \,\|\, \mathrm{uniform}) = \sum_i p_i \log(n p_i)$, the divergence of
# the weights from the empirical distribution, is at most $\epsilon$ (here 1 nat). It limits the
# size of the step.
#
# *Stationarity*: the distribution of states equals the distribution of successors, restarts
# included. Without this constraint the weights would select the samples near the goal, whether or
# not the goal can be reached that often. In features the constraint is $B^\top p = 0$, where row
# $i$ of $B$ is
#
# $\gamma\, \mathbb{E}[\phi(s') \mid s_i, a_i] +
# (1 - \gamma)\, \mathrm{mean}\, \phi(s_0) - \phi(s_i)$
#
# with the start states $s_0$ ([`feature_differences`](../src/kreps/models/transition.py)).
# Because $B$ is an estimate, the constraint is softened by a ridge $\rho$.
#
# The Lagrange multipliers are the temperature $\eta > 0$ for the KL bound and a vector $\theta$
# for stationarity. They minimise the dual function
#
# $g(\eta, \theta) = \eta \epsilon + \eta \log
# \bigl( \frac{1}{n} \sum_i \exp(\delta_i / \eta) \bigr) + \frac{\rho}{2} \theta^\top \theta$
#
# with $\delta = R + B \theta$ (Eqs. 2 and 5), where $R$ are the rewards minus the largest one, in
# units of their standard deviation. The dual is convex, so Newton's method finds its minimum, the
# star ([`solve_dual`](../src/kreps/algorithms/newton.py)).
#
# Left: $g$ over the temperature and along the direction of the optimal vector, $\theta^*$. Each
# contour is 1.6 times as far above the minimum as the next inner one. Right: $g$ and the KL
# divergence, with the optimal $\theta$ for each temperature. The slope of the upper curve in
# $\eta$ is $\epsilon - \mathrm{KL}$, so its minimum is where KL crosses the bound. The dotted
# line is the smallest temperature that is permitted (`eta_floor`). It is not active here.

# %%
starts = features[data.start].mean(axis=0)
rewards, reward_unit = standardise(data.rewards)
problem = DualProblem(
    rewards=rewards,
    differences=feature_differences(own, expected, starts, settings.restart_probability),
    kl_bound=settings.kl_bound,
    ridge=stationarity_ridge(settings, None) / n,
    eta_floor=settings.eta_floor,
)
dual = solve_dual(problem)

# No weights reach this bound, so eta is at its floor: this gives the optimal theta for any eta.
etas = np.sort(np.append(dual.eta * np.geomspace(0.1, 6.0, 80), dual.eta))
no_bound = replace(problem, kl_bound=np.log(n) + 1.0)
held = [solve_dual(replace(no_bound, eta_floor=eta)) for eta in etas]
profile = [dual_value(problem, end.eta, end.theta) for end in held]
realised = [end.kl for end in held]

with rc_context(STYLE):
    figure = Figure(figsize=(8.4, 3.7))
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1.0))
    left = figure.add_subplot(grid[:, 0])
    top_right = figure.add_subplot(grid[0, 1])
    bottom_right = figure.add_subplot(grid[1, 1], sharex=top_right)
    shares = np.linspace(-0.5, 2.5, 241)
    surface = np.array([[dual_value(problem, eta, c * dual.theta) for eta in etas] for c in shares])
    levels = dual.dual + 0.01 * 1.6 ** np.arange(13)
    line_colours = colormaps["viridis"](np.linspace(0.0, 1.0, len(levels)))
    left.contour(etas, shares, surface, levels, colors=line_colours, linewidths=1.3)
    left.plot(dual.eta, 1.0, "*", color=ORANGE, ms=12, zorder=3)
    left.set_xscale("log")
    left.set_xlabel("temperature η [standard deviations of r]")
    left.set_ylabel("c, with θ = c θ*")
    left.set_title("Dual function g(η, c θ*)")
    top_right.semilogx(etas, profile, color=BLUE)
    top_right.plot(dual.eta, dual.dual, "*", color=ORANGE, ms=12, zorder=3)
    top_right.set_title("min over θ of g(η, θ)")
    top_right.tick_params(labelbottom=False)
    top_right.margins(y=0.2)
    for axes in (top_right, bottom_right):
        axes.set_xlim(etas[0], etas[-1])
        axes.axvline(problem.eta_floor, color=GREY, lw=0.8, ls=":", zorder=0)
    bottom_right.semilogx(etas, realised, color=BLUE)
    bottom_right.plot(dual.eta, dual.kl, "*", color=ORANGE, ms=12, zorder=3)
    bottom_right.axhline(settings.kl_bound, color=GREY, lw=0.8, ls="--", zorder=0)
    bottom_right.annotate(
        "bound ε", (etas[-1], settings.kl_bound), ha="right", va="bottom", color=GREY
    )
    bottom_right.set_ylim(bottom=0.0)
    bottom_right.annotate(" floor", (problem.eta_floor, 0.05), color=GREY)
    bottom_right.set_xlabel("temperature η [standard deviations of r]")
    bottom_right.set_title("KL(p ‖ uniform) [nats]")
show(figure, "4_dual")

# %% [markdown]
# ## 5. Bellman errors, weights and the value function
#
# The multiplier $\theta$ defines a function of the state, the *value function*
# $V(s) = \phi(s)^\top \theta$: the expected sum of later rewards, up to a constant
# ([`KernelExpansion`](../src/kreps/kernels/basis.py)). So $\delta_i$ is the Bellman error
# $r_i + \mathbb{E}[V(s') \mid s_i, a_i] - V(s_i)$, restarts included: the reward of the action
# and the value after it, compared with the value before it
# ([`bellman_errors`](../src/kreps/algorithms/dual.py)). The weights are (Eq. 1)
#
# $p_i = \exp(\delta_i / \eta) / \sum_j \exp(\delta_j / \eta)$
# ([`sample_weights`](../src/kreps/algorithms/dual.py)).
#
# Top left: unlike the rewards, the Bellman errors change from bottom to top. Left of the goal
# positive velocities have the larger errors, right of it negative ones. Top right: the area of a
# point is its weight. Bottom left: $V$ is largest near the goal.
#
# Bottom right: the effect of the stationarity constraint. The curve is the density of arrivals
# minus the density of visits, both smoothed by the kernel: $\phi(s)^\top B^\top p$. With weights
# from the rewards alone ($\theta = 0$), visits to the goal would exceed arrivals there, which no
# policy can achieve. With the optimal $\theta$ the curve is flat up to the softness of the
# constraint: $B^\top p = -\rho\, \theta$.

# %%
delta = bellman_errors(problem, dual.theta)
p = dual.weights
value = basis.function(reward_unit * dual.theta)  # in units of the reward
greedy_p = sample_weights(problem.rewards, dual.eta)  # without V


def net_arrivals(weights: FloatArray) -> FloatArray:
    """phi(s)' B'p over the grid: arrivals minus visits, smoothed by the kernel."""
    return on_grid @ (problem.differences.T @ weights)


with rc_context(STYLE):
    figure, ((a, b), (c, d)) = panels(2, 2, 6.0)
    dots = a.scatter(states, actions, c=delta, s=16, cmap="viridis", lw=0)
    action_plane(a)
    a.set_title("Bellman errors δ")
    figure.colorbar(dots, ax=a, label="δ [standard deviations of r]", pad=0.02)
    b.scatter(states, actions, s=14 * n * p, color=BLUE, alpha=0.55, lw=0)
    action_plane(b)
    b.set_ylabel("")
    b.set_title("Weights p")
    c.plot(GRID, value(GRID[:, None]), color=BLUE, label="value V")
    c.plot(GRID, reward(GRID), color=GREY, ls=":", label="reward r")
    position_axis(c)
    c.legend(loc="lower center")
    c.set_ylabel("[units of r]")
    c.set_title("Value function V and reward")
    d.axhline(0.0, color=GREY, lw=0.8, ls="--", zorder=0)
    d.plot(GRID, net_arrivals(greedy_p), color=GREY, label="weights from rewards alone")
    d.plot(GRID, net_arrivals(p), color=BLUE, label="weights with V")
    position_axis(d)
    d.legend(loc="upper center")
    d.margins(y=0.25)
    d.set_title("Arrivals minus visits")
show(figure, "5_weights")

# %% [markdown]
# ## 6. The policy
#
# The weights are defined at the samples only; a policy is needed for *every* state. It is a
# Gaussian process fitted to the weighted samples, in which a sample of weight $w$ counts as $w$
# samples ([`CostSensitiveGP`](../src/kreps/policies/cost_sensitive_gp.py)):
#
# $\mu(s) = k(s)^\top C^{-1} U$ and $\sigma(s)^2 = \sigma_f^2 - k(s)^\top C^{-1} k(s) + l$ with
# $C = \sigma_f^2 K + l\, \mathrm{diag}(1/w)$.
#
# $U$ are the commanded actions in units of their limit. $K$ holds the kernel values of all pairs
# of sampled states, and $k(s)$ those with the state $s$, times $\sigma_f^2$. The weights are
# $w = p / \sum_i p_i^2$. The variances $\sigma_f^2$ of the mean and $l$ of the noise are fitted,
# and so is the lengthscale of this kernel
# ([`policy_hyperparameters`](../src/kreps/algorithms/policy_targets.py)). Samples of negligible
# weight are left out. The exploration noise is at most the variance of the weighted actions
# ([`exploration_noise`](../src/kreps/algorithms/policy_targets.py)).
#
# Left and middle: mean ± 2 standard deviations before and after the update, with the samples
# (area: weight). The new policy moves towards the goal from both sides. Opposite to the goal both
# directions are equally good, and its mean passes through zero. The standard deviation is smallest
# where most of the weight is; it is the exploration of the next rollouts. Right: rollouts of the
# new policy. Because the step is bounded, the policy is not yet optimal; the next update starts
# from its data. The titles give the average reward per step, from 500 further rollouts each.

# %%
targets = PolicyTargets.from_samples(data, p, task)
x = policy_hyperparameters(targets, kernel, settings.policy_fit, None, update_rng)
*log_lengthscales, log_signal, log_noise = x
weights, noise_variance = exploration_noise(targets, float(np.exp(log_noise)))
policy = CostSensitiveGP(
    task,
    kernel.with_lengthscales(np.exp(log_lengthscales)),
    targets.states,
    targets.targets,
    weights,
    signal=float(np.exp(log_signal)),
    noise=noise_variance,
)
new_rollouts = simulate(policy, args.rollouts, np.random.default_rng([args.seed, 2]))
fresh = [simulate(each, 500, np.random.default_rng([args.seed, 3])) for each in (explorer, policy)]
average_before, average_after = (average_reward(each) for each in fresh)

with rc_context(STYLE):
    figure, (left, middle, right) = panels(1, 3, 3.1)
    zeros, spread = np.zeros_like(GRID), explorer.scale * task.action_scale[0]
    mean = policy.mean(GRID[:, None])[:, 0]
    sd = policy.standard_deviation(GRID[:, None])[:, 0]
    for axes, centre, width, area, title in (
        (
            left,
            zeros,
            np.full_like(GRID, spread),
            np.full(n, 8.0),
            f"Before: {average_before:.2f} per step",
        ),
        (middle, mean, sd, 8.0 * n * p, f"After: {average_after:.2f} per step"),
    ):
        axes.scatter(states, actions, s=area, color=BLUE, alpha=0.5, lw=0)
        axes.fill_between(
            GRID, centre - 2 * width, centre + 2 * width, color=ORANGE, alpha=0.25, lw=0
        )
        axes.plot(GRID, centre, color=ORANGE, lw=2)
        action_plane(axes)
        axes.set_title(title)
    middle.set_ylabel("")
    draw_rollouts(right, new_rollouts)
    right.set_title("Rollouts after")
    right.set_ylabel("position s [rad]", labelpad=-2)
show(figure, "6_policy")

# %% [markdown]
# ## The same in one call
#
# The six steps are the body of [`reps_step`](../src/kreps/algorithms/reps.py), which
# [`update`](../src/kreps/algorithms/update.py) calls. It gives the same policy. The numbers
# printed here belong to the pictures; $V$ and the average rewards are in units of the reward. The
# duality gap is zero at the optimum, up to the tolerance to which KL meets its bound. The seed
# was selected among four for clear pictures; `--seed` and `--rollouts` give others.

# %%
start = LearnerState(ReplayWindow(task, args.rollouts))
same_rng = np.random.default_rng([args.seed, 1])
learnt, _ = update(start, rollouts, settings, same_rng, Compute())
assert isinstance(learnt.policy, CostSensitiveGP)
same = np.array_equal(learnt.policy.mean(GRID[:, None]), policy.mean(GRID[:, None]))

true_value = true_expectation(value)
slope = dual_gradient(problem, dual.eta, dual.theta)[1]  # B'p + rho theta
facts = {
    "samples": n,
    "features of V": features.shape[1],
    "sum of the strengths beta at the star": beta.sum(),
    "RMS error of E[V(s')], one observed successor": rms(value(after) - true_value),
    "RMS error of E[V(s')], embedding": rms(expected @ dual.theta * reward_unit - true_value),
    "temperature eta": dual.eta,
    "KL(p || uniform)": kl_from_uniform(p),
    "bound epsilon": settings.kl_bound,
    "sum of the weights": p.sum(),
    "largest entry of |B'p|": np.abs(problem.differences.T @ p).max(),
    "largest entry of |B'p|, rewards alone": np.abs(problem.differences.T @ greedy_p).max(),
    "largest entry of |B'p + rho theta|": np.abs(slope).max(),
    "duality gap": dual.gap,
    "effective samples": effective_sample_size(p),
    "average reward before": average_before,
    "average reward after": average_after,
}
for name, fact in facts.items():
    print(f"{name:48} {fact:.4g}")
print("kreps.algorithms.update.update gives", "the same policy" if same else "ANOTHER POLICY")
