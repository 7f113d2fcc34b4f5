"""The command line: what it leaves, what it says, and that it never answers with a traceback."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

import kreps
from kreps.app import cli
from kreps.app.progress_file import ADDED_COLUMNS
from kreps.app.run_folder import RunFolder
from kreps.data.task import TaskSpec
from kreps.kernels.kernel import Kernel, factors_of
from kreps.learning.evaluate import Greedy, evaluate
from kreps.policies.sparse_gp import SparseGP
from kreps.presets import SECTIONS, flat

NAME = "kreps/SwingUp-v0"
SETTINGS = {
    "initial_rollouts": 6,
    "rollouts_per_iteration": 3,
    "window": 6,
    "restart_probability": 0.1,
}
TINY = [part for name, value in SETTINGS.items() for part in ("--set", f"{name}={value}")]
RUN_FILES = {"config.json", "progress.csv", "checkpoint.safetensors", "policy.safetensors"}


class Short(gym.Env[Any, Any]):
    """Three observations, short episodes, and a picture that cannot be drawn."""

    fails = False
    interrupts = False

    def __init__(self, render_mode: str | None = None) -> None:
        if Short.interrupts:
            raise KeyboardInterrupt
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Box(-10.0, 10.0, (3,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        return self.np_random.normal(size=3), {}

    def step(self, action: Any) -> Any:
        if Short.fails:
            raise RuntimeError("the cable came off")
        return self.np_random.normal(size=3), -float(action[0] ** 2), False, False, {}

    def render(self) -> Any:
        raise gym.error.DependencyNotInstalled("pygame is not installed")


@pytest.fixture(scope="module", autouse=True)
def _short() -> Iterator[None]:
    gym.register("kreps-tests/Short-v0", entry_point=Short, max_episode_steps=6)
    yield
    del gym.registry["kreps-tests/Short-v0"]


def call(*arguments: str | Path) -> tuple[int, str]:
    """Exit code and all that was printed, with white space made single; tracebacks propagate."""
    printed = io.StringIO()
    code: Any = 0
    with (
        pytest.MonkeyPatch.context() as patch,
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(printed),
    ):
        patch.setattr(sys, "argv", ["kreps", *map(str, arguments)])
        patch.setenv("COLUMNS", "600")
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code
    text = " ".join(printed.getvalue().split())
    assert "Traceback" not in text
    return code or 0, text


def rejected(*arguments: str | Path) -> str:
    """What is said by a command that ends with exit code 2."""
    code, text = call(*arguments)
    assert code == 2, text
    assert "error" in text.lower()
    return text


def train(run: Path, *more: str, environment: str = NAME, iterations: int = 2) -> tuple[int, str]:
    options = ["--iterations", str(iterations), "--out", run, "--no-report", *TINY, *more]
    return call("train", environment, *options)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("trained") / "run"
    assert train(run)[0] == 0
    return run


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A run of two iterations that a test may spoil."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def iteration(run: Path) -> int:
    return kreps.KREPS.resume(run / "checkpoint.safetensors").state.iteration


# ---- help -------------------------------------------------------------------------------------

COMMANDS = [c.name or c.callback.__name__ for c in cli.app.registered_commands if c.callback]


def test_all_commands_are_there() -> None:
    assert {"train", "resume", "evaluate", "plot", "video", "export"} <= set(COMMANDS)
    code, text = call("--help")
    assert code == 0
    assert all(name in text for name in COMMANDS)
    assert "kreps train kreps/SwingUp-v0" in text


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_of_every_command_shows_an_example(command: str) -> None:
    code, text = call(command, "--help")
    assert code == 0
    assert "Example" in text
    assert f"kreps {command} " in text.split("Example")[1]


def test_calling_it_without_anything_shows_the_help() -> None:
    assert "kreps train" in call()[1]


def test_the_examples_of_train_are_valid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = call("train", "--help")[1]
    examples = [e.split() for e in text.split("Examples:")[1].split(" kreps ")[1:]]
    examples = [e for e in examples if e[0] == "train" and "--data" not in e]
    mine = [e[1:] for e in examples if "my_robot" not in e[1]]
    assert len(mine) >= 3
    monkeypatch.chdir(tmp_path)
    for number, example in enumerate(mine):
        place = example.index("--out")
        example = example[: place + 2]  # the frame of the help may follow
        example[place + 1] = f"run-{number}"
        changed = [*example, "--iterations", "1", "--no-report", *TINY]
        assert call("train", *changed)[0] == 0


# ---- flags of settings ------------------------------------------------------------------------


def test_train_has_a_flag_for_each_setting() -> None:
    text = call("train", "--help")[1]
    settings = flat(kreps.Settings()) | flat(kreps.Settings(value=kreps.Grid()))
    assert len(settings) > 30
    for name, default in settings.items():
        shown = "none" if default is None else default
        assert f"--{name.replace('_', '-')} " in text
        if name not in SECTIONS:
            assert f"(default: {shown})" in text
    assert "FLOAT|none" in text and "dynamics|change|embedding|sample" in text


def test_a_flag_is_the_setting_of_its_name(tmp_path: Path) -> None:
    def stored(*options: str) -> Any:
        run = tmp_path / str(len([*tmp_path.iterdir()]))
        assert train(run, *options, iterations=1)[0] == 0
        return json.loads((run / "config.json").read_text())["settings"]

    flags = ["--kl-bound", "0.5", "--value", "grid", "--value.size=5", "--low-rank", "none"]
    names = ["kl_bound=0.5", "value=grid", "value.size=5", "low_rank=none"]
    by_name = stored(*(part for name in names for part in ("--set", name)))
    assert stored(*flags) == by_name
    assert by_name["low_rank"] is None and by_name["value.size"] == 5
    # of an option that is given several times the last one counts, and flags come last
    assert stored("--kl-bound", "0.5", "--set", "kl_bound=0.25")["kl_bound"] == 0.5


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--kl-bound", "wide"], "kl_bound = 'wide'"),
        (["--kl-bound", "-1"], "kl_bound = -1"),
        (["--window", "2.5"], "window = 2.5"),
        (["--value.size", "5"], "value.size"),
        (["--model-based", "none", "--model-based.max-samples", "9"], "leaves that section out"),
        (["--kl-bond", "1"], "--kl-bond"),
    ],
)
def test_mistakes_of_flags_are_those_of_the_settings(
    arguments: list[str], says: str, tmp_path: Path
) -> None:
    assert says in rejected("train", NAME, *arguments, "--out", tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("kreps exp", {"export"}),
        ("kreps train Pend", {"Pendulum-v1"}),
        ("kreps train --kl-b", {"--kl-bound"}),
        ("kreps train --policy-fit ", {"map", "bounded", "free"}),
        ("kreps train --low-rank n", {"none"}),
        ("kreps train --preset p", {"paper"}),
    ],
)
def test_a_shell_completes(line: str, wanted: set[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_KREPS_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", line)
    monkeypatch.setenv("COMP_CWORD", str(len(line.split(" ")) - 1))
    assert set(call()[1].split()) == wanted


# ---- envs -------------------------------------------------------------------------------------


def test_envs_lists_what_can_be_learnt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code, text = call("envs")
    assert code == 0
    assert "Pendulum-v1 3 observation and 1 action coordinates, a step of 0.05 s" in text
    assert "episodes of 200 steps; gymnasium.envs.classic_control.pendulum:PendulumEnv" in text
    assert (
        f"{NAME} 2 observation and 1" in text and "kreps-tests/Short-v0 3 observation and 1" in text
    )
    assert "CartPole" not in text and "gymnasium.register(" in text
    assert "CartPole-v1: the action space is Discrete(2)" in call("envs", "--all")[1]

    module = tmp_path / "robot_of_a_test.py"
    module.write_text(
        "import gymnasium\n"
        "from gymnasium.envs.classic_control import PendulumEnv\n"
        "class Mine(PendulumEnv): pass\n"
        "gymnasium.register('mine/Pendulum-v0', entry_point=Mine)\n"
        "gymnasium.register('mine/Broken-v0', entry_point='robot_of_a_test:Missing')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    for _ in range(2):  # also where the module is imported already
        code, text = call("envs", "robot_of_a_test", "--all")
        assert "mine/Pendulum-v0 3 observation and 1" in text and "robot_of_a_test:Mine" in text
        assert "mine/Broken-v0: cannot make the environment" in text
        assert "kreps/SwingUp" not in text
    for name in ("mine/Pendulum-v0", "mine/Broken-v0"):
        del gym.registry[name]
    assert "cannot import the module 'no_such_module'" in rejected("envs", "no_such_module")


# ---- train ------------------------------------------------------------------------------------


def test_a_run_folder_holds_what_is_needed_to_understand_it(trained: Path) -> None:
    assert {p.name for p in trained.iterdir()} == RUN_FILES
    config = json.loads((trained / "config.json").read_text())
    assert config["environment"] == NAME
    assert config["iterations"] == 2 and config["seed"] == 0
    assert config["preset"] == "model_based" and "recipe" not in config
    assert config["settings"] == SETTINGS
    assert config["versions"]["numpy"] == np.__version__
    with (trained / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["iteration"] for row in rows] == ["1", "2"]
    learner = kreps.KREPS.resume(trained / "checkpoint.safetensors")
    assert int(rows[0]["rollouts"]) >= 6 and int(rows[1]["rollouts"]) == learner.state.rollouts
    assert int(rows[-1]["steps"]) == learner.state.steps
    for row in rows:
        assert 0 < float(row["kl"]) <= float(row["kl_bound"]) * 1.001
        assert 1 <= float(row["effective_samples"]) <= int(row["weighted"])
        stages = [name for name in row if name.startswith("cpu_seconds_")]
        assert len(stages) >= 5 and sum(float(row[name]) for name in stages) > 0


def test_the_command_line_learns_what_the_library_learns(trained: Path, tmp_path: Path) -> None:
    learner = kreps.KREPS(gym.make(NAME), seed=0, **SETTINGS)
    learner.learn(2, progress=False).policy.save(tmp_path / "policy")
    assert (tmp_path / "policy").read_bytes() == (trained / "policy.safetensors").read_bytes()


def test_seed_preset_and_periodic_reach_the_learner(tmp_path: Path) -> None:
    run = tmp_path / "run"
    options = ["--seed", "5", "--preset", "paper", "--periodic", "0", "--periodic", "2"]
    options += ["--set", "model=sample", "--set", "kl_bound=0.25"]
    assert train(run, *options, environment="kreps-tests/Short-v0")[0] == 0
    learner = kreps.KREPS.resume(run / "checkpoint.safetensors")
    assert learner.seed == 5 and learner.task.periodic == (0, 2)
    settings = learner.settings
    assert settings.model == "sample" and settings.kl_bound == 0.25 and settings.window == 6
    assert settings.policy_fit == kreps.PRESETS["paper"].policy_fit
    code, text = call("resume", run, "--iterations", "3", "--no-report")
    assert code == 0, text
    assert kreps.KREPS.resume(run / "checkpoint.safetensors").task.periodic == (0, 2)


def test_a_whole_training_leaves_all_promised_files_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    few = ["--set", "initial_rollouts=6", "--set", "model_based.improvement_steps=1"]
    code, text = call("train", NAME, "--iterations", "2", "--out", "run", *few)
    assert code == 0
    pictures = {"learning_curve.png", "policy_maps.png", "trajectories.png", "video.gif"}
    evaluated = {"evaluation.json", "evaluation_rollouts.safetensors"}
    assert {p.name for p in Path("run").iterdir()} == RUN_FILES | pictures | evaluated
    for name in pictures:
        with Image.open(Path("run") / name) as picture:
            picture.load()
            assert min(picture.size) > 200
            assert len(np.unique(np.asarray(picture.convert("L")))) > 10  # something is drawn
    evaluation = json.loads(Path("run/evaluation.json").read_text())
    greedy = evaluation["greedy"]["mean"]
    assert evaluation["iteration"] == 2 and -150 < greedy < -20
    rollouts = kreps.KREPS.resume("run/checkpoint.safetensors").state.rollouts
    assert rollouts > 6 and f"2 updates from {rollouts} rollouts" in text
    assert f"earns {greedy:.4g} ± " in text and "of the way from" in text
    for name in ("run/policy.safetensors", "run/progress.csv", *(f"run/{p}" for p in pictures)):
        assert name in text
    assert "kreps resume run" in text


def test_a_run_is_not_overwritten(run: Path) -> None:
    before = {p.name: p.read_bytes() for p in run.iterdir()}
    text = rejected("train", NAME, "--out", run, *TINY)
    assert "holds a run already" in text
    assert "kreps resume" in text and "another folder" in text
    assert {p.name: p.read_bytes() for p in run.iterdir()} == before


def test_an_empty_folder_may_be_used(tmp_path: Path) -> None:
    assert train(tmp_path, iterations=1)[0] == 0
    assert {p.name for p in tmp_path.iterdir()} == RUN_FILES


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere/Nothing-v0"], "nowhere/Nothing-v0"),
        (["no_such_module:Nothing-v0"], "no_such_module"),
        (["SwingUp"], "SwingUp"),
        ([""], "environment"),
        (["CartPole-v1"], "Discrete(2)"),
        ([NAME, "--preset", "cake"], "'model_based', 'single_step', 'paper'"),
        ([NAME, "--preset", "observed"], "single_step"),
        ([NAME, "--recipe", "observed"], "--preset single_step"),
        ([NAME, "--recipe", "paper"], "--preset paper"),
        ([NAME, "--set", "value=cake"], "cake"),
        ([NAME, "--set", "value.size=5"], "value.size"),
        ([NAME, "--set", "value=none"], "value"),
        ([NAME, "--set", "value=grid", "--set", "value.max_rank=5"], "value.max_rank"),
        (
            [NAME, "--set", "model_based.max_samples=9", "--set", "model_based=none"],
            "model_based = None leaves that section out",
        ),
        ([NAME, "--set", "model_based.acceptance_rollouts=1"], "acceptance_rollouts = 1"),
        ([NAME, "--set", "imagined_noise=1.1"], "model_based.proposal_std_scale"),
        ([NAME, "--set", "kl_bound"], "NAME=VALUE"),
        ([NAME, "--set", "kl_bound=wide"], "kl_bound = 'wide'"),
        ([NAME, "--set", "kl_bound=-1"], "kl_bound = -1"),
        ([NAME, "--set", "kl_bound=NaN"], "kl_bound = nan"),
        ([NAME, "--set", "kl_bound="], "kl_bound"),
        ([NAME, "--set", "kl_bond=1"], "kl_bond"),
        ([NAME, "--set", "=1"], "parameter"),
        ([NAME, "--set", "window=2.5"], "window = 2.5"),
        ([NAME, "--set", "model=[1]"], "model = [1]"),
        ([NAME, "--set", 'model="[/bold]"'], "[/bold]"),
        ([NAME, "--set", "seed=3"], "seed"),
        ([NAME, "--set", "preset=paper"], "preset"),
        ([NAME, "--set", "periodic=0"], "periodic"),
        ([NAME, "--set", "env=1"], "env"),
        ([NAME, "--set", "threads=many"], "threads"),
        ([NAME, "--periodic", "7"], "coordinates [7]"),
        ([NAME, "--iterations", "0"], "--iterations"),
        ([NAME, "--iterations", "many"], "--iterations"),
        ([NAME, "--seed", "-1"], "--seed"),
        ([NAME, "--colour", "red"], "--colour"),
    ],
)
def test_mistakes_are_named_and_leave_no_folder(
    arguments: list[str], says: str, tmp_path: Path
) -> None:
    text = rejected("train", *arguments, "--out", tmp_path / "run")
    assert says in text
    assert not (tmp_path / "run").exists()


def test_train_needs_a_folder(tmp_path: Path) -> None:
    assert "--out" in rejected("train", NAME)
    (tmp_path / "file").write_text("")
    assert "file" in rejected("train", NAME, "--out", tmp_path / "file", *TINY)
    assert "file" in rejected("train", NAME, "--out", tmp_path / "file" / "run", *TINY)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["value=grid", "value.size=5"], {"value": kreps.Grid(5)}),
        (["value.size=5", "value=grid"], {"value": kreps.Grid(5)}),
        (["model_based=none"], {"model_based": None}),
        (["model_based=None"], {"model_based": None}),
        (
            ["model_based.acceptance_rollouts=0"],
            {"model_based": kreps.ModelBased(acceptance_rollouts=0)},
        ),
        (["low_rank=none", "eta_floor=0.03"], {"low_rank": None, "eta_floor": 0.03}),
        (["exploration=pink"], {"exploration": kreps.Exploration("pink")}),
    ],
)
def test_settings_reach_the_learner(
    options: list[str], expected: dict[str, Any], tmp_path: Path
) -> None:
    given = [part for option in options for part in ("--set", option)]
    assert train(tmp_path, *given, iterations=1)[0] == 0
    settings = kreps.KREPS.resume(tmp_path / "checkpoint.safetensors").settings
    assert {name: getattr(settings, name) for name in expected} == expected
    stored = json.loads((tmp_path / "config.json").read_text())["settings"]
    assert set(stored) == {option.split("=")[0] for option in options} | set(SETTINGS)


@pytest.mark.parametrize("preset", list(kreps.PRESETS))
def test_settings_lists_every_setting_with_its_value_and_meaning(preset: str) -> None:
    code, text = call("settings", "--preset", preset)
    assert code == 0
    for name, value in kreps.presets.flat(kreps.PRESETS[preset]).items():
        shown = f"{name} = {'none' if value is None else value}"
        meaning = text.partition(f" {shown} ")[2].partition(" = ")[0]
        assert len(meaning) > 20, shown


# ---- resume -----------------------------------------------------------------------------------


def test_resume_makes_the_updates_that_are_missing(run: Path) -> None:
    code, text = call("resume", run, "--iterations", "3", "--no-report")
    assert code == 0
    assert "2 updates made, 1 to go" in text
    assert iteration(run) == 3
    before = (run / "policy.safetensors").read_bytes()
    for more in ([], ["--iterations", "1"]):
        code, text = call("resume", run, "--no-report", *more)
        assert code == 0 and "0 to go" in text
        assert (run / "policy.safetensors").read_bytes() == before


def test_a_run_that_stopped_before_its_first_update_can_be_resumed(
    run: Path, trained: Path
) -> None:
    for name in RUN_FILES - {"config.json"}:
        (run / name).unlink()
    for command in ("evaluate", "plot", "video"):
        assert "kreps resume" in rejected(command, run)
    assert call("resume", run, "--no-report")[0] == 0
    name = "policy.safetensors"
    assert (run / name).read_bytes() == (trained / name).read_bytes()


def test_an_interrupted_resume_gives_advice_that_goes_on(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(run.parent)
    with monkeypatch.context() as patch:
        patch.setattr(kreps.KREPS, "learn", interrupt)
        code, text = call("resume", "run", "--iterations", "4", "--no-report")
    assert code == 130
    assert "stopped after 2 of 4" in text
    advice = text.split("continue with: kreps ")[1].split()
    assert advice[:2] == ["resume", "run"]
    assert call(*advice, "--no-report")[0] == 0
    assert iteration(run) == 4


def test_ctrl_c_in_other_commands_is_no_success_and_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    assert train(run, environment="kreps-tests/Short-v0", iterations=1)[0] == 0
    monkeypatch.setattr(Short, "interrupts", True)
    for command in ("evaluate", "plot", "video"):
        assert call(command, run)[0] == 130


def test_an_environment_that_fails_can_be_repaired_and_the_run_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    assert train(run, environment="kreps-tests/Short-v0", iterations=1)[0] == 0
    monkeypatch.setattr(Short, "fails", True)
    text = rejected("resume", run, "--iterations", "2")
    assert "the cable came off" in text and "kreps resume" in text
    assert iteration(run) == 1
    monkeypatch.setattr(Short, "fails", False)
    assert call("resume", run, "--iterations", "2", "--no-report")[0] == 0
    assert iteration(run) == 2


# ---- evaluate, plot, video --------------------------------------------------------------------


def test_evaluate_measures_both_policies(run: Path) -> None:
    code, text = call("evaluate", run, "--episodes", "20", "--steps", "60", "--seed", "4")
    assert code == 0
    found = json.loads((run / "evaluation.json").read_text())
    learner = kreps.KREPS.resume(run / "checkpoint.safetensors", gym.make(NAME))
    policy = learner.state.policy
    assert policy is not None and learner.env is not None
    for name, acting in (("stochastic", policy), ("greedy", Greedy(policy))):
        mine = evaluate(
            learner.env,
            learner.task,
            acting,
            restart_probability=0.1,
            episodes=20,
            steps=60,
            seed=4,
        )
        assert found[name]["mean"] == pytest.approx(mine.mean, rel=1e-9)
        assert found[name]["standard_error"] == pytest.approx(mine.standard_error, rel=1e-6)
        assert f"{mine.mean:.5g}" in text and f"{2 * mine.standard_error:.2g}" in text
    assert found["seed"] == 4 and found["iteration"] == 2
    assert "--episodes" in rejected("evaluate", run, "--episodes", "1")
    assert "--steps" in rejected("evaluate", run, "--steps", "0")


def test_plot_draws_with_and_without_an_evaluation(run: Path) -> None:
    code, text = call("plot", run)
    assert code == 0
    for name in ("learning_curve.png", "policy_maps.png"):
        assert name in text.replace(" ", "")
        assert (run / name).stat().st_size > 5000
    assert f"kreps evaluate {run}" in text and not (run / "trajectories.png").exists()
    without = (run / "learning_curve.png").read_bytes()
    call("evaluate", run, "--episodes", "2", "--steps", "20")
    assert call("plot", run)[0] == 0
    assert (run / "learning_curve.png").read_bytes() != without
    assert (run / "trajectories.png").stat().st_size > 5000
    call("resume", run, "--iterations", "3", "--no-report")
    code, text = call("plot", run)  # the evaluation is of an earlier policy now
    assert code == 0 and f"kreps evaluate {run}" in text and "trajectories.png" not in text


def test_an_evaluation_stores_the_first_rollouts_of_the_greedy_policy(run: Path) -> None:
    call("evaluate", run, "--episodes", "12", "--steps", "20", "--seed", "4")
    learner = kreps.KREPS.resume(run / "checkpoint.safetensors")
    stored = RunFolder(run).evaluation_rollouts(2)
    assert stored is not None and list(stored.lengths) == [20] * 10
    for rollout in stored:
        greedy = learner.policy.process.greedy(rollout.observations[:-1])
        np.testing.assert_allclose(rollout.actions, greedy, rtol=1e-9, atol=1e-9)
    assert RunFolder(run).evaluation_rollouts(1) is None  # of another policy


def test_drawing_moves_no_environment(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call("evaluate", run, "--episodes", "2", "--steps", "20")
    for name in ("step", "reset"):  # a robot would move
        monkeypatch.setattr(type(gym.make(NAME).unwrapped), name, None)
    assert call("plot", run)[0] == 0
    assert (run / "trajectories.png").exists()


def test_damaged_rollouts_of_an_evaluation_are_an_error_of_the_library(run: Path) -> None:
    call("evaluate", run, "--episodes", "2", "--steps", "20")
    file = run / "evaluation_rollouts.safetensors"
    file.write_bytes(file.read_bytes()[:-7])
    assert file.name in rejected("plot", run).replace("\n", "")


def test_video_films_as_many_steps_as_asked_for(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "film.gif"
    assert call("video", run, "--steps", "4", "--out", out)[0] == 0
    with Image.open(out) as film:
        assert film.n_frames == 4
        assert film.info["duration"] == 50
    assert not (run / "video.gif").exists()
    assert call("video", run, "--steps", "3", "--stochastic")[0] == 0
    assert (run / "video.gif").exists()


@pytest.mark.parametrize("out", ["film.mp4", "film", "run"])
def test_films_that_cannot_be_written_are_refused(
    out: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert out in rejected("video", run, "--steps", "2", "--out", out)


def test_a_film_into_a_missing_folder_is_made_or_refused(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "missing" / "film.gif"
    code, _ = call("video", run, "--steps", "2", "--out", out)
    assert code == (0 if out.exists() else 2)


def test_pictures_that_cannot_be_written_are_an_error_of_the_library(run: Path) -> None:
    for name in ("learning_curve.png", "video.gif"):
        (run / name).mkdir()
    assert "learning_curve.png" in rejected("plot", run)
    assert "video.gif" in rejected("video", run, "--steps", "2")


def test_results_below_a_file_are_an_error_of_the_library(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for figure in ("figure-1a", "figure-2a"):
        text = rejected("reproduce", figure, "--trials", "1", "--out", tmp_path / "file" / "x")
        assert "Not a directory" in text


def test_an_environment_that_cannot_be_drawn_still_gets_its_report(tmp_path: Path) -> None:
    run = tmp_path / "run"
    options = ["--iterations", "1", "--out", run, *TINY]
    code, text = call("train", "kreps-tests/Short-v0", *options)
    assert code == 0
    rollouts = kreps.KREPS.resume(run / "checkpoint.safetensors").state.rollouts
    assert rollouts > 6 and f"1 updates from {rollouts} rollouts" in text  # episodes end early
    assert (run / "learning_curve.png").exists()
    assert not (run / "policy_maps.png").exists()  # three-dimensional states
    assert "pygame is not installed" in rejected("video", run)


# ---- export -----------------------------------------------------------------------------------

STATES = np.random.default_rng(0).normal(size=(20, 2))


def actions_of(model: Path, dtype: str = "float64") -> Any:
    """What an ONNX model does in `STATES`."""
    onnxruntime = pytest.importorskip("onnxruntime")
    session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    return session.run(["action"], {"observation": STATES.astype(dtype)})[0]


def greedy_actions(policy: Path) -> Any:
    return kreps.load_policy(policy).predict(STATES, deterministic=True)[0]


def test_export_writes_a_model_of_a_run_or_of_a_policy(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    policy = run / "policy.safetensors"
    for source, out in ((run, tmp_path / "a.onnx"), (policy, tmp_path / "b.onnx")):
        code, text = call("export", source, "--out", out)
        assert code == 0 and f"wrote {out}" in text and "float64 arithmetic" in text
        np.testing.assert_allclose(actions_of(out), greedy_actions(policy), atol=1e-6 * 30.0)
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()
    assert {path.name for path in run.iterdir()} == RUN_FILES


def test_export_compresses_and_narrows(run: Path, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    out, small = tmp_path / "x.onnx", tmp_path / "small.safetensors"
    code, text = call("export", run, "--centres", "5", "--dtype", "float32", "--out", out)
    assert code == 0 and "float32 arithmetic" in text and "changes by" in text
    assert call("export", run, "--centres", "5", "--out", small)[0] == 0
    assert len(kreps.load_policy(small).process.states) == 5  # type: ignore[attr-defined]
    np.testing.assert_allclose(actions_of(out, "float32"), greedy_actions(small), atol=1e-4 * 30.0)
    code, text = call("export", small, "--out", tmp_path / "again.onnx")
    assert code == 0
    np.testing.assert_allclose(
        actions_of(tmp_path / "again.onnx"), greedy_actions(small), atol=1e-6 * 30.0
    )


def test_export_says_where_single_precision_is_not_enough(tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    rng = np.random.default_rng(0)
    large = SparseGP(  # large weights of both signs: rounding errors of the kernel are amplified
        task=TaskSpec(2, [-30.0], [30.0]),
        kernel=Kernel(factors_of(2, ()), np.array([1.0, 1.0])),
        states=rng.normal(size=(20, 2)),
        mean_weights=1e5 * rng.normal(size=(20, 1)),
        explained=0.1 * np.eye(20),
        signal=1.0,
        noise=0.1,
    )
    kreps.Policy(large).save(tmp_path / "large.safetensors")
    code, text = call(
        "export", tmp_path / "large.safetensors", "--dtype", "float32", "--out", tmp_path / "x.onnx"
    )
    assert code == 0 and "float64 arithmetic" in text and "--centres" in text


def test_export_says_what_compression_costs(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the policy of this run is nearly constant
    monkeypatch.setattr(sys.modules["kreps.app.cli.export"], "MAX_COMPRESSION_ERROR", 1e-3)
    out = tmp_path / "x.safetensors"
    text = call("export", run, "--centres", "1", "--out", out)[1]
    assert "take more centres" in text
    exact = kreps.load_policy(run / "policy.safetensors")
    states = exact.process.states  # type: ignore[attr-defined]
    few = kreps.load_policy(out)
    off = [p.predict(states, deterministic=True)[0] for p in (exact, few)]
    rms = np.sqrt(np.mean(((off[0] - off[1]) / 30.0) ** 2))
    assert f"changes by {rms:.2g} of its scale" in text
    text = call("export", run, "--centres", str(len(states) - 1), "--out", out)[1]
    assert "changes by" in text and "take more centres" not in text
    assert "changes by" not in call("export", run, "--centres", "5000", "--out", out)[1]


def test_export_without_centres_copies_a_policy(run: Path, tmp_path: Path) -> None:
    assert call("export", run, "--out", tmp_path / "x.safetensors")[0] == 0
    assert (tmp_path / "x.safetensors").read_bytes() == (run / "policy.safetensors").read_bytes()


def test_export_writes_c_source(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, text = call("export", run, "--centres", "5", "--to", "c", "--dtype", "float32")
    assert code == 0 and "wrote policy.c: C source, beside its header policy.h" in text
    assert call("export", run, "--centres", "5", "--out", "arm.c")[0] == 0
    assert "float policy_number;" in (tmp_path / "policy.h").read_text()
    assert "int arm_act(" in (tmp_path / "arm.c").read_text()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--out", "x.tflite"], "'tflite' is no format of a policy; choose one of onnx, c, safe"),
        (["--out", "x"], "choose one of onnx, c, safetensors"),
        (["--to", "rust"], "choose one of onnx, c, safetensors"),
        (["--to", "c", "--out", "x.onnx"], "x.onnx does not end in .c"),
        (["--out", "my-arm.c"], "such as arm_policy.c"),
        ([], "write --out policy.onnx"),
        (["--out", "x.onnx", "--centres", "0"], "--centres"),
        (["--out", "x.onnx", "--centres", "few"], "--centres"),
        (["--out", "x.onnx", "--dtype", "float16"], "float64, float32"),
        (["--out", "x.onnx", "--dtype", ""], "float64, float32"),
        (["--out", "x.safetensors", "--dtype", "float32"], "write an .onnx or .c file"),
        (["--out", "missing/x.onnx"], "cannot write missing/x.onnx"),
        (["--out", "missing/x.safetensors"], "cannot write missing/x.safetensors"),
        (["--out", "run/policy.safetensors", "--centres", "5"], "choose another name"),
        (["--out", "run/../run/policy.safetensors"], "choose another name"),
    ],
)
def test_exports_that_cannot_be_served_are_refused_and_leave_nothing(
    arguments: list[str], says: str, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("onnx")
    before = (run / "policy.safetensors").read_bytes()
    monkeypatch.chdir(tmp_path)
    assert says in rejected("export", run, *arguments)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    assert {path.name for path in run.iterdir()} == RUN_FILES
    assert (run / "policy.safetensors").read_bytes() == before


def test_exports_of_what_holds_no_policy_are_refused(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.onnx"
    assert "not a run folder" in rejected("export", tmp_path, "--out", out)
    assert "check the path" in rejected("export", tmp_path / "missing", "--out", out)
    checkpoint = run / "checkpoint.safetensors"
    assert "it is a kreps checkpoint" in rejected("export", checkpoint, "--out", out)
    (run / "policy.safetensors").unlink()
    assert "kreps resume" in rejected("export", run, "--out", out)
    assert not out.exists()


def test_a_compressed_policy_is_compressed_to_fewer_centres_only(run: Path, tmp_path: Path) -> None:
    small, out = tmp_path / "small.safetensors", tmp_path / "x.safetensors"
    call("export", run, "--centres", "5", "--out", small)
    assert call("export", small, "--centres", "3", "--out", out)[0] == 0
    fewer = kreps.load_policy(out).process
    assert isinstance(fewer, SparseGP) and len(fewer.states) == 3
    assert call("export", small, "--centres", "5", "--out", out)[0] == 0
    assert out.read_bytes() == small.read_bytes()


# ---- runs of version 0.1 ----------------------------------------------------------------------

OLD_RUN = Path(__file__).parent / "data/v0.1/run"
OLD_COLUMNS = {
    "rejected": "refused",
    "cpu_seconds_generated_samples": "cpu_seconds_imagined_step",
    "cpu_seconds_acceptance_test": "cpu_seconds_judgement",
}


@pytest.fixture
def old_run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(OLD_RUN, tmp_path / "old"))


def test_a_configuration_of_version_0_1_has_present_names(old_run: Path) -> None:
    config = RunFolder(old_run).config()
    assert config.preset == "single_step"
    assert config.settings == {  # settings without effect are left out
        "restart_probability": 0.12,
        "initial_rollouts": 5,
        "rollouts_per_iteration": 3,
        "window": 5,
    }
    content = json.loads((old_run / "config.json").read_text())
    content |= {"recipe": "default", "settings": {"judging_rollouts": 10, "max_rank": 200}}
    (old_run / "config.json").write_text(json.dumps(content))
    config = RunFolder(old_run).config()
    assert config.preset == "model_based"
    assert config.settings == {"model_based.acceptance_rollouts": 10, "value.max_rank": 200}


def test_a_progress_file_of_version_0_1_has_present_names(old_run: Path) -> None:
    with (old_run / "progress.csv").open(newline="") as file:
        old = list(csv.DictReader(file))
    rows = RunFolder(old_run).rows()
    assert len(rows) == len(old) == 2
    for row, stored in zip(rows, old, strict=True):
        first = ADDED_COLUMNS.index("reward_lower_quartile")  # added after version 0.1
        later = dict.fromkeys(ADDED_COLUMNS[first:], "nan")
        known = set(row) - set(later)
        assert row == {name: stored[OLD_COLUMNS.get(name, name)] for name in known} | later
        assert len(known) == len(stored) and set(OLD_COLUMNS) <= known


def test_a_run_of_version_0_1_is_inspected_and_resumed(old_run: Path) -> None:
    earlier = RunFolder(old_run).rows()
    for command in ("plot", "diagnose", "video"):
        assert call(command, old_run)[0] == 0
    assert call("resume", old_run, "--iterations", "3", "--no-report")[0] == 0
    with (old_run / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[:2] == earlier and rows[2]["iteration"] == "3"
    assert set(OLD_COLUMNS) <= set(rows[0]) and not set(OLD_COLUMNS.values()) & set(rows[0])
    config = json.loads((old_run / "config.json").read_text())
    assert config["preset"] == "single_step" and "recipe" not in config


def test_a_run_of_version_0_1_that_stopped_before_its_first_update_is_learnt(
    old_run: Path,
) -> None:
    for name in RUN_FILES - {"config.json"}:
        (old_run / name).unlink()
    assert call("resume", old_run, "--no-report")[0] == 0
    settings = kreps.KREPS.resume(old_run / "checkpoint.safetensors").settings
    stored = kreps.KREPS.resume(OLD_RUN / "checkpoint.safetensors").settings
    assert settings == stored


# ---- folders that are no runs, and damaged ones -----------------------------------------------

ON_RUNS = ["resume", "evaluate", "plot", "video"]


@pytest.mark.parametrize("command", ON_RUNS)
def test_a_folder_that_is_no_run_is_refused_with_a_remedy(command: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("hello")
    for place in (tmp_path, tmp_path / "missing", tmp_path / "file"):
        text = rejected(command, place)
        assert "not a run folder" in text and "kreps train" in text
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("name", ["run[/red]", "run[red]"])
def test_brackets_in_a_path_are_no_markup(name: str, tmp_path: Path) -> None:
    assert name in rejected("resume", tmp_path / name)


def test_brackets_in_a_path_are_no_markup_where_all_is_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, text = train(Path("run[a]"), iterations=1)
    assert code == 0 and "run[a]/policy.safetensors" in text
    code, text = call("resume", "run[a]", "--no-report")
    assert code == 0 and "run[a]: 1 updates made" in text


CONFIG = {
    "environment": NAME,
    "iterations": 2,
    "seed": 0,
    "preset": "model_based",
    "settings": {},
    "periodic": None,
}


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "null",
        "[]",
        "{}",
        "[" * 100_000,
        "\0" * 100,
        json.dumps({**CONFIG, "colour": "red"}),
        json.dumps({**CONFIG, "environment": 7}),
        json.dumps({**CONFIG, "environment": "nowhere/Nothing-v0"}),
        json.dumps({**CONFIG, "iterations": "two"}),
        json.dumps({**CONFIG, "seed": -1}),
        json.dumps({**CONFIG, "seed": None}),
        json.dumps({**CONFIG, "preset": []}),
        json.dumps({**CONFIG, "preset": "cake"}),
        json.dumps({**CONFIG, "recipe": "default"}),
        json.dumps({**CONFIG, "settings": []}),
        json.dumps({**CONFIG, "settings": {"seed": 1}}),
        json.dumps({**CONFIG, "settings": {"kl_bound": "wide"}}),
        json.dumps({**CONFIG, "periodic": 0}),
        json.dumps({**CONFIG, "periodic": ["x"]}),
        json.dumps({**CONFIG, "periodic": [9]}),
    ],
)
def test_a_damaged_configuration_is_an_error_of_the_library(content: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(content)
    rejected("resume", tmp_path, "--no-report")


@pytest.mark.parametrize("command", ON_RUNS)
def test_a_damaged_checkpoint_is_an_error_of_the_library(command: str, run: Path) -> None:
    checkpoint = run / "checkpoint.safetensors"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    assert "checkpoint" in rejected(command, run)
    checkpoint.write_bytes((run / "policy.safetensors").read_bytes())
    assert "it is a kreps policy" in rejected(command, run)


def test_a_checkpoint_of_another_task_is_refused(run: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    train(other, environment="kreps-tests/Short-v0", iterations=1)
    shutil.copy(other / "checkpoint.safetensors", run / "checkpoint.safetensors")
    assert "environment of the checkpoint" in rejected("resume", run)


def _without_column(text: str) -> str:
    return "\n".join(line.split(",", 3)[3] for line in text.splitlines())


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "",
        lambda text: "\0" * 200,
        lambda text: "iteration,foo\nabc,1\n",
        lambda text: text.replace("\n1,", "\none,"),
        lambda text: text[: len(text) // 2],
        lambda text: text.splitlines()[0] + "\n",
        _without_column,
        lambda text: text.replace("BOUND_ACTIVE", '"' * 3),
        lambda text: text + "1,2\n",
    ],
    ids=["empty", "zeros", "foreign", "word", "half", "heading", "columns", "quotes", "short row"],
)
def test_a_damaged_progress_file_is_no_traceback(damage: Callable[[str], str], run: Path) -> None:
    progress = run / "progress.csv"
    progress.write_text(damage(progress.read_text()))
    assert call("plot", run)[0] in (0, 2)
    assert call("resume", run, "--iterations", "3", "--no-report")[0] in (0, 2)


@pytest.mark.parametrize("content", ["", "{", "[]", "null", '{"iteration": 2}', "\0"])
def test_a_damaged_evaluation_is_no_traceback(content: str, run: Path) -> None:
    (run / "evaluation.json").write_text(content)
    assert call("plot", run)[0] in (0, 2)


# ---- in a real process ------------------------------------------------------------------------


def test_errors_go_to_stderr_as_one_message_without_a_traceback(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "kreps", "evaluate", str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error:") and "Traceback" not in done.stderr


def test_the_installed_command_is_the_same() -> None:
    command = Path(sys.executable).with_name("kreps")
    if not command.exists():
        pytest.skip("kreps is not installed as a command")
    done = subprocess.run(
        [command, "--help"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0 and "train" in done.stdout
