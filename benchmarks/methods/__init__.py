"""The tools that are timed side by side, ours and the peers': one class each."""
