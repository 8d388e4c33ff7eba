"""The model as diagrams: compile and check, regress, reach. One of the two readings of a model."""

from factored_polca.symbolic.model import (
    SymbolicAction,
    SymbolicModel,
    compile_condition,
    compile_model,
    compile_term,
)
from factored_polca.symbolic.order import ORDERS, two_slice_graph, variable_order
from factored_polca.symbolic.reach import Reachable, reachable_states
from factored_polca.symbolic.regression import NumericView
from factored_polca.symbolic.rows import RowDiagram, Term

__all__ = [
    "ORDERS",
    "NumericView",
    "Reachable",
    "RowDiagram",
    "SymbolicAction",
    "SymbolicModel",
    "Term",
    "compile_condition",
    "compile_model",
    "compile_term",
    "reachable_states",
    "two_slice_graph",
    "variable_order",
]
