"""Tests of the product: units, the protocol on the simulator, real processes, frozen answers."""
