"""Recordings: readings and states of areas over time, as a log that survives kill -9, as Parquet, and played back."""
