"""A short run of the fuzzing of all readers, and the command that makes long ones.

`python -m tests.fuzz` reads millions of inputs; docs/formats/fuzzing.md tells what they found.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzz.campaign import BLOCK, Campaign, input_of, run, summary
from fuzz.choices import Choices
from fuzz.readers import READERS, Reader, prepared
from fuzz.verdict import Finding, judged, unprintable
from fuzz.work import LIMIT, WorkExceeded, counted, watched
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from factored_polca.formats import files
from factored_polca.models import Feature, Model, ModelError, check, work
from factored_polca.models.work import Work

INPUTS = 1_000


@pytest.fixture(scope="module", autouse=True)
def watching() -> Iterator[None]:
    with watched(), prepared():
        yield


@pytest.mark.parametrize("name", READERS)
def test_no_input_breaks_a_rule(name: str) -> None:
    """The rules are those of `fuzz.verdict`."""
    reader, outcomes = READERS[name], dict.fromkeys(("accepted", "refused", "limit"), 0)

    @settings(
        max_examples=INPUTS, deadline=None, derandomize=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(st.binary(min_size=60, max_size=220))
    @example(b"")
    def fuzzed(data: bytes) -> None:
        outcome = judged(reader, reader.make(Choices(data)), closely=sum(outcomes.values()) % 50 == 0)
        assert not isinstance(outcome, Finding), f"{outcome.sign}\n{outcome.detail}"
        outcomes[outcome] += 1

    fuzzed()
    assert sum(outcomes.values()) >= INPUTS - 100  # hypothesis leaves out what it has tried
    assert outcomes["accepted"] > 5
    assert outcomes["refused"] > 100


# Texts that ask for much more than their size: (reader, text).
BOMBS = {
    "entities": ("pomdpx", '<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;">]><pomdpx>&c;</pomdpx>'),
    "a file of the system": ("pomdpx", '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>'),
    "nested elements": ("pomdpx", "<a>" * 3000),
    "many values": ("pomdpx", "<pomdpx><Variable><ActionVar vname='a'><NumValues>99999999</NumValues>"),
    "nested tables": ("native", "a = " + "[" * 5000),
    "nested brackets": ("native", f"discount = '{'(' * 5000}'"),
    "signs": ("native", f"discount = '{'-' * 5000}1'"),
    "digits": ("native", f"discount = {'9' * 5000}"),
    "an exponent": ("native", "discount = '1e30000000'"),
    "powers": ("native", "discount = '9**9**9**9'"),
    "a long product": ("native", f"discount = '{'*'.join(['2**9999'] * 1000)}'"),
    "sums of long numbers": ("native", f"reward = '{'+'.join(['1/7**999', '1/3**999'] * 400)}'"),
    "a range": ("native", "discount = 0.9\n[features]\nx = '0..999999999999999999'"),
    "many ranges": ("native", "[features]\n" + "\n".join(f"x{i} = '1..99999'" for i in range(12))),
    "nested trees": ("spudd", "(variables (x a b)) reward " + "(x (a " * 3000),
    "doubled trees": (
        "spudd",
        "(variables (x a b)) dd d0 (x (a (1)) (b (2))) enddd "
        + " ".join(f"dd d{i + 1} [+ (d{i}) (d{i})] enddd" for i in range(60)) + " reward (d60)",
    ),
    "a product of many factors": (
        "spudd",
        f"(variables {' '.join(f'(x{i} a b)' for i in range(40))})"
        f" reward [* {' '.join(f'(x{i} (a ({i}.5)) (b (1)))' for i in range(40))}]"
        " action go endaction discount 0.9",
    ),
    "many states": ("cassandra", "discount: 0.9\nstates: 99999999\nactions: 2\nobservations: 2\n"),
    "wildcards": (
        "cassandra",
        "discount: 0.9\nvalues: reward\nstates: 90000\nactions: 90000\nobservations: 90000\n"
        "T: * identity\nO: * uniform\n" + "".join(f"R: {i} : * : {i} : * {i}\n" for i in range(400)),
    ),
    "a long word": ("alpha", "0 1 " + "1" * 100_000),
    "a long line": ("pg", "0 0 " + "0 " * 50_000),
}  # fmt: skip


@pytest.mark.parametrize(("name", "text"), BOMBS.values(), ids=BOMBS.keys())
def test_bombs_are_read_or_refused_within_the_budget(name: str, text: str) -> None:
    reader = READERS[name]
    judged(reader, reader.corpus()[0])  # modules are loaded before calls are counted
    outcome = judged(reader, text.encode(), closely=True)
    assert not isinstance(outcome, Finding), f"{outcome.sign}\n{outcome.detail}"


TRICKS = [
    "<script>alert(1)</script>",
    "../../etc/passwd",
    "\x1b[2J",
    "\x9b31m",
    "\u202eexe.txt",
    "a\nb",
    "%s%n",
    "[red]",
]


@pytest.mark.parametrize("name", TRICKS)
def test_a_name_that_would_not_be_seen_is_refused_and_told_of_escaped(name: str) -> None:
    model = Model("m", [Feature(name, ["a", name])], [], discount="0.9")
    told = [str(fault) for fault in check(model)]
    assert not any(map(unprintable, told))
    assert any("can't be shown" in line for line in told) is not name.isprintable()


def test_errors_name_what_is_not_shown_by_its_escape() -> None:
    with pytest.raises(ModelError) as caught:
        files.document_of(
            b'discount = 0.5\n[features]\n"\\u001b[2J" = "boolean"\n[actions.a]\n', "\x1b.toml"
        )
    assert "\\x1b[2J" in str(caught.value)
    assert all(str(fault).isprintable() for fault in caught.value.faults)


# --------------------------------------------------------------------------------------------
# The command's parts
# --------------------------------------------------------------------------------------------


def test_a_campaign_goes_on_where_it_was_ended(tmp_path: Path) -> None:
    path = tmp_path / "state.json"
    run(Campaign.opened(path, 3), ["pg"], BLOCK, lambda text: None)
    before = json.loads(path.read_text())["readers"]["pg"]
    campaign = Campaign.opened(path, 3)
    run(campaign, ["pg"], BLOCK, lambda text: None)
    assert campaign.of("pg") == before  # nothing is left to do
    run(campaign, ["pg", "alpha"], 2 * BLOCK, lambda text: None)
    after = json.loads(path.read_text())["readers"]
    assert [after[name]["inputs"] for name in ("pg", "alpha")] == [2 * BLOCK] * 2
    counts = [after["pg"][outcome] for outcome in ("accepted", "refused", "limit")]
    assert sum(counts) == 2 * BLOCK
    assert after["pg"]["accepted"] > before["accepted"]
    whole = Campaign.opened(tmp_path / "whole.json", 3)
    run(whole, ["pg"], 2 * BLOCK, lambda text: None)
    assert [whole.of("pg")[outcome] for outcome in ("accepted", "refused", "limit")] == counts
    assert f"{2 * BLOCK:,d}" in summary(whole, ["pg"])
    with pytest.raises(SystemExit, match="was begun with --seed 3"):
        Campaign.opened(path, 4)


def test_what_breaks_a_rule_is_kept_with_its_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(data: bytes, file: str) -> None:
        if data[:1] == b"0":
            raise KeyError("a fault")
        raise ModelError("told without a place")

    sound = READERS["pg"]
    reader = Reader(sound.file, True, sound.corpus, sound.change, sound.generate, broken)
    monkeypatch.setitem(READERS, "pg", reader)
    campaign = Campaign.opened(tmp_path / "state.json", 0)
    campaign.block("pg")
    found = campaign.of("pg")["findings"]
    (named,) = [sign for sign in found if sign.startswith("KeyError")]
    assert {sign for sign in found if sign != named} == {"no file: 'told without a place'"}
    assert sum(finding["count"] for finding in found.values()) == BLOCK
    first = found[named]["inputs"][0]
    assert (tmp_path / "state.findings" / f"pg-{first}").read_bytes() == input_of(0, "pg", first)
    assert "KeyError: 'a fault'" in (tmp_path / "state.findings" / f"pg-{first}.txt").read_text()


def test_work_beyond_the_count_is_noticed() -> None:
    with pytest.raises(WorkExceeded, match="calls and returns"), counted(10, calls=True):
        [abs(number) for number in range(20_000)]
    with pytest.raises(WorkExceeded, match="steps were counted"), counted(10, calls=False):
        Work().count(100 * LIMIT)
    with counted(10, calls=True):
        assert not Work().count(LIMIT + 1)
    assert work.MAXIMUM_STEPS == LIMIT
