"""What a study runs: products, keys, strict reading of grids and of study files."""

from __future__ import annotations

import tomllib
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from factored_polca.cli import main
from factored_polca.models import ModelError
from factored_polca.studies import Run, Study, make_grid, read_study
from factored_polca.studies.cluster import Cluster
from factored_polca.studies.grid import MAXIMUM_RUNS
from factored_polca.studies.limits import Limits
from factored_polca.studies.study_file import limit_bytes, template

LINEAR: dict[str, Any] = {"work": "minimise", "model": "linear", "set": {"size": [4, 8]}, "seed": "0..2"}


def faults(grid: dict[str, Any]) -> list[tuple[tuple[str, ...], str]]:
    with pytest.raises(ModelError) as caught:
        make_grid(grid)
    return [(fault.path, str(fault)) for fault in caught.value.faults]


# -- products and keys -----------------------------------------------------------------------------


def test_a_grid_is_the_product_of_its_lists() -> None:
    grid = make_grid({
        "work": "solve", "model": ["tiger", "meds"], "solver": ["sarsop", "hsvi"], "gap": [0.1, 0.01],
        "seed": "0..3",
    })  # fmt: skip
    runs = list(grid.runs({}))
    assert grid.size == len(runs) == 2 * 2 * 2 * 4
    assert len({run.key for run in runs}) == len(runs)
    assert [run.seed for run in runs[:4]] == [0, 1, 2, 3]  # seeds run fastest
    assert runs[0] == Run("solve", "tiger", "", (), (("gap", 0.1), ("solver", "sarsop")), 0)


def test_what_occurs_twice_is_run_once() -> None:
    study = Study("twice", [LINEAR, LINEAR | {"seed": [2, 3]}, LINEAR | {"seed": [0, 0]}])
    assert len(study.runs()) == 2 * 4


def test_equal_parameters_have_equal_keys_however_they_are_written() -> None:
    written: list[dict[str, Any]] = [
        {"work": "plan", "model": "taxi", "set": {"size": 5, "slip": True}, "gap": 1},
        {"gap": 1.0, "seed": 0, "set": {"slip": "true", "size": "5"}, "model": ["taxi"], "work": "plan"},
    ]
    first, second = ([run.key for run in make_grid(grid).runs({})] for grid in written)
    assert first == second


def test_the_key_depends_on_all_that_decides_the_result_and_on_nothing_else() -> None:
    base: dict[str, Any] = {"work": "plan", "model": "taxi", "set": {"size": 5}, "trials": 5, "seed": 1}
    changes: list[dict[str, Any]] = [
        {"work": "solve"} | {"trials": ()}, {"model": "network"}, {"set": {"size": 6}}, {"trials": 6},
        {"seed": 2}, {"flat": False},
    ]  # fmt: skip

    def key(grid: dict[str, Any]) -> str:
        (run,) = make_grid({k: v for k, v in grid.items() if v != ()}).runs({})
        return run.key

    assert len({key(base), *(key(base | change) for change in changes)}) == 7
    # The hash is of the parameters only, so it stays what it was in stores that exist.
    run = Run("minimise", "linear", "", (("size", "4"),), (), 0)
    text = '{"fingerprint":"","model":"linear","options":{},"seed":0,"set":{"size":"4"},"work":"minimise"}'
    import hashlib

    assert run.key == hashlib.sha256(text.encode()).hexdigest()[:32]


def test_a_model_file_counts_by_its_text(tmp_path: Path) -> None:
    (tmp_path / "a.dat").write_text("one\n")
    keys = []
    for text in ("one\n", "one\r\n", "two\n"):
        (tmp_path / "a.dat").write_bytes(text.encode())
        (run,) = Study("s", [{"work": "minimise", "model": "a.dat"}], folder=tmp_path).runs()
        keys.append(run.key)
    assert keys[0] == keys[1] != keys[2]


def test_exact_numbers_stay_exact() -> None:
    grid = make_grid({
        "work": "solve", "model": "tiger", "set": {"accuracy": [Fraction(17, 20), 0.1, "1/3"]},
        "discount": [0.95, "19/20"],
    })  # fmt: skip
    assert grid.settings == (("accuracy", ("17/20", "0.1", "1/3")),)
    assert grid.options == (("discount", ("19/20",)),)


# -- what is refused -------------------------------------------------------------------------------

