"""Rows as data frames: what they hold, of every class that has some."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest

import factored_polca as fp
from factored_polca.display.extras import MissingLibrary
from factored_polca.display.frames import FRAMED_BY, columns
from factored_polca.drawn import Framed
from factored_polca.minimisation.flat_model import flat_model

pytest.importorskip("pandas")


@pytest.fixture(scope="module")
def taxi() -> fp.HierarchicalPlan:
    domain = fp.load_domain("taxi")
    found = fp.plan(domain.model, domain.tasks)
    assert isinstance(found, fp.HierarchicalPlan)
    return found


def test_every_class_with_rows_can_be_asked_for_them() -> None:
    for name in FRAMED_BY:
        home, _, kind = name.rpartition(".")
        framed = getattr(importlib.import_module(f"factored_polca.{home}"), kind)
        assert issubclass(framed, Framed), name


def test_a_plan_has_a_row_for_each_task(taxi: fp.HierarchicalPlan) -> None:
    """The numbers of README's table, two independent probes of Taxi."""
    frame = taxi.to_frame().set_index("name")
    assert list(frame.index) == [s.task.name for s in taxi.solved]
    assert frame.loc["Root", "blocks"] == 55
    assert frame["q_values"].sum() == 1520
    assert frame.loc["Get", "actions"] == 5
    executable = fp.executable(taxi, fp.plan_report(taxi)).to_frame()
    assert executable["blocks"].tolist() == frame["blocks"].tolist()


def test_a_partially_observed_plan_has_bounds_and_observations() -> None:
    domain = fp.load_domain("meds")
    found = fp.plan(domain.model, domain.tasks)
    frame = found.to_frame()
    assert (frame["lower"] <= frame["upper"]).all()
    before, after = frame["observations_before"], frame["observations_after"]
    assert (after <= before).all()
    task = found.solved[0]
    quotient = task.reduction.to_frame()
    sums = quotient.groupby(["block", "action"])["probability"].sum()
    assert np.allclose(sums, 1.0)
    assert set(quotient.columns) == {"block", "action", "observation", "next", "probability", "reward"}


def test_a_quotient_has_a_row_for_each_transition(taxi: fp.HierarchicalPlan) -> None:
    quotient = taxi.task("Navigate_R").reduction.quotient
    frame = quotient.to_frame()
    assert len(frame) == sum(matrix.nnz for matrix in quotient.mdp.transitions)
    assert np.allclose(frame.groupby(["block", "action"])["probability"].sum(), 1.0)
    assert set(frame["reward"]) == {-1.0}


def test_a_partition_has_exact_sizes_beyond_64_bits() -> None:
    symbolic = fp.compile_model(fp.load_domain("linear", {"size": 80}).model)
    frame = fp.minimise(fp.flat_process(symbolic)).to_frame()
    assert frame["states"].tolist() == [2 ** (79 - k) for k in range(80)] + [1]
    assert sorted(frame["where"][1].split(" and ")) == ["not x_1", "x_0"]
    assert len(frame) == 81


def test_solutions_have_their_history_or_their_states(taxi: fp.HierarchicalPlan) -> None:
    problem = flat_model(fp.compile_model(fp.load_domain("cheese").model)).pomdp
    history = fp.solve_pomdp(problem, "sarsop").to_frame()
    assert list(history.columns) == ["seconds", "lower", "upper"]
    assert (history["lower"].diff().dropna() >= 0).all()
    assert (history["upper"].diff().dropna() <= 0).all()
    states = taxi.root.solution.to_frame()
    assert len(states) == 55
    assert (states["lower"] <= states["upper"]).all()


def test_runs_comparisons_and_traces_have_rows(taxi: fp.HierarchicalPlan) -> None:
    plan = fp.executable(taxi)
    runs = fp.simulate(plan, episodes=20)
    assert runs.to_frame()["return"].mean() == pytest.approx(runs.mean)
    frame = fp.compare(plan, plan, episodes=10).to_frame()
    assert (frame["difference"] == 0).all()
    episode = fp.trace(plan, steps=50, seed=1)
    steps = episode.to_frame()
    assert len(steps) == len(episode.steps)
    assert steps["path"][0] == "Root > Get > " + steps["path"][0].split(" > ")[2]
    assert steps["state.passenger"].iloc[-1] == "taxi"


def test_a_trace_over_beliefs_has_a_column_for_each_probability() -> None:
    plan = fp.executable_pomdp(fp.plan(fp.load_domain("tiger").model))  # type: ignore[arg-type]
    frame = fp.trace(plan, steps=5, seed=2).to_frame()
    assert np.allclose(frame["belief.tiger=left"] + frame["belief.tiger=right"], 1.0)
    assert set(frame["observed.growl"]) <= {"left", "right"}


def test_figures_have_rows() -> None:
    from factored_polca.studies.parameters import ParameterStudy, TaskParameters

    study = ParameterStudy(
        "m", 4, (TaskParameters("a", 10, 4, 5), TaskParameters("b", None, 1, 2)), (), 0.0
    )
    frame = study.to_frame()
    assert frame["polca_plus"].tolist() == [5, 2]
    assert frame["none"].isna().tolist() == [False, True]


def test_figure_4c_has_a_row_for_each_method_and_count(monkeypatch: pytest.MonkeyPatch) -> None:
    from factored_polca.studies.q_values import QValueStudy

    learner = {
        "name": "HSMQ", "discount": 1.0, "stored_values": 11_000, "visited": 10_000, "final_return": 7.0,
        "episodes_to_optimum": 500,
    }  # fmt: skip
    polca = {
        "discount": 0.95, "q_values": 1520, "q_applicable": 1400, "q_classes": 1073,
        "q_classes_shared": 528, "return": 3.8,
    }  # fmt: skip
    data = {"domains": [{"domain": "Taxi", "learners": [learner], "polca": [polca]}]}
    monkeypatch.setattr(QValueStudy, "to_data", lambda _: data)
    frame = QValueStudy((), 0, 0.02, (), 0.0).to_frame()
    assert frame["stored_values"].tolist() == [11_000, 1520, 1400, 1073, 528]
    assert frame["method"][4] == "PolCA q_classes_shared"
    assert frame["episodes_to_optimum"][0] == 500


def test_what_has_no_rows_is_named() -> None:
    with pytest.raises(TypeError, match=r"int has no rows; what has: .*Partition"):
        columns(3)


def test_without_pandas_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, taxi: fp.HierarchicalPlan
) -> None:
    def missing(name: str, *rest: Any) -> Any:
        raise ImportError(name)

    monkeypatch.setattr("factored_polca.display.extras.import_module", missing)
    with pytest.raises(
        MissingLibrary, match=r"pandas, which is not installed: pip install 'factored-polca\[frames\]'"
    ):
        taxi.to_frame()
