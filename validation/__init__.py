"""Validation: settings, options and scenarios, converted to dataclasses whose annotations state the constraints.

``drivers`` and ``middleware`` both use this package, and do not import each other.  It imports nothing of the project.
"""