WRONG: list[tuple[dict[str, Any], tuple[str, ...], str]] = [
    ({}, (), "minimise, plan, solve"),
    ({"work": "minimize"}, ("work",), "minimise, plan, solve"),
    ({"work": "minimise"}, (), "there is no model"),
    ({"work": "minimise", "model": "liner"}, ("model",), "did you mean linear?"),
    ({"work": "minimise", "model": ["linear", "liner"]}, ("model", "1"), "did you mean linear?"),
    ({"work": "minimise", "model": 3}, ("model",), "shipped domain"),
    ({"work": "minimise", "model": []}, ("model",), "it must have 1 to"),
    ({"work": "minimise", "model": {"a": 1}}, ("model",), "a list of values"),
    (LINEAR | {"solver": "vi"}, ("solver",), "interchangeable, model, order"),
    (LINEAR | {"reachable": 1}, ("reachable",), "true or false"),
    (LINEAR | {"order": "alphabetic"}, ("order",), "spectral"),
    (LINEAR | {"seed": -1}, ("seed",), "from 0 on"),
    (LINEAR | {"seed": [0, True]}, ("seed", "1"), "from 0 on"),
    (LINEAR | {"seed": "5..4"}, ("seed",), "has 0 values"),
    (LINEAR | {"seed": "0..99999"}, ("seed",), "has 100,000 values"),
    (LINEAR | {"set": {"siez": 4}}, ("set", "siez"), "did you mean size?"),
    (LINEAR | {"set": {"size": [4, None]}}, ("set", "size", "1"), "a text, a number"),
    (LINEAR | {"set": {"size": float("nan")}}, ("set", "size"), "a text, a number"),
    (LINEAR | {"set": 4}, ("set",), "write set.size"),
    ({"work": "solve", "model": "tiger", "gap": 0}, ("gap",), "positive"),
    ({"work": "solve", "model": "tiger", "gap": [0.1, "x"]}, ("gap", "1"), "positive"),
    ({"work": "solve", "model": "tiger", "solver": "sarsp"}, ("solver",), "sarsop"),
    ({"work": "solve", "model": "tiger", "horizon": 0}, ("horizon",), "from 1 on"),
    ({"work": "solve", "model": "tiger", "discount": 2}, ("discount",), "0 to 1"),
    ({"work": "m:f", "set": {"a": "b" * 9}, "gap": 3}, ("gap",), "of a function's grid"),
]


@pytest.mark.parametrize(("grid", "path", "text"), WRONG, ids=range(len(WRONG)))
def test_a_grid_that_is_not_right_is_refused(
    grid: dict[str, Any], path: tuple[str, ...], text: str
) -> None:
    ((found, message),) = faults(grid)
    assert found == path
    assert text in message


def test_all_faults_are_told_at_once() -> None:
    found = faults({"work": "plan", "model": "taxi", "gap": "x", "trials": 0, "sed": 1})
    assert [path for path, _ in found] == [("sed",), ("gap",), ("trials",)]


def test_the_number_of_runs_is_capped_before_they_are_made() -> None:
    big = LINEAR | {"set": {"size": list(range(10_000))}, "seed": "0..9999"}
    ((_, message),) = faults(big)
    assert "100,000,000 runs" in message
    half = LINEAR | {"set": {"size": list(range(60))}, "seed": "0..999"}
    with pytest.raises(ModelError, match=f"at most {MAXIMUM_RUNS:,}"):
        Study("big", [half, half | {"model": "expon"}])


@pytest.mark.parametrize("wrong", [{"seconds": 0}, {"memory_bytes": -1}, {"jobs": 0}])
def test_limits_are_positive(wrong: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match=f"{next(iter(wrong))} is .*positive"):
        Study("s", [LINEAR], **wrong)


def test_a_study_without_grids_is_refused() -> None:
    with pytest.raises(ModelError, match="nothing to run"):
        Study("none", [])


def test_parameters_that_a_file_does_not_have_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["new", "robot", "-q"]) == 0
    (tmp_path / "other.dat").write_text("")
    with pytest.raises(ModelError) as caught:
        Study("s", [
            {"work": "minimise", "model": "robot.toml", "set": {"no_such": 1}},
            {"work": "minimise", "model": "other.dat", "set": {"size": 1}},
            {"work": "minimise", "model": "gone.dat"},
        ], folder=tmp_path)  # fmt: skip
    first, second, third = caught.value.faults
    assert first.path == ("grid", "0", "set", "no_such")
    assert "robot.toml has no parameter 'no_such'" in first.message
    assert "other.dat has no parameter 'size'" in second.message
    assert "it has none" in second.hint
    assert third.path == ("grid", "2", "model")
    assert "there is no file gone.dat" in third.message


# -- files -----------------------------------------------------------------------------------------

FILE = """name = "a study"
seconds = 1.5
memory = "1.5 GiB"
jobs = 3
store = "kept.sqlite"

[[grid]]
work = "minimise"
model = ["linear", 'expon']
set.size = [4, 8]
seed = "0..2"

[[grid]]
work = "solve"
model = "tiger"
set = { accuracy = [0.85, "9/10"] }
solver = "sarsop"
gap = 1e-2

[cluster]
provider = "local"
workers = 2
"""


