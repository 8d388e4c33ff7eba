"""Abstraction with a bounded error: near states are merged, and what that costs at most is said."""
