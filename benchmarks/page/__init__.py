"""Cost of the page: processor time of a browser's tasks and of moments, and the memory of both over a day."""
