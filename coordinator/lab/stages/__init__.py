"""Stages on which a recording is played to its areas anew: the simulator, and processes."""
