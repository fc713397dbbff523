"""Linear algebra: the weighted least-squares step in augmented form, sparse and dense, and selected inverses."""
