"""One area's part of the estimate of the whole grid: its model, boundary loads, rounds, bad data, ADMM's
mathematics.
"""
