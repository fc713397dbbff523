"""Standard deviations of what follows from an estimate."""
