"""The routes of the API, one module per subject; ``table`` collects all of them."""
