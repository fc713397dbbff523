"""Protocol of an area: events and time in, actions out. No bus, no clock, no randomness."""
