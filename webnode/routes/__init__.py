"""The routes of the API, a module for each thing that can be asked about; ``table`` has them all."""
