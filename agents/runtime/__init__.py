"""An agent as a process: its loop, inbox and presence, its links with injected faults, and the check for a second
process of its name.
"""
