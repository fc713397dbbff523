"""Recordings played back, on the simulator or to processes, and what came of it beside the record."""
