"""The routes of the API, one module per subject; ``registry`` collects all of them."""
