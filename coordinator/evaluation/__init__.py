"""A run evaluated: beside the centralised estimate of the same readings, since when it is close, and the files of
its result.
"""
