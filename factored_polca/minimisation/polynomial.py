"""Actions that may be exchanged for one another: the multiset of their signatures (DESIGN 4).

Named actions keep n identical machines with a `reboot_i` each apart, though they differ in name only.  A
homomorphism of MDPs (Ravindran & Barto 2003) may map x to y by any map of the actions applicable at x onto
those at y.  Let the signature of choice a be

    sigma_a = f_a + c R_a,        f_a = R_a[V], V = r o P,

with the same random r and c for every choice.  Two states have the same multiset of signatures of the
applicable choices if and only if their characteristic polynomials

    prod over applicable a of (t - sigma_a(x))

agree, which is tested at one random t; at the start with c R_a in place of sigma_a.  The result is sound,
if not always the coarsest: that would compare sets, here two equal actions are not one.

Under partial observability it is unsound.  Who does not know the state can't know which of the actions it
stands for: Tiger without listening would collapse to one state in which the right door is always known.
"""

from __future__ import annotations

import numpy as np

from factored_polca.diagrams import Diagram, Field, choose
from factored_polca.minimisation.criterion import Choice, DecisionProcess, ProcessView
from factored_polca.models import Fault, ModelError


class Polynomial:
    """The characteristic polynomial of a process' choices at one random point of a field."""

    def __init__(self, view: ProcessView, field: Field, generator: np.random.Generator) -> None:
        self.view = view
        manager = view.numbers.manager
        point, scale = (field.decode(int(v)) for v in field.draw(generator, 2))
        self.point, self.scale = manager.constant(point, field), manager.constant(scale, field)

    def of_rewards(self) -> Diagram:
        """That of c R_a."""
        return self._product([self.scale * self.view.reward(c) for c in self.view.process.choices])

    def of_rows(self, value: Diagram, memo: dict[int, Diagram]) -> Diagram:
        """That of sigma_a for V = `value`; `memo` keeps the regressions of primitives."""
        return self._product([self.signature(c, value, memo) for c in self.view.process.choices])

    def signature(self, choice: Choice, value: Diagram, memo: dict[int, Diagram]) -> Diagram:
        """sigma_a, c R_a + f_a."""
        return self.scale * self.view.reward(choice) + self.view.regress(choice, value, memo)

    def _product(self, signatures: list[Diagram]) -> Diagram:
        one = self.view.numbers.one
        factors = [
            choose(self.view.app(choice), self.point - signature, one)
            for choice, signature in zip(self.view.process.choices, signatures, strict=True)
        ]
        while len(factors) > 1:  # pairwise: factors of neighbouring choices are over neighbouring features
            pairs = [a * b for a, b in zip(factors[::2], factors[1::2], strict=False)]
            factors = pairs + ([factors[-1]] if len(factors) % 2 else [])
        return factors[0]


def refuse_partial(process: DecisionProcess) -> None:
    """Refuse to exchange the choices of a process whose state is not seen.

    Raises:
        ModelError: it is not.
    """
    if process.partial:
        raise ModelError([interchangeable_fault()])


def interchangeable_fault() -> Fault:
    """Why actions of a model whose state is not seen can't be exchanged."""
    return Fault(
        "interchangeable actions need a state that is seen: who does not know the state does not know "
        "which of them fits",
        ("observability",),
        "minimise with named actions",
    )
