"""Made-up feeders, and where a network is cut into areas."""
