"""A partition: each block as a formula over features, with its exact number of states."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from factored_polca.display.covers import Budget
from factored_polca.display.formulas import STEPS, formula, names_of, text
from factored_polca.display.tables import heading, line, table, view
from factored_polca.display.words import count_text, plural, short
from factored_polca.minimisation import Partition

SHOWN_BLOCKS: Final = 30
LONGEST: Final = 160
"""Characters of a formula."""


def html(partition: Partition) -> str:
    """A table of the first blocks, and what was left out."""
    return view(*parts(partition))


def parts(partition: Partition) -> list[str]:
    """Heading, table and notes."""
    sizes = partition.sizes
    total, model = sum(sizes), partition.symbolic.model
    rows = [
        (number, count_text(sizes[number]), said)
        for number, said in enumerate(block_formulas(partition, SHOWN_BLOCKS))
    ]
    left = partition.blocks - len(rows)
    hidden = sum(sizes[len(rows) :])
    outside = (
        f"; {plural(model.states - total, 'state')} outside, which the start can't reach"
        if (partition.has_outside)
        else ""
    )
    return [
        heading(
            f"partition of {short(model.name)}",
            f"{plural(total, 'state')} in {plural(partition.blocks, 'block')}; "
            f"diagram of {plural(partition.nodes, 'node')}{outside}",
        ),
        table(["block", "states", "where"], rows, left=(2,)),
        line(f"… {plural(left, 'more block')} of {plural(hidden, 'state')}") if left else "",
    ]


def block_formulas(partition: Partition, most: int | None = None, longest: int = LONGEST) -> Iterator[str]:
    """The formula of each block, or of the first ones; where none is short, its first state."""
    symbolic = partition.symbolic
    names, budget = names_of(symbolic), Budget(STEPS)
    count = partition.blocks if most is None else min(most, partition.blocks)
    for block in range(count):
        found = formula(symbolic, partition.indicator(block), budget)
        said = None if found is None else text(found, names)
        if said is None or len(said) > longest:
            said = f"no short formula; such as {_state_text(partition, block, longest)}"
        yield said


def _state_text(partition: Partition, block: int, longest: int) -> str:
    """The first state of a block, the features that the partition tests only."""
    from factored_polca.diagrams import support

    symbolic, first = partition.symbolic, partition.representatives[block]
    tested = set(support(partition.diagram))
    shown = [
        f"{feature.name}={feature.values[int(first[symbolic.now(k)])]}"
        for k, feature in enumerate(symbolic.model.features)
        if symbolic.now(k) in tested
    ]
    return short(", ".join(shown), longest)
