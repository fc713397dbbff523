"""Estimates timed side by side: cases, draws, batches."""
