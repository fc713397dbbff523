"""A page that shows a running feeder, or plays one back, and the API behind it."""
