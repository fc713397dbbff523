"""Recordings played back on the simulator or to processes, and the results compared with the record."""
