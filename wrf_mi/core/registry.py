"""Registries: objects by name, from this package, installed packages and this process."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from .errors import InputError

Entry = TypeVar("Entry")


def resolve(address: str) -> Any:
    """The object at ``module:attribute``; the module is imported."""
    module, _, attribute = address.partition(":")
    return getattr(import_module(module), attribute)


class Registry(Mapping[str, Entry], Generic[Entry]):
    """Objects by name; an entry is imported at its first use.

    ``what`` is the noun for an entry in messages, ``group`` that of the entry points by which installed packages add
    entries, and ``builtin`` has the entries of this package by name, or their addresses ``module:attribute``.
    """

    def __init__(self, what: str, group: str, builtin: Mapping[str, Entry | str] | None = None) -> None:
        self._what, self._known = what, dict[str, Entry | str]()
        self._others = {point.name: point for point in entry_points(group=group)}
        self._twice, self._modules = set[str](), dict[str, str]()
        self.add_builtin(builtin or {})

    def add_builtin(self, entries: Mapping[str, Entry | str]) -> None:
        """Add entries of this package, where the registry lies in a package below theirs."""
        self._known |= entries
        self._twice |= entries.keys() & self._others.keys()
        addresses = {name: entry for name, entry in entries.items() if isinstance(entry, str)}
        self._modules |= {name: address.partition(":")[0] for name, address in addresses.items()}

    def add(self, name: str, entry: Entry) -> None:
        """Add an entry for this process; `InputError`: the name is taken."""
        if name in self:
            raise InputError(f"{self._what} {name!r}: there is one of that name; choose another")
        self._known[name] = entry

    def module(self, name: str) -> str:
        """Name of the module of an entry, which is not imported; "" where it was added as an object."""
        return self._others[name].module if name in self._others else self._modules.get(name, "")

    def __getitem__(self, name: str) -> Entry:
        if name in self._twice:
            address = self._others[name].value
            raise InputError(f"{self._what} {name!r}: an installed package ({address}) adds the same name; remove it")
        if name not in self._known:
            self._known[name] = self._others[name].load()
        entry = self._known[name]
        if isinstance(entry, str):
            entry = self._known[name] = resolve(entry)
        return entry

    def __contains__(self, name: object) -> bool:
        return name in self._known or name in self._others  # without importing it

    def __iter__(self) -> Iterator[str]:
        return iter({**self._known, **self._others})

    def __len__(self) -> int:
        return len(self._known | self._others)
