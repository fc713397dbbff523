"""What an operator does to a running system: meters off and on, a scan at once, its end."""
