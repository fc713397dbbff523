"""What a scenario does to the processes of a run: when, by which clock, and by which signals."""
