"""Studies: figures and tables of the paper, from our own runs; and grids of runs of one's own.

`Study` and `Grid` are loaded when they are used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from factored_polca.studies.cluster import Cluster
    from factored_polca.studies.grid import Grid, Run, make_grid
    from factored_polca.studies.store import Store
    from factored_polca.studies.study import Study
    from factored_polca.studies.study_file import read_study

__all__ = ["Cluster", "Grid", "Run", "Store", "Study", "make_grid", "read_study"]

_HOME: Final = {
    "Cluster": "cluster",
    "Grid": "grid",
    "Run": "grid",
    "Store": "store",
    "Study": "study",
    "make_grid": "grid",
    "read_study": "study_file",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
