"""The initial belief as row diagrams over the first time slice.

b0(x) = prod_i P_i(x_i | parents) prod_j phi_j(x) is brought to the form prod_i Q_i(x_i | x_<i): without
factors Q = P; with factors, for the features F that they or features without distribution involve,
the product over F is formed as one exact diagram and conditioned feature by feature (chain rule),

    Q_i(x_i | x_<i) = S_i(x_<=i) / S_{i-1}(x_<i),     S_i = sum over the later features of F.

A feature without a distribution is uniform if there are no factors, and weighted 1 if there are.
Rows live on the *next* variables, so that b0 can be used wherever the row diagrams of an action are.
"""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from factored_polca.diagrams import INDEX, Diagram, choose, cofactors, combine, relabel, support
from factored_polca.models.errors import Fault
from factored_polca.models.expressions import Expression, Reference, references, rewrite
from factored_polca.models.rational_functions import RationalFunction
from factored_polca.symbolic.rows import RowDiagram, Term, as_number, numbered

if TYPE_CHECKING:
    from factored_polca.symbolic.model import _Build


def primed(expression: Expression) -> Expression:
    """`expression` over the next variables."""
    return rewrite(expression, lambda e: Reference(e.name, True) if isinstance(e, Reference) else e)


def compile_initial(build: _Build) -> dict[int, RowDiagram]:
    """The row diagram of each feature; faults are recorded in `build`."""
    model = build.model
    numbers = {feature.name: i for i, feature in enumerate(model.features)}
    rows: dict[int, RowDiagram] = {}
    for name, expression in model.initial.distributions:
        moved = primed(expression)
        rows[numbers[name]] = build.rows(
            numbers[name], model.feature(name), moved, ("initial", name), build.true
        )
    build.settle_suspects(rows)
    if model.initial.factors:
        rows.update(_conditioned(build, rows))
    for index, feature in enumerate(model.features):
        if index not in rows:
            share = Fraction(1, len(feature.values))
            row = tuple(share for _ in feature.values)
            rows[index] = RowDiagram(index, build.manager.constant(0), (row,))
    return rows


def _conditioned(build: _Build, rows: dict[int, RowDiagram]) -> dict[int, RowDiagram]:
    """Rows for the features that factors involve, by the chain rule on their product."""
    model = build.model
    involved = {i for i in range(len(model.features)) if i not in rows}
    for factor in model.initial.factors:
        names = {reference.name for reference in references(factor)}
        involved |= {i for i, feature in enumerate(model.features) if feature.name in names}
    before = -1
    while before != len(involved):  # distributions of involved features, their parents and children
        before = len(involved)
        for index, row in rows.items():
            if index in involved or involved & set(row.parents_next):
                involved |= {index, *row.parents_next}
    product = Term(build.manager.constant(0), (Fraction(1),))
    for index in sorted(involved & set(rows), key=build.positions.__getitem__):
        product = _times(product, _likelihood(build, rows[index]))
    for number, factor in enumerate(model.initial.factors):
        compiled = build.compiler.compile(primed(factor))
        table = build.compiler.table.values
        bad = np.array([not _counts(v) for v in table], dtype=np.uint64)
        counts = np.array([value != 0 for value in product.values], dtype=np.uint64)
        wrong = relabel(compiled, bad, INDEX) & relabel(product.diagram, counts, INDEX)
        if wrong != build.false:
            build.report(
                compiled, wrong, ("initial", "factors", str(number)), "the factor", "a number >= 0"
            )
            return {}
        product = _times(product, numbered(compiled, lambda n: as_number(build.compiler.value(n))))
    order = sorted(involved, key=build.positions.__getitem__)
    sums = [product]
    for index in reversed(order):
        sums.append(_sum_out(sums[-1], 2 * build.positions[index] + 1))
    total = sums[-1].values[int(sums[-1].diagram.value)]
    if total != 1:
        build.faults.append(
            Fault(f"the initial belief sums to {total}", ("initial", "factors"), "it must sum to exactly 1")
        )
        return {}
    result: dict[int, RowDiagram] = {}
    for place, index in enumerate(order):
        joint = sums[len(order) - 1 - place]
        level = 2 * build.positions[index] + 1
        parts = cofactors(joint.diagram, level)

        def conditioned(*entries: int, values: tuple[Fraction, ...] = joint.values) -> tuple[Fraction, ...]:
            weights = [values[e] for e in entries]
            whole = sum(weights, Fraction(0))
            if whole == 0:
                return tuple(Fraction(int(v == 0)) for v in range(len(weights)))
            return tuple(weight / whole for weight in weights)

        diagram, found = combine(parts, conditioned)
        parents = tuple(j for j in order[:place] if 2 * build.positions[j] + 1 in support(diagram))
        result[index] = RowDiagram(index, diagram, tuple(found), parents)
    return result


def _counts(value: object) -> bool:
    """Whether a factor may have this value; what parameters that stay symbols make of it is seen later."""
    if isinstance(value, RationalFunction):
        return True
    return isinstance(value, (Fraction, bool)) and value >= 0


def _likelihood(build: _Build, row: RowDiagram) -> Term:
    """P_i(x_i | parents) as a function of x_i and its parents."""
    level = 2 * build.positions[row.feature] + 1
    values: dict[Fraction, int] = {}
    result: Diagram | None = None
    for v in range(len(build.model.features[row.feature].values)):
        images = np.array([values.setdefault(r[v], len(values)) for r in row.rows], dtype=np.uint64)
        part = relabel(row.diagram, images, INDEX)
        result = part if result is None else choose(build.manager.indicator(level, [v]), part, result)
    assert result is not None
    return Term(result, tuple(values))


def _times(a: Term, b: Term) -> Term:
    diagram, values = combine([a.diagram, b.diagram], lambda i, j: a.values[i] * b.values[j])
    return Term(diagram, tuple(values))


def _sum_out(term: Term, level: int) -> Term:
    diagram, values = combine(
        cofactors(term.diagram, level), lambda *entries: sum((term.values[e] for e in entries), Fraction(0))
    )
    return Term(diagram, tuple(values))
