"""Version of this package, which no other module is imported for."""

__version__ = "0.2.0"
