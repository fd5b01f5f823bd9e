"""Version of this package, which no other module is imported for."""

__version__ = "0.3.0"
