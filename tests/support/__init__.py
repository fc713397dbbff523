"""Code that several tests share: grids and feeders, the simulated bus, processes by hand, pages, malformed files."""
