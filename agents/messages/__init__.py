"""Messages on the bus: their types and keys, their packing and their checks."""
