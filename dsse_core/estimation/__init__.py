"""The centralised estimate, and the function from totals to verdict that it shares with the areas."""
