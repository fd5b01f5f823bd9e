"""Errors that a user can correct."""


class InputError(ValueError):
    """Bad input: one line that names the file, the row and the remedy.

    The command prints the line and ends with exit status 2; nothing is half written.
    """


class BackendError(RuntimeError):
    """No usable LLVM or CUDA: one line that names what was found and the remedy."""
