"""Areas as seen from outside: presence, states, events, progress."""
