"""The built-in strategies, loaded by name (``consensus.strategy.BUILT_IN``)."""
