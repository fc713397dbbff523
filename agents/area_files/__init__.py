"""The area file: all that one agent reads."""
