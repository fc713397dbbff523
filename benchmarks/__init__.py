"""Side-by-side runs of our centralised estimate and its peers: ``python -m benchmarks``, docs/how-to/benchmarks.md."""
