"""SPUDD's language for factored MDPs, with Symbolic Perseus' additions for POMDPs.

    file     ::= "(" "variables" {"(" NAME VALUE VALUE ... ")"} ")"
                 ["(" "observations" {"(" NAME VALUE VALUE ... ")"} ")"]
                 ["init" tree] ["unnormalised" | "unnormalized"]
                 {"dd" NAME tree "enddd" | action} ["reward" tree]
                 "discount" number ["tolerance" number] ["horizon" number]
    action   ::= "action" NAME [number] {NAME tree}
                 ["observe" {NAME tree} "endobserve"] ["cost" tree] "endaction"
    tree     ::= "(" NAME ["'"] {"(" VALUE tree ")"} ")"     a decision; the prime means the next value
               | "(" number ")" | number                     a constant
               | "(" number number ... ")"                   a row: P(x' = v) in the order of x's values
               | "(" NAME ")"                                a named tree
               | "[" ("+" | "*" | "-" | "/") tree ... "]"    all arguments from left to right
               | "[" "#" NAME ["'"] tree "]"                 divided by its sum over the named variable

`// ...` is a comment.  Known without a definition are SAMEx (1 where x' = x, else 0) and xv (1 where
x' = v, else 0).  A variable's tree in an action is a function of x, of other next values y' and of
x' itself; a row is such a function of x' alone.  The trees of an action's own variables multiply to
the transition probability; under `unnormalised` each is divided by its sum over x'.  An observation
feature has its value after the action and is written with a prime.  R_a = reward - cost; both may
mention next values.  `init` is divided by its sum.  Numbers are exact decimals.

Where implementations differ we read as follows, and say so in a warning where it matters:
a branch left out is 0 (Symbolic Perseus; SPUDD refuses); a variable that an action does not mention
persists (SPUDD refuses); a number after an action's name is its cost (old SPUDD; 3.6.2 drops it);
a row that misses the sum 1 by less than 1e-4 is divided by its sum, a larger miss is an error;
the tolerance, a setting of the solver, is not kept.  With `(observations ...)` the model is a
POMDP, without it an MDP.

All values are read as names, even `0` and `true`.  The writer gives integers as `v0`, truth values
as `true` and `false`, and other names with the characters that the language lacks replaced; the
names it changed are listed in comments.

Sources: J. Hoey, R. St-Aubin, A. Hu, C. Boutilier, "SPUDD: Stochastic planning using decision
diagrams", UAI 1999; the grammar of SPUDD 3.6.2 (Hoey); P. Poupart, "Exploiting structure to
efficiently solve large scale partially observable Markov decision processes", PhD thesis, Toronto
2005, and its program Symbolic Perseus.
"""

from __future__ import annotations

from factored_polca.formats.spudd_reader import read_spudd_with_warnings
from factored_polca.formats.spudd_writer import write_spudd
from factored_polca.models.model import Model

__all__ = ["read_spudd", "read_spudd_with_warnings", "write_spudd"]


def read_spudd(text: str, name: str) -> Model:
    """The model that `text` describes, called `name`.

    Raises:
        ModelError: the text is not right, or asks for more work than the limits allow; every fault
            has a line and a column.
    """
    return read_spudd_with_warnings(text, name)[0]
