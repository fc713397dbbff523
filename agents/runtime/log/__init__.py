"""What a process writes into its log, and how."""