def read(folder: Path, text: str) -> Study:
    (folder / "s.toml").write_text(text, encoding="utf-8")
    return read_study(folder / "s.toml")


def test_a_file_is_read(tmp_path: Path) -> None:
    study = read(tmp_path, FILE)
    assert (study.name, study.jobs) == ("a study", 3)
    assert study.limits == Limits(1.5, 3 << 29)
    assert study.store == tmp_path / "kept.sqlite"
    assert study.cluster == Cluster(workers=2)
    assert len(study.runs()) == 2 * 2 * 3 + 2
    assert study.grids[1].settings == (("accuracy", ("0.85", "9/10")),)
    assert study.grids[1].options == (("solver", ("sarsop",)), ("gap", (0.01,)))


def test_what_a_file_leaves_out_is_as_documented(tmp_path: Path) -> None:
    study = read(tmp_path, '[[grid]]\nwork = "minimise"\nmodel = "linear"\n')
    assert (study.name, study.jobs, study.cluster) == ("s", 1, None)
    assert study.limits == Limits(600, 4 * 10**9)
    assert study.store == tmp_path / "s.sqlite"
    assert read_study(tmp_path / "s.toml", store=tmp_path / "x").store == tmp_path / "x"


@pytest.mark.parametrize(
    ("before", "after", "place", "text"),
    [
        ("jobs = 3", "jobs = 0", "4:8", "from 1 to"),
        ("seconds = 1.5", "seconds = -1.5", "2:11", "seconds is -1.5"),
        ("seconds = 1.5", "seconds = inf", "2:11", "seconds is inf"),
        ('"1.5 GiB"', '"1.5 parrots"', "3:11", "2 GB"),
        ("jobs", "job", "4:1", "unknown key 'job'"),
        ("seed =", "sed =", "11:1", "did you mean seed?"),
        ("set.size", "set.siez", "10:5", "did you mean size?"),
        ("'expon'", "'expom'", "9:21", "did you mean expon?"),
        ('"tiger"', '"tigre"', "15:10", "did you mean tiger?"),
        ("[4, 8]", "[4, []]", "10:16", "a text, a number"),
        ("1e-2", "-1e-2", "18:7", "positive"),
        ("workers = 2", "workers = 0", "22:11", "from 1 to"),
        ("workers = 2", "wrokers = 2", "22:1", "did you mean workers?"),
        ('"local"', '"slurm"\nimage = "x"', "22:10", "only kubernetes"),
        ('"local"', '"kubernetes"', "20:2", "there is no image"),
        ("[[grid]]\nwork = \"solve\"", "[[grid]]", "13:3", "there is no work"),
        ("jobs = 3", "jobs = 3 3", "4:10", "no TOML"),
        ('solver = "sarsop"', 'solver = "os:system"\nx = "', "18:6", "no TOML"),
    ],
)  # fmt: skip
def test_faults_of_a_file_have_their_places(
    tmp_path: Path, before: str, after: str, place: str, text: str
) -> None:
    assert FILE.count(before) >= 1
    with pytest.raises(ModelError) as caught:
        read(tmp_path, FILE.replace(before, after, 1))
    (fault,) = caught.value.faults
    assert f"s.toml:{place}: " in str(fault)
    assert text in str(fault)


def test_other_texts_are_refused(tmp_path: Path) -> None:
    for text, said in [
        ("", "there is no grid"),
        ("grid = 3", "write [[grid]]"),
        ("x" * (1 << 20 | 1), "bytes"),
    ]:
        with pytest.raises(ModelError) as caught:
            read(tmp_path, text)
        assert said in str(caught.value)
    with pytest.raises(ModelError, match="study new"):
        read_study(tmp_path / "gone.toml")
    (tmp_path / "s.toml").write_bytes(b"name = '\xff'")
    with pytest.raises(ModelError, match="no UTF-8"):
        read_study(tmp_path / "s.toml")


def test_sizes_are_read() -> None:
    sizes = {
        "2 GB": 2 * 10**9,
        "500MiB": 500 << 20,
        "1.5g": 15 * 10**8,
        "7": 7,
        12: 12,
        "0": None,
        "": None,
    }
    assert {text: limit_bytes(text) for text in sizes} == sizes
    assert limit_bytes("2 GB GB") is limit_bytes(True) is limit_bytes(-1) is None


def test_the_template_is_a_study_whatever_its_name(tmp_path: Path) -> None:
    for name in ("growth", 'a "quoted" name', "a\\b"):
        text = template(name, "growth.toml")
        assert tomllib.loads(text)["name"] == name
        study = read(tmp_path, text)
        assert len(study.runs()) == 2 * 5 * 3 + 2 * 2
        uncommented = text.replace("# [cluster]", "[cluster]").replace("# provider", "provider")
        assert read(tmp_path, uncommented.replace("# workers", "workers")).cluster == Cluster(workers=2)
