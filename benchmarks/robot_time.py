"""Table of the robot time that learners take: writes ``results/robot-time.md``.

    python benchmarks/robot_time.py

Robot time is environment steps times the control period, without resets.  The rows of kreps are
from ``results/swing-up.csv`` (``kreps reproduce swing-up``), those of SAC and PPO from
``results/peers.json`` (``benchmarks/peers.py``).  Those of other authors are as published and were
not run here.
"""

from __future__ import annotations

from peers_table import RESULTS, Curve, of_kreps, of_peers

from kreps.experiments.figures import period_of, robot_time, value_at
from kreps.experiments.specs import DEFAULT
from kreps.experiments.tables import markdown

TASK = "swing-up"
MARKS = (300, 500, 750, 1000)
"""Environment steps of the rows of kreps."""

PEER_MARK = 8000
"""Environment steps of the rows of SAC and PPO, the most that they were run for."""

LEARNT, OBSERVED, KNOWN = "no: learnt from samples", "no: observed only", "yes"

PUBLISHED = (
    (
        "PILCO",
        "cart-pole swing-up, real",
        "17.5 s",
        "swings up and balances",
        KNOWN,
        "Deisenroth and Rasmussen, ICML 2011",
    ),
    (
        "Black-DROPS",
        "cart-pole swing-up, simulated",
        "16 to 20 s",
        "good policy in the median run; some runs have none after 60 s",
        KNOWN,
        "[authors' code](https://github.com/resibots/blackdrops) of Chatzilygeroudis et al., "
        "IROS 2017",
    ),
    (
        "MC-PILCO",
        "cart-pole swing-up, simulated",
        "18 s",
        "– (length of the authors' run: 3 s of random actions, 5 trials of 3 s)",
        KNOWN,
        "[authors' code](https://github.com/merlresearch/MC-PILCO) of Amadio et al., T-RO 2022",
    ),
    (
        "PETS",
        "cart-pole, simulated",
        "408 s",
        "– (length of the authors' run: 51 trials of 8 s)",
        KNOWN,
        "[authors' code](https://github.com/kchua/handful-of-trials) of Chua et al., NeurIPS 2018",
    ),
)
"""Learner, task, robot time, what is reached by then, whether it knows the reward function, and
where this is from."""


def line(name: str, curves: list[Curve], mark: int, known: str, file: str) -> list[str]:
    """The row of a learner that was run here, for its policies from at most so many steps."""
    period = period_of(TASK)
    assert period is not None
    return [
        f"{name}, {len(curves)} seeds",
        "`kreps/SwingUp-v0`",
        robot_time(mark, period),
        value_at(curves, "greedy", mark),
        known,
        f"[`{file}`]({file})",
    ]


def table() -> str:
    """The table as Markdown."""
    ours = of_kreps("swing-up.csv", TASK, DEFAULT)
    lines = [line(DEFAULT, ours, mark, LEARNT, "swing-up.csv") for mark in MARKS]
    for learner in ("sac", "ppo"):
        curves = of_peers(TASK, learner)
        lines.append(line(learner.upper(), curves, PEER_MARK, OBSERVED, "peers.json"))
    headings = ["learner", "task", "robot time", "reached", "reward function known", "source"]
    return markdown(headings, [*lines, *map(list, PUBLISHED)])


if __name__ == "__main__":
    made = table()
    (RESULTS / "robot-time.md").write_text(made + "\n")
    print(made)
