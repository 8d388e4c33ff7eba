"""A quotient: its blocks as formulas, and a small one as a graph of what each choice leads to."""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.display.graphs import Edge, Graph, Node
from factored_polca.display.partition_view import SHOWN_BLOCKS, block_formulas
from factored_polca.display.tables import drawing, heading, line, table, view
from factored_polca.display.words import count_text, listed, number_text, percent, plural, short
from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.minimisation import PomdpQuotient, Quotient

SHOWN_NODES: Final = 60
SHOWN_ARCS: Final = 90
LONGEST_FORMULA: Final = 70
SHOWN_CHOICES: Final = 6


def html(quotient: Quotient | PomdpQuotient) -> str:
    """Figures, the graph where it is small, and the blocks."""
    partition, mdp = quotient.partition, quotient.mdp
    entries = sum(matrix.nnz for matrix in mdp.transitions)
    detail = (
        f"{plural(partition.blocks, 'block')} for {plural(sum(partition.sizes), 'state')}, "
        f"{plural(len(mdp.actions), 'action')}, {plural(entries, 'transition')}"
    )
    if isinstance(quotient, PomdpQuotient):
        before, after = sum(quotient.observations_before), sum(quotient.observations_after)
        detail += f", {plural(after, 'joint observation')} of {before:,} over all actions"
    arcs = _arc_count(mdp)
    small = partition.blocks <= SHOWN_NODES and arcs <= SHOWN_ARCS
    picture = drawing(graph(quotient)) if small else line(f"{plural(arcs, 'arc')}: too many for a picture")
    return view(
        heading(f"quotient of {short(partition.symbolic.model.name)}", detail),
        picture,
        _blocks(quotient),
    )


def graph(quotient: Quotient | PomdpQuotient) -> Graph:
    """Blocks, and arcs with choices and probabilities; the first blocks where there are many."""
    partition, mdp = quotient.partition, quotient.mdp
    shown = min(partition.blocks, SHOWN_NODES)
    formulas = list(block_formulas(partition, shown, LONGEST_FORMULA))
    nodes = [
        Node(
            str(block),
            (f"block {block}", _brief(formulas[block]), plural(partition.sizes[block], "state")),
            "terminal" if mdp.terminal[block] else "block",
            formulas[block],
        )
        for block in range(shown)
    ]
    arcs = _arcs(mdp, shown)
    edges = [
        Edge(str(s), str(t), _arc_label(labels), title="; ".join(f"{a}: {q:.6g}" for a, q in labels[:20]))
        for (s, t), labels in list(arcs.items())[:SHOWN_ARCS]
    ]
    notes = []
    if shown < partition.blocks:
        notes.append(f"the first {shown} of {partition.blocks:,} blocks")
    if len(arcs) > SHOWN_ARCS:
        notes.append(f"the first {SHOWN_ARCS} of {len(arcs):,} arcs among them")
    note = f"shown: {', '.join(notes)}" if notes else ""
    return Graph(tuple(nodes), tuple(edges), "Quotient: blocks, and what actions lead to", "auto", note)


def _brief(said: str) -> str:
    return short(said.removeprefix("no short formula; "), 44)


def _arcs(mdp: ArrayMDP, shown: int) -> dict[tuple[int, int], list[tuple[str, float]]]:
    """The choices that lead from a block to another, with their probabilities."""
    found: dict[tuple[int, int], list[tuple[str, float]]] = {}
    for name, matrix in zip(mdp.actions, mdp.transitions, strict=True):
        entries = matrix[:shown].tocoo()
        for s, t, q in zip(entries.row.tolist(), entries.col.tolist(), entries.data.tolist(), strict=True):
            if t < shown and q > 0:
                found.setdefault((s, t), []).append((name, float(q)))
    return dict(sorted(found.items()))


def _arc_count(mdp: ArrayMDP) -> int:
    total = sum((abs(matrix) for matrix in mdp.transitions[1:]), abs(mdp.transitions[0]))
    return int(total.nnz)


def _arc_label(labels: list[tuple[str, float]]) -> str:
    """`north, east 10 %`: equal probabilities once; 1 is not said."""
    by_chance: dict[str, list[str]] = {}
    for name, q in labels:
        by_chance.setdefault("" if q > 1 - 1e-12 else f" {percent(q)}", []).append(short(name, 16))
    return "; ".join(f"{listed(names, 3)}{chance}" for chance, names in by_chance.items())


def _blocks(quotient: Quotient | PomdpQuotient) -> str:
    partition, mdp = quotient.partition, quotient.mdp
    shown = min(partition.blocks, SHOWN_BLOCKS)
    few = len(mdp.actions) <= SHOWN_CHOICES
    rows = []
    for block, said in enumerate(block_formulas(partition, shown)):
        rewards = np.where(mdp.applicable[:, block], mdp.rewards[:, block], np.nan)
        row: list[object] = [
            block,
            count_text(partition.sizes[block]),
            said + (" (ended)" if mdp.terminal[block] else ""),
        ]
        if few:
            row += [number_text(float(r)) for r in rewards]
        else:
            known = rewards[~np.isnan(rewards)]
            span = f"{number_text(known.min())} .. {number_text(known.max())}" if len(known) else "–"
            row.append(span)
        rows.append(row)
    names = [f"reward of {short(a, 16)}" for a in mdp.actions] if few else ["rewards"]
    left = partition.blocks - shown
    more = (
        line(f"… {plural(left, 'more block')} of {plural(sum(partition.sizes[shown:]), 'state')}")
        if left
        else ""
    )
    return table(["block", "states", "where", *names], rows, left=(2,)) + more
