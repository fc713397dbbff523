"""The simulator: areas in one process on a simulated bus in virtual time, repeatable to the bit."""
