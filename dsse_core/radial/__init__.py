"""The compiled back end: passes over the tree of a radial network."""
