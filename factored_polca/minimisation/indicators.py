"""The indicators of blocks of a partition, or weighted sums of some, and their regressions; shared nodes
are done once.

The indicators of different blocks share most of their lower nodes.  Without synchronic arcs

    R(n) = sum_v P(x_i' = v | x) R(child_v(n)),        i the level of node n,

depends on the node only, so each *distinct* node of all indicators is regressed once, children
before parents; a result is dropped when the last parent has used it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factored_polca.diagrams import Diagram, Field, relabel, weighted_sum
from factored_polca.diagrams.operations import Walk
from factored_polca.symbolic import NumericView


class Indicators:
    """For each pack of blocks b_0, b_1, .. the diagram in `field` that is base^j where `labels` has the
    leaf b_j, else 0.

    `nodes` are handles on their distinct nodes, children first; `children[i]` and `roots[pack]` number
    nodes; `levels[i]` is a node's level.
    """

    def __init__(self, labels: Diagram, packs: Sequence[Sequence[int]], base: int, field: Field) -> None:
        manager = self.manager = labels.manager
        diagrams = []
        largest = max(max(pack) for pack in packs)
        for pack in packs:
            images = np.zeros(largest + 1, dtype=np.uint64)
            images[list(pack)] = [field.encode(base**j) for j in range(len(pack))]
            diagrams.append(relabel(labels, images, field))
        # No operation from here to the handles: it might collect garbage and renumber the nodes.
        met = np.zeros(int(manager.head[0]), dtype=np.bool_)
        for diagram in diagrams:
            met[Walk(diagram).nodes] = True
        found = np.flatnonzero(met)
        found = found[np.argsort(-manager.pool[found], kind="stable")]
        number = {node: i for i, node in enumerate(found.tolist())}
        self.levels: list[int] = manager.pool[found].tolist()
        self.children: list[list[int]] = []
        for node, level in zip(found.tolist(), self.levels, strict=True):
            size = manager.sizes[level] if level < manager.leaf_level else 0
            self.children.append([number[c] for c in manager.pool[node + 2 : node + 2 + size].tolist()])
        self.roots = [number[diagram.node] for diagram in diagrams]
        self.nodes = [manager.handle(node, field) for node in found.tolist()]
        self._dropped = self._last_uses()

    def _last_uses(self) -> list[list[int]]:
        """For each node the nodes, none of them a root, of which it is the last parent."""
        last: dict[int, int] = {}
        for i, children in enumerate(self.children):
            last.update(dict.fromkeys(children, i))
        dropped: list[list[int]] = [[] for _ in self.children]
        for child, parent in last.items():
            dropped[parent].append(child)
        roots = set(self.roots)
        return [[child for child in children if child not in roots] for children in dropped]

    def regress(self, numbers: NumericView, primitive: int) -> list[Diagram]:
        """The regression of each indicator through a primitive action; `numbers` are of the same field."""
        symbolic = numbers.symbolic
        action = symbolic.actions[primitive]
        if action.synchronic:
            return [numbers.regress(primitive, self.nodes[root]) for root in self.roots]
        feature_at = {symbolic.now(i): i for i in range(len(symbolic.order))}
        lowest_changed = max((symbolic.now(i) for i in action.rows), default=-1)
        results: list[Diagram | None] = [None] * len(self.nodes)
        for i, level in enumerate(self.levels):
            if level > lowest_changed:
                results[i] = self.nodes[i]
                continue
            parts = [part for child in self.children[i] if (part := results[child]) is not None]
            weights = numbers.weights(primitive, feature_at[level])
            results[i] = weighted_sum(weights, parts, normalised=True)
            for child in self._dropped[i]:
                results[child] = None
        return [result for root in self.roots if (result := results[root]) is not None]
