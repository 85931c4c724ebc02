"""The settings of a node: the TOML file, its types, and the changes made while the node runs."""
