"""Commands that attach to a running system, or to what one has recorded."""
