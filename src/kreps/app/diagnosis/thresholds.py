"""The thresholds of the diagnosis; ``docs/diagnosis.md`` has the reason for each.

They are rules of thumb, chosen from a few runs, and have no effect on learning.
"""

from __future__ import annotations

RECENT = 5
"""Latest iterations that a median is taken over."""

MIN_ITERATIONS = 8
"""Iterations from which on the last half has a trend."""

CONFIDENCE = 0.95
"""One-sided confidence with which a trend is called a rise or a fall."""

MODEL_ERROR_NOTE, MODEL_ERROR_LIMIT = 0.4, 0.8
"""Relative leave-one-out error of the transition model; 1 is no better than no model."""

MIN_MODEL_ERROR_FALL = 0.1
"""Fall of that error over the last half of a run that counts as one, as a share of the error."""

DYNAMICS_ERROR_NOTE, DYNAMICS_ERROR_LIMIT = 0.4, 0.8
"""Leave-one-out error of the changes of state, relative to their size: 1 is no better than that
nothing changes, and noise from step to step has 0.71."""

WORST_COORDINATE_NOTE = 0.6
"""The same error of the coordinate that is predicted worst."""

REWARD_ERROR_NOTE, REWARD_ERROR_LIMIT = 0.5, 0.9
"""Leave-one-out error of the reward model, relative to the standard deviation of the reward: three
quarters and a fifth of the variance are explained."""

TERMINATION_ERROR_NOTE = 0.8
"""Leave-one-out error of the termination model, relative to the standard deviation of terminations.
They are rare and jump, so that even good models have a large one."""

RARELY = 0.05
"""Share of terminated rollouts below which a poor model of terminations does no harm."""

SHORT_ROLLOUTS = 0.2
"""Mean length of rollouts, as a share of the time limit, below which they may be too short."""

LATE_RISE_NOTE = 0.1
"""Rise of the greedy policy's reward after the mean length of a rollout, as a share of the range of
training rewards."""

MOSTLY = 0.5
"""Share of terminated episodes from which on they mostly end so."""

EARLY_END = 0.5
"""Length of greedy episodes, as a share of the time limit, below which they end early."""

RETURN_GAP_NOTE = 0.1
"""What an episode earns less per step than the average reward says, as a share of the range of
training rewards."""

COPY_CORRELATION = 1.0 - 1e-9
"""Correlation of two observation columns from which on one is a copy of the other."""

NOISE_R2 = 0.05
"""Explained share of the variance of a column's successor below which nothing predicts it."""

EFFECT_NOTE = 0.02
"""Share of what is left of another successor or of the reward from which on a column has an effect
on it.  Chance explains one in n, the number of samples."""

SAMPLES_PER_TERM = 20
"""Smallest number of samples per coefficient of a least-squares fit that a finding is based on."""

MAX_COLUMNS = 200
"""Largest number of observation columns that are looked at one by one."""

HELD_OUT_NOTE = 0.71
"""Held-out error of predictions with earlier observations and actions, as a share of the one
without, below which they are needed: half of the squared error."""

MIN_HELD_OUT_STEPS = 200
"""Smallest number of steps from which a delay or a hidden state is looked for."""

ACTION_COST_NOTE = 0.5
"""Share of the variance of the reward that is a cost of actions, from which on it dominates."""

HIGH_KL_SHARE, LOW_KL_SHARE = 0.8, 0.5
"""Share of the KL bound from which on it limits the step, and below which it does not."""

MIN_EFFECTIVE_SAMPLES, MIN_EFFECTIVE_SHARE = 30.0, 0.05
"""Smallest effective number of policy targets, and of effective samples as a share of all."""

REJECTED_NOTE = 0.5
"""Share of rejected policies above which the run hardly improves."""

CLIPPED_NOTE = 0.9
"""Share of commanded actions beyond the limits from which on exploration has little effect."""

MIN_POLICY_STD, MAX_POLICY_STD = 0.02, 1.0
"""Standard deviation of the policy in units of half the action range."""

NOISE_COST_NOTE = 0.1
"""Loss of reward by exploration noise, as a share of the range of training rewards."""

RESIDUAL_NOTE, RESIDUAL_LIMIT = 0.1, 0.5
"""Largest squared residual of a full basis; 1 is a state that V cannot represent."""

JITTER_NOTE = 1e-8
"""Jitter above which the factorised matrix differs from the intended one."""

REFERENCE_TOLERANCE = 0.05
"""Share of the way from worst to best reference within which a reward is near a reference."""

MIN_REWARD_RISE, MAX_LEVEL_RISE = 0.02, 0.25
"""Smallest rise of the reward that counts as one, and largest rise of a reward that is level, as
shares of the range of training rewards (`columns.reward_range`)."""
