"""The example runs, and the numbers and statements of its text hold."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

from kreps.algorithms.dual import kl_from_uniform

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = ROOT / "examples/one_update.py"
PAGE = ROOT / "docs/one_update.md"
PICTURES = ["1_data", "2_kernel", "3_embedding", "4_dual", "5_weights", "6_policy"]


class Walk(NamedTuple):
    """One run of the example: its variables, and the folder of its pictures."""

    names: dict[str, Any]
    pictures: Path


def run(folder: Path, *options: str) -> Walk:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(SCRIPT), "--out", str(folder), *options])
        names = runpy.run_path(str(SCRIPT), run_name="__main__")
    return Walk(names, folder)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    """The run with the default arguments, which the page shows."""
    return run(tmp_path_factory.mktemp("shown"))


@pytest.fixture(scope="module", params=["shown", "small"])
def walk(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Walk:
    if request.param == "shown":
        found: Walk = request.getfixturevalue("shown")
        return found
    return run(tmp_path_factory.mktemp("small"), "--rollouts", "6", "--seed", "1")


def markdown_cells() -> list[str]:
    cells = re.split(r"(?m)^(?=# %%)", SCRIPT.read_text())
    texts = [c.rstrip("\n").split("\n")[1:] for c in cells if c.startswith("# %% [markdown]")]
    return ["\n".join(line[2:] for line in text) for text in texts]


# ---- what holds for any samples ---------------------------------------------------------------


def test_there_is_a_picture_per_step(walk: Walk) -> None:
    assert sorted(p.stem for p in walk.pictures.iterdir()) == PICTURES
    for name in PICTURES:
        path = walk.pictures / f"{name}.png"
        assert path.stat().st_size < 80_000
        with Image.open(path) as picture:
            picture.load()
            assert 1000 <= picture.width <= 1300
            assert len(set(picture.convert("L").resize((60, 30)).tobytes())) > 10  # not empty


def test_the_reward_depends_on_the_state_only(walk: Walk) -> None:
    w = walk.names
    np.testing.assert_allclose(w["data"].rewards, np.cos(w["states"]) - 1.0)
    assert len(w["data"]) == sum(len(r) for r in w["rollouts"]) == w["n"]


def test_the_features_reproduce_the_kernel(walk: Walk) -> None:
    w = walk.names
    features = w["features"]
    gram = w["kernel"].gram(w["data"].points)
    np.testing.assert_allclose(features @ features.T, gram, atol=2e-6)
    assert features.shape[1] < 20 < w["n"]
    residuals = w["residuals"].max(axis=0)
    assert residuals[-1] < 1e-6 < residuals[-2]


def test_the_embedding_averages_the_noise_out(walk: Walk) -> None:
    w = walk.names
    assert w["beta"].sum() == pytest.approx(1.0, abs=0.1)
    error, of_one = w["embedded_f"] - w["true_f"], w["observed_f"] - w["true_f"]
    assert w["rms"](error) < 0.6 * w["rms"](of_one)
    # the strengths and the expected features give the same expectation
    theta = w["basis"].features(w["goal"])[0]
    np.testing.assert_allclose(w["expected"] @ theta, w["embedded_f"], atol=1e-3)


def test_the_embedding_predicts_changes_of_the_features(walk: Walk) -> None:
    w = walk.names
    assert w["settings"].model == "change"
    np.testing.assert_array_equal(w["own"], w["features"][w["data"].state])
    np.testing.assert_allclose(w["own"] + w["changes"], w["successors"], atol=1e-12)
    off = [w["rms"](w[name] - w["true_at_pair"]) for name in ("embedded_at_pair", "at_pair")]
    assert off[0] < 0.5 * off[1]
    # the drawn curve agrees with the expected features of the pair
    features = w["features"][w["data"].successor] - w["features"][w["data"].state]
    expected = w["basis"].features(w["pair"][:, :1])[0] + w["beta"] @ features
    np.testing.assert_allclose(w["on_grid"] @ expected, w["embedded_at_pair"], atol=5e-3)


def test_the_true_expectation_agrees_with_a_simulation(shown: Walk) -> None:
    w = shown.names
    noise = w["NOISE"] * np.random.default_rng(0).standard_normal((4000, 1, 1))
    moved = w["data"].states + w["PERIOD"] * np.clip(w["data"].actions, -2.0, 2.0) + noise
    values = w["near_goal"](w["wrap"](moved).reshape(-1, 1)).reshape(4000, -1)
    np.testing.assert_allclose(values.mean(axis=0), w["true_f"], atol=0.02)


def test_kl_crosses_its_bound_at_the_minimum_of_the_dual(walk: Walk) -> None:
    w = walk.names
    dual, problem, bound = w["dual"], w["problem"], w["settings"].kl_bound
    assert dual.eta > problem.eta_floor
    assert kl_from_uniform(w["p"]) == pytest.approx(bound, rel=1e-4)
    assert abs(dual.gap) < 1e-4
    etas, realised = w["etas"], np.array(w["realised"])
    assert (realised[etas < dual.eta] > bound).all()
    assert (realised[etas > dual.eta] < bound).all()
    assert (np.diff(realised) < 0).all()
    assert etas[np.argmin(w["profile"])] == dual.eta
    assert all(end.converged and end.eta == eta for end, eta in zip(w["held"], etas, strict=True))
    assert w["surface"].min() >= dual.dual - 1e-9


def test_the_weights_are_a_softmax_of_the_bellman_errors(walk: Walk) -> None:
    w = walk.names
    p, delta = w["p"], w["delta"]
    assert p.sum() == pytest.approx(1.0, abs=1e-12)
    assert (p > 0).all()
    np.testing.assert_allclose(w["dual"].eta * np.log(p / p[0]), delta - delta[0], atol=1e-9)


def test_the_weights_are_stationary_up_to_the_ridge(walk: Walk) -> None:
    w = walk.names
    problem, theta = w["problem"], w["dual"].theta
    imbalance = problem.differences.T @ w["p"]
    np.testing.assert_allclose(imbalance, -problem.ridge * theta, atol=1e-5)
    alone = problem.differences.T @ w["greedy_p"]
    assert np.linalg.norm(imbalance) < 0.2 * np.linalg.norm(alone)


def test_one_call_gives_the_same_policy(walk: Walk) -> None:
    assert walk.names["same"]


# ---- statements of the page about the run that it shows -----------------------------------------


def test_bellman_errors_depend_on_the_action(shown: Walk) -> None:
    w = shown.names
    states, actions, delta = w["states"], w["actions"], w["delta"]
    for side in (-1.0, 1.0):
        there = (side * states > 0.5) & (side * states < 2.6)
        assert there.sum() > 20
        assert -side * np.corrcoef(actions[there], delta[there])[0, 1] > 0.3
    value = w["value"](w["GRID"][:, None])
    assert abs(w["GRID"][np.argmax(value)]) < 0.3


def test_without_v_visits_to_the_goal_exceed_arrivals(shown: Walk) -> None:
    w = shown.names
    alone, with_v = w["net_arrivals"](w["greedy_p"]), w["net_arrivals"](w["p"])
    assert abs(w["GRID"][np.argmin(alone)]) < 0.3
    assert alone.min() < -0.03
    assert np.abs(with_v).max() < 0.1 * np.abs(alone).max()


def test_the_policy_moves_to_the_goal_from_both_sides(shown: Walk) -> None:
    w = shown.names
    at = np.array([[-np.pi / 2], [np.pi / 2], [np.pi], [0.0]])
    left, right, opposite, _ = w["policy"].mean(at)[:, 0]
    assert left > 1.0 and right < -1.0
    assert abs(opposite) < 0.3
    assert abs(w["GRID"][np.argmin(w["sd"])]) < 0.5
    assert w["average_before"] < -0.9
    assert w["average_after"] > -0.4


def test_the_page_has_the_text_and_the_pictures_of_the_example() -> None:
    page = PAGE.read_text()
    cells = markdown_cells()
    assert len(cells) == 9
    places = [page.index(cell) for cell in cells]
    assert places == sorted(places)
    embedded = re.findall(r"!\[[^]]+\]\(pictures/one_update/(\w+)\.png\)", page)
    assert embedded == PICTURES
    for name in PICTURES:
        assert (PAGE.parent / f"pictures/one_update/{name}.png").stat().st_size < 80_000


def test_the_links_of_the_page_lead_to_the_definitions() -> None:
    links = re.findall(r"\[`([\w.]+)`\]\((\S+?\.py)\)", PAGE.read_text())
    assert len(links) >= 14
    for name, path in links:
        text = (PAGE.parent / path).read_text()
        for word in name.split("."):
            assert re.search(rf"(def|class) {word}\b", text), (name, path)


def test_the_page_shows_the_numbers_of_the_run(shown: Walk) -> None:
    block = PAGE.read_text().split("```")[-2].strip().split("\n")
    facts = shown.names["facts"]
    printed = {line[:48].strip(): line[48:].strip() for line in block[:-1]}
    assert list(printed) == list(facts)
    for name, fact in facts.items():
        assert float(printed[name]) == pytest.approx(fact, rel=0.02, abs=1e-5), name
    assert block[-1].endswith("the same policy")
