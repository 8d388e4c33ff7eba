"""The command `bench`: what it runs, what it says of it, and what it says of what failed."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

from factored_polca import library
from factored_polca.bench.cases import CASES, Case, chosen
from factored_polca.bench.dyadic import dyadic
from factored_polca.bench.runner import PeerRow, Row, run_case
from factored_polca.bench.storm import storm
from factored_polca.bench.table import cells, growths, markdown, ratio_text
from factored_polca.cli import main
from factored_polca.explicit.enumeration import enumerate_model


def row(case: Case, seconds: float, blocks: int = 9, **more: object) -> Row:
    made = Row(case, 512, blocks, 3, seconds, seconds / 4, 0.5, 1000, 300 << 20, 200 << 20)
    return replace(made, **more)  # type: ignore[arg-type]


def test_every_case_is_a_shipped_domain_with_a_name_of_its_own() -> None:
    assert len({case.name for case in CASES}) == len(CASES)
    for case in CASES:
        if case.size < 60:
            library.load(case.domain, dict(case.settings))


def test_cases_are_chosen_by_parts_of_their_names() -> None:
    assert [case.name for case in chosen(["taxi 5", "expon 8"], False)] == [
        "expon 8", "taxi 5", "taxi 5, 8 noise bits"
    ]  # fmt: skip
    assert all(case.quick for case in chosen([], True))
    with pytest.raises(ValueError, match="no case has 'tiger' in its name; there are linear 16"):
        chosen(["tiger"], False)


def test_large_cases_run_only_where_they_are_asked_for() -> None:
    assert [case.name for case in chosen(["taxi 2", "taxi 128"], False)] == ["taxi 20", "taxi 128"]
    assert "taxi 256" not in [case.name for case in chosen(["taxi"], False)]
    assert {case.name for case in chosen([], False, True) if case.large} == {
        *("expon 16", "expon 17", "expon 18"), *("taxi 128", "taxi 256"),
        *(f"sysadmin ring {n}" for n in (16, 18, 20)),
    }  # fmt: skip


def test_dyadic_probabilities_are_fractions_of_the_denominator_and_none_is_lost() -> None:
    model = library.load("components", {"size": "2"}).model
    exact = enumerate_model(dyadic(model, 8))
    chances = {q for rows in exact.rows for r in rows for q in r.values()}
    assert all((64 * q).denominator == 1 and q > 0 for q in chances)
    before = enumerate_model(model)
    assert [[set(r) for r in rows] for rows in exact.rows] == [
        [set(r) for r in rows] for rows in before.rows
    ]
    least = enumerate_model(dyadic(library.load("expon", {"size": "2"}).model, 0))
    assert {q for rows in least.rows for r in rows for q in r.values()} == {Fraction(1, 2), Fraction(1)}


def test_the_command_prints_one_object_and_writes_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "table.md"
    arguments = ["bench", "expon 8", "--repeat", "1", "--no-peer", "--json", "-o", str(target)]
    assert main(arguments) == 0
    found = json.loads(capsys.readouterr().out)["rows"]
    assert [(one["states"], one["blocks"]) for one in found] == [(256, 256)]  # no two states are alike
    assert found[0]["seconds"] > 0
    assert found[0]["memory"] > 50 << 20
    assert "| expon 8 | 256 | 256 |" in target.read_text(encoding="utf-8")


def test_a_list_of_cases_is_commands_that_minimise(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--list", "30 machines"]) == 0
    expected = "minimise sysadmin --set size=30 --set topology=independent --interchangeable"
    assert expected in capsys.readouterr().out


def test_an_unknown_case_is_wrong_use(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "tiger"]) == 2
    assert "no case has 'tiger' in its name" in capsys.readouterr().err


def test_a_run_that_takes_too_long_is_a_row_that_says_so() -> None:
    found = run_case(CASES[0], 1, 0.01, [])
    assert found.problem == "more than 0 s"
    assert "more than 0 s" in cells(found)


def test_a_row_shows_the_quicker_peer_and_the_ratio() -> None:
    slow, quick = PeerRow("Storm dd", 9, 4.0, 1 << 30), PeerRow("Storm sparse", 9, 1.0, 1 << 20)
    shown = cells(row(CASES[0], 0.05, peers=(slow, quick)))
    assert shown[8:] == ("Storm sparse", "9", "1.00", "1", "20")
    assert [ratio_text(ratio) for ratio in (0.766, 9.94, 99.6, 1234.0)] == ["0.77", "9.9", "100", "1,234"]
    failed = PeerRow("Storm dd", None, None, None, "more than 9 s")
    assert cells(row(CASES[0], 0.05, peers=(failed,)))[8] == "Storm dd: more than 9 s"


def test_growth_is_fitted_where_a_family_has_points_enough() -> None:
    family = [case for case in CASES if case.family == "expon"][:3]
    rows = [row(case, 0.001 * 2**case.size, 2**case.size, actions=7) for case in family]
    assert growths(rows[:2]) == []
    (line,) = growths(rows)
    assert line.startswith("expon: seconds 2^n")
    assert "blocks 2^n" in line
    assert "seconds (blocks x actions)^1.00" in line
    assert "Growth, fitted" in markdown(rows)


def test_storm_finds_the_blocks_of_a_case() -> None:
    pytest.importorskip("stormpy", reason="needs the extra `storm`")
    (case,) = chosen(["taxi 5"], True)[:1]
    sparse, dd = storm(case, 100.0)
    assert sparse.blocks == 502  # with the state before the start
    assert sparse.seconds is not None
    assert dd.blocks is not None or dd.problem
