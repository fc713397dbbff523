"""Evaluation of a run: comparison with the centralised estimate of the same readings, times of convergence, and the
files of its result.
"""
