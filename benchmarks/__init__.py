"""What things cost: commands that print tables; each can be run by anyone."""
