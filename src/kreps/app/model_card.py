"""A folder for the Hugging Face Hub: the policy of a run, its numbers and a model card."""

from __future__ import annotations

import json
from pathlib import Path

from kreps.app.run_folder import RunFolder
from kreps.errors import ConfigurationError, StorageError
from kreps.learning.storage import write_atomically

CARD = "README.md"

COPIED = ("policy.safetensors", "config.json", "progress.csv")
"""Files of a run that the folder gets, beside the learning curve if there is one."""

CURVE = "learning_curve.png"


def write_model_card(folder: RunFolder, out: Path) -> None:
    """Write the folder; files of the same names are replaced.

    Nothing is uploaded.  The environment's arguments are in ``config.json`` and in the card.

    Args:
        folder: of a run with at least one update.
        out: folder that is made unless it is there.

    Raises:
        ConfigurationError: the run has no update yet, its policy was not evaluated, or it is from
            recorded data.
        StorageError: a file of the run is damaged, or one cannot be written.
    """
    text = model_card(folder)
    try:
        out.mkdir(parents=True, exist_ok=True)
        contents = {name: (folder.path / name).read_bytes() for name in COPIED}
        if (folder.path / CURVE).exists():
            contents[CURVE] = (folder.path / CURVE).read_bytes()
    except OSError as error:
        raise StorageError(f"cannot copy {folder.path} to {out}: {error}") from error
    for name, content in contents.items():
        write_atomically(out / name, content)
    write_atomically(out / CARD, text.encode())


def model_card(folder: RunFolder) -> str:
    """The model card: metadata as YAML, and what they mean in words."""
    config, last = folder.config(), folder.recorded_rows()[-1]
    if config.data:
        raise ConfigurationError(
            f"{folder.path} is a run from recorded data, whose policy was not evaluated in an "
            "environment, as a card needs; copy its policy.safetensors instead"
        )
    measured = _measured(folder, int(last["iteration"]))
    picture = f"\n![Average reward per step over environment steps]({CURVE})\n"
    return f"""---
library_name: kreps
tags:
- reinforcement-learning
- kreps
- {_quoted(config.environment)}
model-index:
- name: {_quoted(f"kreps {config.environment}")}
  results:
  - task:
      type: reinforcement-learning
      name: reinforcement-learning
    dataset:
      name: {_quoted(config.environment)}
      type: {_quoted(config.environment)}
    metrics:
{_metrics(measured)}---

# A policy for {config.environment}

A Gaussian process policy, learnt by relative entropy policy search with
[kreps](https://jmlr.org/papers/v18/16-142.html) in {last["iteration"]} updates
from {last["rollouts"]} rollouts ({last["steps"]} steps of the environment).

| measure | mean | 2 standard errors |
|---|---|---|
{_table(measured)}
{picture if (folder.path / CURVE).exists() else ""}
## Use

```python
import kreps

policy = kreps.load_policy("policy.safetensors")
action, state = policy.predict(observation, deterministic=True)
```

Pass `state` back in the next call, or None at the start of an episode. The file has arrays and JSON
only; no code is run to read it.

## How it was learnt

```
{config.command("run")}
```

`progress.csv` has the numbers of each update, `config.json` the configuration and the versions of
the software.
"""


def _measured(folder: RunFolder, iteration: int) -> dict[str, tuple[str, float, float]]:
    """What was evaluated: name of the measure in words, mean and standard error, by type."""
    found = folder.evaluation(iteration)
    if found is None:
        raise ConfigurationError(
            f"the policy of {folder.path} after update {iteration} was not evaluated; do it with "
            f"`kreps evaluate {folder.path}`"
        )
    average, episodic = found["greedy"], found["greedy"].get("episodic")
    name = "average reward per step of the process with random restarts, without noise"
    measured = {"average_reward": (name, average["mean"], average["standard_error"])}
    if episodic is not None:
        name = "return of an episode, without noise"
        measured["mean_reward"] = (name, episodic["mean"], episodic["standard_error"])
    return measured


def _metrics(measured: dict[str, tuple[str, float, float]]) -> str:
    return "".join(
        f"    - type: {kind}\n      name: {_quoted(name)}\n      value: {mean:.6g}\n"
        for kind, (name, mean, _) in measured.items()
    )


def _table(measured: dict[str, tuple[str, float, float]]) -> str:
    return "\n".join(
        f"| {name} | {mean:.5g} | {2.0 * error:.2g} |" for name, mean, error in measured.values()
    )


def _quoted(text: str) -> str:
    """Text as YAML reads it: a JSON string is one of YAML, too."""
    return json.dumps(text)
