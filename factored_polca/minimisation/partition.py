"""Partitions of the states as diagrams from states to block numbers.

Blocks are numbered by first occurrence in a depth-first walk, so equal partitions are one node; a
block's representative is its lexicographically first state in the diagram's variable order.  With
a restriction to reachable states one more leaf, `outside`, stands for all other states; it is no
block.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import (
    INDEX,
    Diagram,
    choose,
    leaves,
    node_count,
    relabel,
    renumber,
    states_for_leaves,
    states_of_leaves,
)
from factored_polca.diagrams.operations import Walk
from factored_polca.drawn import Drawn, Framed
from factored_polca.symbolic import SymbolicModel


@dataclass(frozen=True)
class Partition(Drawn, Framed):
    """Blocks 0 .. blocks-1; the leaf `blocks` is outside, where `has_outside`."""

    symbolic: SymbolicModel
    diagram: Diagram
    blocks: int
    has_outside: bool = False

    @cached_property
    def representatives(self) -> npt.NDArray[np.int32]:
        """The first state of each block, as value numbers int32 [block, level]."""
        states = states_for_leaves(self.diagram)
        numbers = Walk(self.diagram).leaf_payloads().astype(np.int64)
        result = np.zeros((self.blocks, self.symbolic.manager.leaf_level), dtype=np.int32)
        inside = numbers < self.blocks
        result[numbers[inside]] = states[inside]
        return result

    @cached_property
    def sizes(self) -> list[int]:
        """The exact number of states of each block."""
        counts = states_of_leaves(self.diagram, self.symbolic.now_levels)
        result = [0] * self.blocks
        for count, leaf in zip(counts, leaves(self.diagram), strict=True):
            if int(leaf) < self.blocks:
                result[int(leaf)] = count
        return result

    @cached_property
    def nodes(self) -> int:
        """The number of nodes of the diagram."""
        return node_count(self.diagram)

    def indicator(self, block: int) -> Diagram:
        """The condition that a state lies in `block`."""
        return self.diagram.equals(self.symbolic.manager.constant(block))


def partition_from(symbolic: SymbolicModel, labels: Diagram, reachable: Diagram | None = None) -> Partition:
    """The partition whose blocks are the leaves of any diagram, outside masked, numbered canonically."""
    manager = symbolic.manager
    if reachable is None or reachable == manager.constant(1):
        numbered, old = renumber(labels)
        return Partition(symbolic, numbered, len(old))
    numbered, old = renumber(labels)
    outside = len(old)
    masked = choose(reachable, numbered, manager.constant(outside))
    found = [int(leaf) for leaf in leaves(masked)]
    inside = [leaf for leaf in found if leaf != outside]
    images = np.zeros(outside + 1, dtype=np.uint64)
    for number, leaf in enumerate(inside):
        images[leaf] = number
    images[outside] = len(inside)
    return Partition(symbolic, relabel(masked, images, INDEX), len(inside), outside in found)
