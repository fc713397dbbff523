"""Recordings: what areas use and show over time, as a log that survives kill -9, as Parquet, and played back."""
