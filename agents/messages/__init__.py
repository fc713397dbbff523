"""What crosses the bus: messages, their keys, how they are packed and checked."""
