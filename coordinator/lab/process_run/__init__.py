"""A run of real processes: router, plant and agents started, watched, faulted and ended."""
