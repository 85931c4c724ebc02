"""Formats that several packages use: conversion between bytes or tables and validated values.

``convert`` converts settings, options and scenarios to dataclasses and checks the constraints in their annotations.
``head`` parses HTTP headers, ``websocket`` is one end of a WebSocket with limits, ``jpeg`` reads the size of an image.
``drivers`` and ``middleware`` both use this package, so they need not import each other; this package imports nothing
of the project.
"""
