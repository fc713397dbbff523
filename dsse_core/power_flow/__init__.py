"""Power flow by Newton-Raphson or, for radial networks, by sweeps."""
