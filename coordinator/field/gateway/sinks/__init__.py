"""The sinks that are shipped: JSON lines, MQTT."""
