"""The neighbours of an area: their newest messages, freshness, agreement of both files; and rejected messages."""
