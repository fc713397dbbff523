"""The log of a process: its content and its format."""
