"""Circuits of OpenDSS: text that is checked, a process of its own that solves it, matrices that become branches."""
