"""Studies: figures and tables of the paper, from our own runs."""
