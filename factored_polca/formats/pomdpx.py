"""POMDPX 1.0: the XML format of factored MDPs, POMDPs and mixed-observability POMDPs of APPL (SARSOP).

    <pomdpx version="1.0" id="...">
      [<Description> text </Description>] <Discount> number </Discount> [<Horizon> steps </Horizon>]
      <Variable> {<StateVar vnamePrev="x_0" vnameCurr="x_1" [fullyObs="true"]> values </StateVar>
                  | <ObsVar vname="o"> values </ObsVar> | <ActionVar vname="a"> values </ActionVar>
                  | <RewardVar vname="r"/>} </Variable>
      [<InitialStateBelief>     {<CondProb> function </CondProb>} </InitialStateBelief>]   P(x_0)
      <StateTransitionFunction> {<CondProb> function </CondProb>} </StateTransitionFunction> P(x_1 | ..)
      [<ObsFunction>            {<CondProb> function </CondProb>} </ObsFunction>]          P(o | ..)
      <RewardFunction>          {<Func> function </Func>} </RewardFunction>                r(..), summed
    </pomdpx>

    values   ::= <ValueEnum> name name ... </ValueEnum> | <NumValues> n </NumValues>
    function ::= <Var> x </Var> <Parent> "null" | y z ... </Parent> <Parameter [type="TBL"|"DD"]> ...
    table    ::= {<Entry> <Instance> v ... </Instance> <ProbTable> numbers </ProbTable> </Entry>}
    diagram  ::= <DAG> tree </DAG> {<SubDAGTemplate id="t"> tree </SubDAGTemplate>}
    tree     ::= <Node var="x"> {<Edge val="v"> tree </Edge>} </Node> | <Terminal> number </Terminal>
               | <SubDAG type="deterministic" var="x" val="v"/> | <SubDAG type="persistent" var="x_1"/>
               | <SubDAG type="uniform" var="x"/> | <SubDAG type="template" idref="t"/>

The parts of a document may come in any order.  An Instance has a value for each parent and, in a
<CondProb>, for the variable: a name, `*` (all) or `-` (all, the table lists them, the last `-` runs
fastest).  A table may be the word `uniform` (1/n for each value of the variable) or `identity` (1 where
the variable's value has the number of the value of the one parent marked `-`).  Later entries override
earlier ones; what is not listed is 0.  Rewards are in a ValueTable.  Numbers are exact decimals.

What becomes what, and how we read where the documentation leaves it open:

- x_0, x_1 are the feature x now and next; the name is vnamePrev without `_0` where nothing else has it.
  `fullyObs` features are `observed`.  If all are and there is no ObsVar, the model is fully observed.
- Several action variables make one action for each joint value, called "v,w".
- x_1 may depend on other y_1, acyclically for each action; an observation on x_0 too; a reward on all.
- Joint probabilities (<Var> x_0 y_0 </Var>) of states become conditional ones; observations can't.
- Without <InitialStateBelief>, allowed where all is observed, all states are equally likely (a warning).
- A number alone stands for a value of a variable given by NumValues; ProbTable is read in a Func.
- A row that misses the sum 1 by less than 1e-4 is divided by its sum, a larger miss is an error.
- There are no terminal states: an absorbing state is a state.  <Horizon> is our addition.
- Elements and attributes that are not listed here are errors, except for attributes of <pomdpx>.

The writer keeps to what APPL's own program reads: tables only, and the arcs that `pomdpx_columns` lists; a
model with other arcs gets variables for joint values or for values before a step.

Sources: "PomdpX File Format (version 1.0)" and its XML schema, Approximate POMDP Planning Software,
National University of Singapore; S. C. W. Ong, S. W. Png, D. Hsu, W. S. Lee, "POMDPs for robotic
tasks with mixed observability", RSS 2009.
"""

from __future__ import annotations

from factored_polca.formats.pomdpx_reader import read_pomdpx_with_warnings
from factored_polca.formats.pomdpx_writer import write_pomdpx
from factored_polca.models.model import Model

__all__ = ["read_pomdpx", "read_pomdpx_with_warnings", "write_pomdpx"]


def read_pomdpx(text: str, name: str) -> Model:
    """The model that the POMDPX document `text` describes, called `name`.

    Raises:
        ModelError: the text is not right, or asks for more work than the limits allow; every fault
            has a line and a column.
    """
    return read_pomdpx_with_warnings(text, name)[0]
