"""An agent as a process: its loop, inbox, presence, links with injected faults, and what it does with a second
process of its name.
"""
