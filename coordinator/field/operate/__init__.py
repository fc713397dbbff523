"""Actions of an operator on a running system: meters off and on, an immediate scan, the end of all processes."""
