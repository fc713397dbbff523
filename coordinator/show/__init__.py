"""Pictures and pages: figures, reports, and the page in a browser."""
