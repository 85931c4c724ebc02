"""How long a task stands still when who does it is lost, by cause."""
