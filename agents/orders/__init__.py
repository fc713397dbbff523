"""What the operator orders a process to do: which commands are followed, and what of them outlives the process."""
