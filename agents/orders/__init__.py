"""Commands of the operator to a process: the rules for following them, and the record that outlives the process."""
