"""Standard deviations of quantities that follow from an estimate."""
