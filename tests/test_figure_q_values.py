"""The command `figure 4c`, its picture, and the page that shows both."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from factored_polca.cli import main
from factored_polca.hierarchy.counts import QValueCounts
from factored_polca.studies.q_value_drawing import draw_learning_curves, draw_stored_values
from factored_polca.studies.q_values import PolcaCounts, QValueStudy, TaxiStudy, study_q_values

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "figure4c.md").read_text(encoding="utf-8")
SMALL = ["--set", "size=2", "--episodes", "400"]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)
    return tmp_path


@pytest.fixture(scope="module")
def study() -> QValueStudy:
    return study_q_values({"size": "2"}, episodes=400)


def test_the_data_says_all_that_was_computed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["figure", "4c", *SMALL, "--seed", "3", "--json"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("\n") == 1
    data = json.loads(printed)
    assert {"figure", "settings", "seed", "domains", "close", "seconds", "total_seconds"} <= set(data)
    assert (data["figure"], data["settings"], data["seed"]) == ("4c", {"size": "2"}, 3)
    assert [domain["domain"] for domain in data["domains"]] == ["Taxi", "Taxi2"]
    taxi = data["domains"][0]
    # Four cells, five places of the passenger, four destinations; six actions.
    assert (taxi["live_states"], taxi["episodes"]) == (4 * 5 * 4, 400)
    assert taxi["learners"][0]["stored_values"] == 6 * 80
    for row in taxi["learners"]:
        assert row["stored_values"] == sum(row["tables"].values())
        assert 0 < row["visited"] <= row["stored_values"]
        assert len(row["checkpoints"]) == len(row["greedy_returns"]) == len(row["training_returns"])
        assert row["checkpoints"][-1] == 400
        assert row["final_return"] == row["greedy_returns"][-1]
    assert [row["discount"] for row in taxi["polca"]] == [1, 0.95]
    for row in taxi["polca"]:
        assert row["return"] == pytest.approx(row["optimum"])
        assert row["q_classes_shared"] <= row["q_classes"] <= row["q_applicable"] <= row["q_values"]
    assert taxi["polca"][0]["optimum"] == pytest.approx(taxi["optimum"])


def test_the_tables_show_each_method_and_the_picture_is_drawn(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["figure", "4c", *SMALL, "-o", "c.png", "-q"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    for name in ("Q-learning", "HSMQ", "options", "MAXQ, no abstraction", "MAXQ, by hand", "ALisp"):
        assert len(re.findall(rf"^{name} +1 +[\d,]+ +[\d,]+ ", captured.out, re.MULTILINE)) == 2
    for text in ("blocks × actions", "classes per action", "classes shared"):
        for discount in ("1", "0.95"):
            assert len(re.findall(rf"^PolCA, {text} +{discount} +", captured.out, re.MULTILINE)) == 2
    assert (folder / "c.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert [path.name for path in folder.iterdir()] == ["c.png"]


def axes() -> Any:
    from matplotlib.figure import Figure

    return Figure().add_subplot()


def test_bars_are_the_stored_values_and_the_visited_ones(study: QValueStudy) -> None:
    ax, taxi = axes(), study.domains[0]
    assert draw_stored_values(taxi, ax) is ax
    counts = taxi.polca[0].counts
    stored = [one.method.stored_values for one in taxi.learned]
    polca = [counts.q_values, counts.q_classes, counts.q_classes_shared]
    visited = [one.visited for one in taxi.learned]
    assert [bar.get_width() for bar in ax.patches] == [*stored, *polca, *visited, *polca]
    assert [text.get_text() for text in ax.texts] == [f"{count:,}" for count in [*stored, *polca]]
    assert ax.get_xscale() == "log"


def test_bars_of_polca_stand_apart_where_discounts_make_a_difference(study: QValueStudy) -> None:
    taxi = study.domains[0]
    one, other = taxi.polca
    apart = PolcaCounts(other.discount, QValueCounts(400, 300, 200, 150), other.value, other.optimum)
    changed = TaxiStudy("t", 80, 400, taxi.optimum, taxi.learned, (one, apart))
    ax = axes()
    draw_stored_values(changed, ax)
    labels = [label.get_text() for label in ax.get_yticklabels()]
    assert [label for label in labels if label.endswith("γ = 0.95")] == [
        f"PolCA, {text}, γ = 0.95" for text in ("blocks × actions", "classes per action", "classes shared")
    ]


def test_curves_are_the_training_returns_with_a_dot_for_who_came_close(study: QValueStudy) -> None:
    ax, taxi = axes(), study.domains[0]
    assert draw_learning_curves(taxi, ax, 0.02) is ax
    curves = {line.get_label(): line for line in ax.lines}
    for one in taxi.learned:
        assert curves[one.method.name].get_xdata().tolist() == list(one.checkpoints)
        assert curves[one.method.name].get_ydata()[-1] == pytest.approx(one.training_returns[-1])
    there = [one.episodes_to() for one in taxi.learned if one.episodes_to() is not None]
    dots = [line.get_xdata() for line in ax.lines if line.get_marker() == "o"]
    assert [dot[0] for dot in dots] == there
    assert there  # on four cells somebody does


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--set", "anywhere=true"], "Figure 4c shows both values"),
        (["--set", "discount=0.9"], "Figure 4c chooses it for each method"),
        (["--set", "size=1"], "size"),
        (["--set", "sizes=3"], "sizes"),
        (["--set", "size=11"], "Taxi2 has 59,532 states; learners' tables are made for at most 50,000"),
        (["--episodes", "0"], "at least 1"),
        (["-o", "c.svg"], "a file that ends in .png"),
        (["taxi"], "unrecognized arguments"),
    ],
)
def test_wrong_use_is_refused_with_what_would_be_right(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["figure", "4c", *arguments]) in (2, 3)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said in " ".join(captured.err.split())


# -- the page --------------------------------------------------------------------------------------


def rows(text: str) -> list[tuple[str, ...]]:
    """(method, discount, stored values) of each line of the tables."""
    return re.findall(r"^(\S.*?) {2,}(1|0\.95) +([\d,]+)\b", text, re.MULTILINE)


def test_the_page_shows_the_counts_that_are_computed(capsys: pytest.CaptureFixture[str]) -> None:
    (shown,) = re.findall(r"^```output\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    assert main(["figure", "4c", "--episodes", "1", "-q"]) == 0
    printed = rows(capsys.readouterr().out)
    assert len(printed) == 2 * 12
    assert rows(shown) == printed
    counts = {name: count for name, _, count in printed[:12]}
    table = {
        name.strip(): int(n.replace(",", ""))
        for name, n in re.findall(r"^\| ([^|]+)\|[^|]+\| (?:.* )?([\d,]+) \|$", PAGE, re.MULTILINE)
    }
    assert table == {name: int(count.replace(",", "")) for name, count in counts.items()}


def test_the_page_s_example_prints_what_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    exec(compile(code, "figure4c.md", "exec"), {"__name__": "page"})
    expected = re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE)
    assert capsys.readouterr().out.splitlines() == expected
    assert len(expected) == 2
