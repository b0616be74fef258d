"""Trains whereabot's mask and joint networks on recordings and exports them for the engine."""

__version__ = "0.1.0"
