"""Tools with which benchmarks measure, and the files of their figures."""
