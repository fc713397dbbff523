"""Systems seen from outside: the watcher of a run, metrics, recordings and their playback."""
