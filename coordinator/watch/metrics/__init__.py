"""A watcher's view as metrics for Prometheus, and as health for programs that restart a system."""
