"""A gateway's map: meter and unit of each address of a source, and the sources and sinks that a map may name."""
