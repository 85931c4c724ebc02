"""What the data store is used through: publishing by keyword, and the tuple space in which each tuple is taken once."""
