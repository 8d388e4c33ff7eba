"""A reward as a sum of terms over few fluents each.

One large sum would be a diagram over all fluents at once; so sums are split, also below a constant factor
and in the branches of a choice:

    c (a + b) = c a + c b,    if d then a + b else e = (if d then a else 0) + (if d then b else 0) + ...
"""

from __future__ import annotations

from factored_polca.formats.rddl_terms import Term, Terms

_MANY = 3


def reward_terms(terms: Terms, root: Term) -> list[Term]:
    """Terms whose sum is `root`."""
    found: list[Term] = []
    work = [root]
    while work:
        term = work.pop()
        row = terms[term]
        if row.op == "add":
            work += reversed(row.parts)
        elif row.op == "multiply" and len(row.parts) == 2 and terms.value(row.parts[0]) is not None:
            parts = terms[row.parts[1]].parts if terms[row.parts[1]].op == "add" else ()
            if parts:
                work += [terms.product([row.parts[0], part]) for part in reversed(parts)]
            else:
                found.append(term)
        elif row.op == "if" and terms.fixed(row.parts[0]) and _splits(terms, row.parts[1:]):
            work += reversed(_branches(terms, *row.parts))
        else:
            found.append(term)
    return found


def _splits(terms: Terms, branches: tuple[Term, ...]) -> bool:
    return any(terms[branch].op == "add" and len(terms[branch].parts) > _MANY for branch in branches)


def _branches(terms: Terms, condition: Term, then: Term, otherwise: Term) -> list[Term]:
    zero = terms.number(0)
    result = [terms.choice(condition, part, zero) for part in reward_terms(terms, then)]
    return result + [terms.choice(condition, zero, part) for part in reward_terms(terms, otherwise)]
