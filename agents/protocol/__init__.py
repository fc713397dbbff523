"""What an area does: events and time in, actions out. No bus, no clock, no randomness."""
