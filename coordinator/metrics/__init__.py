"""What a watcher sees, for Prometheus and for whoever restarts a system."""
