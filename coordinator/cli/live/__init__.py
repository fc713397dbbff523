"""Commands that attach to a running system, or play back a recording."""
