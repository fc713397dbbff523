"""Reports for people: texts, tables and pages with figures."""
