"""What benchmarks measure with, and where their figures go."""
