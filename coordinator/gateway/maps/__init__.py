"""A gateway's map: which address of a source is which meter, in which unit; and the sources and sinks it may name."""
