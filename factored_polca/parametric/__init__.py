"""Models whose parameters stay symbols: one minimisation for all their values."""
