"""Interfaces to the stored data: publishing by keyword, and a tuple space in which each tuple is taken once."""
