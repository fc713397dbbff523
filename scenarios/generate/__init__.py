"""Generator of feeders, and cuts of a network into areas."""
