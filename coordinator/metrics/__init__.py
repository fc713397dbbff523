"""What a watcher sees, for Prometheus, and for programs that restart a system."""
