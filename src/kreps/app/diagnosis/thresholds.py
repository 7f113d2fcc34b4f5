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
