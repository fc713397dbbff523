"""Linear algebra: the weighted least-squares step in augmented form, sparse LU factors, and selected inverses."""
