"""What is known of areas from outside: presence, states, events, progress."""
