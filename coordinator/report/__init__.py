"""What people read and look at: texts, tables and pictures."""
